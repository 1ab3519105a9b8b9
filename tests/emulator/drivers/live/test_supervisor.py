"""The supervisor: one state a process, and what is done to processes on the way from one to the next."""

import asyncio
import signal
import subprocess
import sys
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from emulator.drivers.launch import Exit
from emulator.drivers.live.supervisor import ProcessState
from tests.emulator.drivers.live.fakes import ALONE, IDS, Stage, joined, on_a_loop
from vnet.errors import VnetError
from vnet.transport import wire

RUNNING, PAUSED, AWAY, RETURNING, DEAD = ProcessState


def states(stage: Stage) -> list[ProcessState]:
    return [stage.supervisor.state(nodes[0]) for nodes in stage.processes]


@on_a_loop
async def test_after_the_start_every_process_runs_but_those_that_come_later() -> None:
    stage = joined(later=["v03"])
    assert states(stage) == [RUNNING, RUNNING, AWAY, RUNNING]
    assert stage.supervisor.processes_in(AWAY) == ["v03"]


@on_a_loop
async def test_a_killed_process_is_gone_at_once_and_comes_back_as_a_new_one() -> None:
    stage = joined()
    await stage.supervisor.end("v02", killed=True, reason="killed by a fault")
    assert stage.launcher.done == [("kill", "v02")]
    assert stage.attachment.sent == [], "it is told nothing"
    assert states(stage)[1] is AWAY
    stage.supervisor.begin_again(["v02"])
    assert stage.launcher.done[-1] == ("start", "v02")
    assert states(stage)[1] is RETURNING
    assert stage.supervisor.returning_nodes(IDS) == ["v02"]
    assert stage.supervisor.take_returned() == []
    stage.hello("v02", b"2")
    assert stage.supervisor.returning_nodes(IDS) == []
    assert stage.supervisor.take_returned() == ["v02"]
    assert states(stage) == [RUNNING] * 4
    assert stage.supervisor.take_returned() == [], "each is told once"


@pytest.mark.parametrize("pacing", ["lockstep", "realtime"])
@on_a_loop
async def test_a_process_that_is_restarted_is_told_to_end_and_waited_for(pacing: str) -> None:
    stage = joined(pacing=pacing)
    await stage.supervisor.end("v02", killed=False, reason="restarted by a fault")
    assert stage.attachment.sent == [("v02", wire.End(None, "restarted by a fault"))]
    if pacing == "lockstep":
        assert stage.launcher.done == [("wait for", "v02")]
    await stage.supervisor.all_ended()
    assert stage.launcher.done == [("wait for", "v02")]


@on_a_loop
async def test_a_process_started_by_hand_is_told_to_go_whatever_ends_it() -> None:
    stage = joined(launch=False)
    await stage.supervisor.end("v02", killed=True, reason="killed by a fault")
    assert stage.attachment.sent == [("v02", wire.End(None, "killed by a fault"))]
    stage.supervisor.begin_again(["v02"])
    assert stage.launcher.done == [], "whoever started it may start it again"
    stage.hello("v02", b"2")
    assert stage.supervisor.take_returned() == ["v02"]


@on_a_loop
async def test_a_vehicle_that_enters_has_its_process_started_unless_it_is_there_already() -> None:
    stage = joined(later=["v02", "v03"])
    stage.hello("v03", b"1")
    stage.supervisor.begin_again(["v02", "v03"])
    assert stage.launcher.done == [("start", "v02")]
    assert stage.supervisor.take_returned() == ["v03"]


@on_a_loop
async def test_in_real_time_a_paused_process_is_stopped_and_continued() -> None:
    stage = joined(pacing="realtime")
    stage.supervisor.pause({"v02", "v03"})
    stage.supervisor.pause({"v03", "v04"})
    assert states(stage) == [RUNNING, RUNNING, PAUSED, PAUSED]
    stage.supervisor.pause(())
    assert stage.launcher.done == [
        ("SIGSTOP", "v02"),
        ("SIGSTOP", "v03"),
        ("SIGCONT", "v02"),
        ("SIGSTOP", "v04"),
        ("SIGCONT", "v03"),
        ("SIGCONT", "v04"),
    ]


@on_a_loop
async def test_in_lockstep_a_paused_process_is_given_no_grant_and_no_signal() -> None:
    stage = joined()
    stage.supervisor.pause({"v02"})
    assert states(stage) == [RUNNING, PAUSED, RUNNING, RUNNING]
    assert stage.launcher.done == []


@on_a_loop
async def test_a_paused_process_is_continued_before_it_is_told_to_end() -> None:
    stage = joined(pacing="realtime")
    stage.supervisor.pause({"v02"})
    await stage.supervisor.end("v02", killed=False, reason="it has left")
    assert stage.launcher.done[:2] == [("SIGSTOP", "v02"), ("SIGCONT", "v02")]
    await stage.supervisor.all_ended()


@on_a_loop
async def test_a_process_that_returns_within_a_pause_is_paused_when_it_has_joined() -> None:
    stage = joined(pacing="realtime")
    await stage.supervisor.end("v02", killed=True, reason="killed by a fault")
    stage.supervisor.pause({"v02"})
    stage.supervisor.begin_again(["v02"])
    stage.supervisor.pause({"v02"})
    assert states(stage)[1] is RETURNING and ("SIGSTOP", "v02") not in stage.launcher.done
    stage.hello("v02", b"2")
    assert stage.supervisor.take_returned() == ["v02"]
    assert states(stage)[1] is PAUSED
    assert stage.launcher.done[-1] == ("SIGSTOP", "v02")


# Ends that nobody has ordered.


@on_a_loop
async def test_a_death_is_told_once_with_how_it_came() -> None:
    stage = joined([["v01", "v02"], ["v03"], ["v04"]])
    stage.launcher.dies(stage.supervisor, "v01")
    assert stage.supervisor.take_deaths() == {"v01": {"how": "SIGSEGV", "log_tail": "its last line"}}
    assert states(stage) == [DEAD, RUNNING, RUNNING]
    stage.launcher.dies(stage.supervisor, "v01")
    assert stage.supervisor.take_deaths() == {}


@on_a_loop
async def test_deaths_wait_until_they_are_taken() -> None:
    stage = joined()
    for process_id in ("v03", "v02"):
        stage.launcher.dies(stage.supervisor, process_id)
    assert list(stage.supervisor.take_deaths({"v03", "v04"})) == ["v03"]
    assert list(stage.supervisor.take_deaths()) == ["v02"]
    assert stage.supervisor.take_deaths() == {}


@on_a_loop
async def test_a_fault_that_is_faster_than_the_news_of_a_death_takes_its_place() -> None:
    stage = joined()
    stage.launcher.dies(stage.supervisor, "v02")
    await stage.supervisor.end("v02", killed=True, reason="killed by a fault")
    assert stage.supervisor.take_deaths() == {}
    stage.supervisor.begin_again(["v02"])
    stage.hello("v02", b"2")
    assert stage.supervisor.take_returned() == ["v02"]


@on_a_loop
async def test_late_news_that_a_process_died_is_not_taken_for_the_next_one_of_that_name() -> None:
    stage = joined()
    await stage.supervisor.end("v02", killed=True, reason="killed by a fault")
    stage.supervisor.begin_again(["v02"])
    stage.supervisor.child_ended("v02", Exit(-11, "the last line of the one before"))
    assert states(stage)[1] is RETURNING
    stage.hello("v02", b"2")
    assert stage.supervisor.take_returned() == ["v02"]
    stage.supervisor.child_ended("v02", Exit(-11, "the last line of the one before"))
    assert states(stage)[1] is RUNNING
    assert stage.supervisor.take_deaths() == {}


@on_a_loop
async def test_a_process_that_dies_while_it_starts_is_no_longer_awaited() -> None:
    stage = joined()
    await stage.supervisor.end("v02", killed=True, reason="killed by a fault")
    stage.supervisor.begin_again(["v02"])
    stage.launcher.dies(stage.supervisor, "v02", status=1)
    assert stage.supervisor.returning_nodes(IDS) == []
    assert stage.supervisor.take_deaths() == {"v02": {"how": "exit status 1", "log_tail": "its last line"}}


@pytest.mark.parametrize("process", ["agent v02", "process router"])
@on_a_loop
async def test_before_the_start_a_process_that_ends_is_why_there_is_none(process: str) -> None:
    stage = Stage()
    stage.launcher.dies(stage.supervisor, process.split()[1], status=2)
    assert isinstance(stage.supervisor.failure, VnetError)
    assert str(stage.supervisor.failure) == f"{process} ended before the start (exit status 2): its last line"


@on_a_loop
async def test_a_recorder_that_ends_does_the_run_no_harm() -> None:
    stage = Stage()
    stage.launcher.dies(stage.supervisor, "recorder")
    assert stage.supervisor.failure is None
    assert stage.events("observer_ended") == [("observer_ended", "recorder")]


@on_a_loop
async def test_the_end_of_a_process_started_by_hand_is_told_by_its_connection() -> None:
    stage = joined([["v01", "v02"], ["v03"], ["v04"]], launch=False)
    stage.supervisor.disconnected("v02")  # not the node that speaks for the process
    stage.supervisor.disconnected("v03")
    stage.supervisor.reconnecting = True
    stage.supervisor.disconnected("v04")  # the emulator's own doing
    while not stage.supervisor.processes_in(DEAD):
        await stage.changes.wait(10)
    assert states(stage) == [RUNNING, DEAD, RUNNING]
    details = {"how": "its connection closed", "process": "process 7 on host"}
    assert stage.supervisor.take_deaths() == {"v03": details}


@pytest.mark.parametrize("launch", [True, False])
@on_a_loop
async def test_who_ends_after_all_were_told_to_has_not_died(launch: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = joined(launch=launch)
    stage.launcher.pids.clear()
    ended: dict[str, Exit] = {}
    monkeypatch.setattr(stage.launcher, "ended", lambda: ended, raising=False)

    def end(name: str) -> None:
        if not launch:
            stage.supervisor.disconnected(name)
            return
        ended.clear()
        ended[name] = Exit(0, "")
        stage.supervisor._children_ended()

    end("v02")
    stage.supervisor.all_told_to_end()
    end("v03")
    while RUNNING in states(stage)[1:3]:
        await stage.changes.wait(10)
    assert states(stage) == [RUNNING, DEAD, AWAY, RUNNING]
    assert list(stage.supervisor.take_deaths()) == ["v02"]


@on_a_loop
async def test_a_connection_that_closes_says_nothing_of_a_process_of_the_run_s_own() -> None:
    stage = joined()
    stage.launcher.pids.clear()  # it has ended, and how will be told by the system
    stage.supervisor.disconnected("v02")
    assert states(stage) == [RUNNING] * 4


@on_a_loop
async def test_a_node_that_goes_before_the_start_is_awaited_again() -> None:
    stage = Stage(launch=False)
    stage.join(begin=False)
    stage.supervisor.disconnected("v02")
    assert stage.members.missing == ["v02"]


@pytest.mark.slow
def test_children_that_end_are_noticed_with_and_without_signals() -> None:
    async def run() -> None:
        stage = Stage()
        ended: list[str] = []
        child = subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE)
        noticed = asyncio.Event()

        def look() -> dict[str, Any]:
            if child.poll() is not None and not ended:
                ended.append("v01")
                noticed.set()
            return {}

        stage.launcher.ended = look  # type: ignore[attr-defined]
        before = signal.getsignal(signal.SIGCHLD)
        with stage.supervisor.watching_children():
            assert child.stdin is not None
            child.stdin.close()
            await asyncio.wait_for(noticed.wait(), 60)
        assert signal.getsignal(signal.SIGCHLD) is before

    asyncio.run(run())
    asyncio.run(asyncio.wait_for(asyncio.to_thread(asyncio.run, run()), 120))


operations = st.lists(
    st.tuples(
        st.sampled_from(["kill", "restart", "start", "pause", "dies", "disconnected", "hello", "take_returned"]),
        st.sampled_from(IDS),
    ),
    max_size=30,
)


@pytest.mark.slow
@example(operations=[("pause", "v01"), ("dies", "v01"), ("restart", "v01")], pacing="realtime", launch=True)
@given(operations=operations, pacing=st.sampled_from(["lockstep", "realtime"]), launch=st.booleans())
def test_whatever_happens_in_whatever_order_every_process_has_one_state_and_stops_only_while_paused(
    operations: list[tuple[str, str]], pacing: str, launch: bool
) -> None:
    async def run() -> None:
        stage = joined(ALONE, launch=launch, pacing=pacing)
        supervisor, paused = stage.supervisor, set[str]()
        for number, (verb, node) in enumerate(operations):
            state = supervisor.state(node)
            if verb in ("kill", "restart") and state is not AWAY:
                await supervisor.end(node, verb == "kill", "a fault")
                assert supervisor.state(node) is AWAY
            elif verb == "start" and state is AWAY:
                supervisor.begin_again([node])
                assert supervisor.state(node) is RETURNING
            elif verb == "pause":
                paused ^= {node}
                supervisor.pause(set(paused))
            elif verb == "dies" and (launch and node in stage.launcher.pids):
                stage.launcher.dies(supervisor, node)
                stage.launcher.done.append(("dies", node))
                assert supervisor.state(node) is DEAD
            elif verb == "disconnected":
                supervisor.disconnected(node)
            elif verb == "hello":
                stage.members.hello(node, wire.Hello(node, node, b"%d" % number, 7, "host", ready=True))
            elif verb == "take_returned":
                assert all(supervisor.state(each) in (RUNNING, PAUSED) for each in supervisor.take_returned())
            for each in IDS:
                now = supervisor.state(each)
                assert (now is PAUSED) == (now in (RUNNING, PAUSED) and each in paused)
        supervisor.pause(())
        await supervisor.all_ended()
        stopped: set[str] = set()
        for verb, *names in stage.launcher.done:
            if verb == "SIGSTOP":
                assert names[0] not in stopped
                stopped.add(names[0])
            elif verb in ("SIGCONT", "kill", "start", "dies"):
                stopped.discard(names[0])
        assert not stopped, "nothing is left stopped"

    asyncio.run(run())
