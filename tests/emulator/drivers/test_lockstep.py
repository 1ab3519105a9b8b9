"""The barrier, with processes that are nothing but what they yield."""

import asyncio
import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.drivers.emulation import Emulation, ProcessActions
from emulator.drivers.lockstep import Lockstep, run_in_lockstep
from emulator.drivers.processes import Heard, Processes, ProtocolError
from emulator.radio.outcomes import Outcome
from tests.support.multi_loop_driver import emulation_of, fault, scenario_of
from vnet.radio import Packet, SentFrame
from vnet.runtime.arrivals import Mail
from vnet.transport import wire

IDS = ["v01", "v02", "v03", "v04"]
ALONE = [[node] for node in IDS]
MS = 1_000_000
PERIOD_NS = 200 * MS


def barrier(
    faults: Sequence[dict[str, Any]] = (), processes: Sequence[Sequence[str]] = ALONE, **sections: Any
) -> tuple[Lockstep, Emulation]:
    sections = {"radio": {"loss": 0.0}, **sections}
    emulation = emulation_of(scenario_of(list(faults), "agents.beacon:main", **sections))
    return Lockstep(emulation, processes), emulation


def yielded(
    grant: wire.Grant,
    timer_ns: int | None = None,
    radio: Sequence[str] = (),
    gnss: Sequence[str] = (),
    frames: Sequence[SentFrame] = (),
) -> wire.Yield:
    steps = [wire.Step(grant.time_ns, wire.Traffic(frames))] if frames else []
    return wire.Yield(b"n", grant.seq, timer_ns, radio, gnss, steps, 1)


def yield_all(lockstep: Lockstep, grants: dict[str, wire.Grant], **timers_ns: int) -> None:
    for process_id, grant in grants.items():
        lockstep.receive(process_id, yielded(grant, timers_ns.get(process_id)))


def times(grants: dict[str, wire.Grant]) -> dict[str, int]:
    return {process_id: grant.time_ns for process_id, grant in grants.items()}


def packets_of(lockstep: Lockstep, node: str) -> list[Packet]:
    return lockstep.take_mail(node).packets[node]


def fixes_ns(lockstep: Lockstep, node: str) -> list[int]:
    return [fix.time_ns for _, fix in lockstep.take_mail(node).fixes]


# One rule at a time.


def test_at_time_0_every_process_is_granted_its_first_instant() -> None:
    lockstep, _ = barrier()
    grants = lockstep.start()
    assert times(grants) == dict.fromkeys(IDS, 0)
    assert [grant.seq for grant in grants.values()] == [0] * 4
    assert lockstep.owed == dict.fromkeys(IDS, 0)


def test_nothing_is_granted_before_all_owed_yields_are_there() -> None:
    lockstep, _ = barrier()
    grants = lockstep.start()
    for process_id in IDS[:3]:
        lockstep.receive(process_id, yielded(grants[process_id], 10 * MS))
        with pytest.raises(AssertionError):
            lockstep.step()
    lockstep.receive("v04", yielded(grants["v04"], 20 * MS))
    assert times(lockstep.step()) == dict.fromkeys(IDS[:3], 10 * MS)


def test_only_those_are_granted_an_instant_who_have_something_to_do_at_it() -> None:
    lockstep, _ = barrier()
    yield_all(lockstep, lockstep.start(), v01=30 * MS, v02=10 * MS, v03=10 * MS)
    grants = lockstep.step()
    assert times(grants) == {"v02": 10 * MS, "v03": 10 * MS}
    assert lockstep.owed == {"v02": 1, "v03": 1}
    yield_all(lockstep, grants, v03=20 * MS)
    grants = lockstep.step()
    assert times(grants) == {"v03": 20 * MS}
    yield_all(lockstep, grants)
    assert times(lockstep.step()) == {"v01": 30 * MS}


def test_vehicles_have_driven_to_an_instant_before_who_wakes_at_it_is_granted_it() -> None:
    lockstep, emulation = barrier(network={"kind": "driven", "driven": {"road": "ring", "length_m": 600.0}})
    grants = lockstep.start()
    control_ns = emulation.next_control_ns()
    assert control_ns is not None
    yield_all(lockstep, grants, v01=control_ns)
    assert times(lockstep.step()) == {"v01": control_ns}
    assert (emulation.next_control_ns() or control_ns) > control_ns


@pytest.mark.parametrize("next_ms", [10, 33])
def test_a_timer_before_the_end_of_the_window_is_refused(next_ms: int) -> None:
    lockstep, _ = barrier(radio={"latency_ms": 4})
    yield_all(lockstep, lockstep.start(), v01=30 * MS)
    with pytest.raises(ProtocolError, match=rf"its next timer, {next_ms}000000, lies before the end .*, 34000000"):
        yield_all(lockstep, lockstep.step(), v01=next_ms * MS)


def test_a_task_that_waits_for_fixes_is_woken_by_each_and_gets_what_it_has_missed() -> None:
    lockstep, _ = barrier()
    for process_id, grant in lockstep.start().items():
        gnss = [process_id] if process_id == "v01" else []
        lockstep.receive(process_id, yielded(grant, 500 * MS if process_id == "v02" else None, gnss=gnss))
    grants = lockstep.step()
    assert times(grants) == {"v01": PERIOD_NS}
    assert fixes_ns(lockstep, "v01") == [PERIOD_NS]
    yield_all(lockstep, grants)
    grants = lockstep.step()
    assert times(grants) == {"v02": 500 * MS}
    assert fixes_ns(lockstep, "v02") == [200 * MS, 400 * MS]


def test_a_frame_wakes_whoever_waits_for_it_when_it_arrives_and_waits_for_the_others() -> None:
    lockstep, _ = barrier()
    for process_id, grant in lockstep.start().items():
        frames = [SentFrame("v01", b"hello")] if process_id == "v01" else []
        radio = [process_id] if process_id in ("v01", "v02") else []
        timer_ns = 900 * MS if process_id == "v03" else None
        lockstep.receive(process_id, yielded(grant, timer_ns, radio, frames=frames))
    grants = lockstep.step()
    assert list(grants) == ["v02"], "the sender does not hear itself"
    (packet,) = packets_of(lockstep, "v02")
    assert (packet.sender, packet.payload, packet.sent_ns) == ("v01", b"hello", 0)
    assert 0 < packet.received_ns == grants["v02"].time_ns < 900 * MS
    yield_all(lockstep, grants)
    grants = lockstep.step()
    assert times(grants) == {"v03": 900 * MS}
    assert [packet.payload for packet in packets_of(lockstep, "v03")] == [b"hello"]


def test_a_frame_that_arrives_as_a_window_ends_is_heard_in_the_next() -> None:
    lockstep, _ = barrier(
        radio={"latency_ms": 30.0, "jitter_ms": 0.0, "access_jitter_ms": 0.0, "bitrate_mbps": 8.0}
    )
    for process_id, grant in lockstep.start().items():
        timer_ns = {"v01": 100 * MS, "v02": 130 * MS}.get(process_id)
        lockstep.receive(process_id, yielded(grant, timer_ns, ["v03"] if process_id == "v03" else []))
    (grant,) = lockstep.step().values()
    airtime_ns = 1_000  # of a byte
    steps = [wire.Step(130 * MS - airtime_ns, wire.Traffic([SentFrame("v01", b"x")]))]
    lockstep.receive("v01", wire.Yield(b"n", grant.seq, None, [], [], steps, 1))
    grants = lockstep.step()
    assert list(grants) == ["v02"] and window(grants) == (130, 160)
    yield_all(lockstep, grants)
    assert times(lockstep.step()) == {"v03": 160 * MS}
    assert [packet.received_ns for packet in packets_of(lockstep, "v03")] == [160 * MS]


@pytest.mark.parametrize(
    ("seq", "traffic", "radio", "gnss"),
    [
        (1, wire.Traffic(), [], []),
        (0, wire.Traffic([SentFrame("v02", b"x")]), [], []),
        (0, wire.Traffic((), (), [wire.Ending("v02", "finished")]), [], []),
        (0, wire.Traffic(), ["v02"], []),
        (0, wire.Traffic(), [], ["v02"]),
    ],
    ids=["seq", "frame", "ending", "radio", "gnss"],
)
def test_a_yield_that_does_not_fit_its_grant_is_refused_and_still_owed(
    seq: int, traffic: wire.Traffic, radio: list[str], gnss: list[str]
) -> None:
    lockstep, _ = barrier()
    grants = lockstep.start()
    with pytest.raises(ProtocolError):
        lockstep.receive("v01", wire.Yield(b"n", seq, None, radio, gnss, [wire.Step(0, traffic)], 1))
    assert lockstep.owed["v01"] == 0
    lockstep.receive("v01", yielded(grants["v01"]))
    with pytest.raises(ProtocolError):
        lockstep.receive("v01", yielded(grants["v01"]))


def test_steps_in_advance_are_taken_when_their_time_comes_unless_their_process_has_died() -> None:
    lockstep, emulation = barrier()
    lockstep.ahead = IDS
    lockstep.start()
    for node in IDS:
        steps = [wire.Step(t * MS, wire.Traffic([SentFrame(node, b"x")])) for t in (50, 90)]
        with pytest.raises(ProtocolError):
            lockstep.receive(node, wire.Yield(b"n", 0, 90 * MS, [], [], steps, 1))
        lockstep.receive(node, wire.Yield(b"n", 0, 95 * MS, [], [], steps, 1))
    lockstep.died("v04", how="SIGKILL")
    grants = lockstep.step()
    assert times(grants) == dict.fromkeys(IDS[:3], 95 * MS)
    yield_all(lockstep, grants)
    lockstep.step()
    emulation.engine.drain()
    rows = emulation.engine.trace.to_table().to_pylist()
    assert {(row["sender"], row["sent_ns"]) for row in rows} == {(n, t * MS) for n in IDS[:3] for t in (50, 90)}


def test_a_process_that_died_owes_nothing_and_its_nodes_are_down() -> None:
    lockstep, emulation = barrier(processes=[["v01", "v02"], ["v03"], ["v04"]])
    grants = lockstep.start()
    lockstep.died("v01", how="SIGSEGV")
    lockstep.died("v01", how="told again")
    for process_id in ("v03", "v04"):
        lockstep.receive(process_id, yielded(grants[process_id], 10 * MS))
    assert times(lockstep.step()) == {"v03": 10 * MS, "v04": 10 * MS}
    assert [emulation.up[node] for node in IDS] == [False, False, True, True]
    died = [(event.node, event.details["how"]) for event in emulation.folder.events if event.kind == "died"]
    assert died == [("v01", "SIGSEGV"), ("v02", "SIGSEGV")]


def test_deaths_of_one_window_are_told_in_the_order_of_processes() -> None:
    lockstep, emulation = barrier(processes=[["v01"], ["v02"], ["v03"], ["v04"]])
    grants = lockstep.start()
    lockstep.receive("v02", yielded(grants["v02"], 10 * MS))
    for process_id in ("v04", "v01", "v03"):
        lockstep.died(process_id)
    assert times(lockstep.step()) == {"v02": 10 * MS}
    lockstep.died("v02")
    lockstep.tell_deaths()
    died = [event.node for event in emulation.folder.events if event.kind == "died"]
    assert died == ["v01", "v03", "v04", "v02"]


def test_faults_act_before_anything_else_of_their_instant() -> None:
    lockstep, emulation = barrier([fault("kill", 0.5, 0.3, "v02"), fault("pause", 0.5, 0.2, "v03")])
    yield_all(lockstep, lockstep.start(), **dict.fromkeys(IDS, 500 * MS))
    grants = lockstep.step()
    assert times(grants) == {"v01": 500 * MS, "v04": 500 * MS}
    (actions,) = lockstep.take_actions()
    assert (actions.stop, actions.paused) == ({"v02": True}, {"v03"})
    assert lockstep.take_actions() == [], "each is told once"
    yield_all(lockstep, grants)
    grants = lockstep.step()
    assert times(grants) == {"v03": 700 * MS}, "a paused process is granted the instant at which it resumes"
    assert grants["v03"].seq == 1
    yield_all(lockstep, grants)
    grants = lockstep.step()
    assert times(grants) == {"v02": 800 * MS}
    assert grants["v02"].seq == 0, "another process"
    assert [actions.start for actions in lockstep.take_actions()] == [[], ["v02"]]
    assert emulation.incarnation["v02"] == 1


def test_a_run_that_is_held_does_all_before_its_horizon_and_nothing_at_it() -> None:
    lockstep, emulation = barrier()
    lockstep.horizon_ns = 400 * MS
    yield_all(lockstep, lockstep.start(), v01=399 * MS, v02=400 * MS)
    grants = lockstep.step()
    assert times(grants) == {"v01": 399 * MS}
    yield_all(lockstep, grants)
    assert lockstep.step() == {} and lockstep.held
    assert len(emulation.metrics.rows) == 2, "the periods before it are recorded"
    assert lockstep.step() == {}, "and it stays held"
    lockstep.horizon_ns = None
    assert times(lockstep.step()) == {"v02": 400 * MS}
    assert not lockstep.held


def test_at_the_end_nobody_is_granted_anything_and_all_periods_are_recorded() -> None:
    lockstep, emulation = barrier()
    yield_all(lockstep, lockstep.start(), v01=emulation.duration_ns)
    assert lockstep.step() == {} and not lockstep.held
    assert len(emulation.metrics.rows) == emulation.duration_ns // PERIOD_NS


# Windows.


def window(grants: dict[str, wire.Grant]) -> tuple[int, int]:
    """Earliest granted time and the end of the window, in ms."""
    (end_ns,) = {grant.end_ns for grant in grants.values()}
    return min(grant.time_ns for grant in grants.values()) // MS, end_ns // MS


def test_a_window_is_as_long_as_the_least_latency_and_each_is_granted_its_own_first_instant() -> None:
    lockstep, _ = barrier(radio={"latency_ms": 30.0})
    yield_all(lockstep, lockstep.start(), v01=50 * MS, v02=60 * MS, v03=79 * MS, v04=80 * MS)
    grants = lockstep.step()
    assert times(grants) == {"v01": 50 * MS, "v02": 60 * MS, "v03": 79 * MS}
    assert window(grants) == (50, 80)


def test_without_windows_each_is_one_instant() -> None:
    lockstep, _ = barrier(radio={"latency_ms": 30.0}, run={"windows": False})
    yield_all(lockstep, lockstep.start(), v01=50 * MS, v02=50 * MS + 1)
    (grant,) = lockstep.step().values()
    assert (grant.time_ns, grant.end_ns) == (50 * MS, 50 * MS + 1)


@pytest.mark.parametrize(
    ("end_ms", "faults", "horizon_ms"),
    [(200, [], None), (120, [fault("kill", 0.12, 0.1, "v04")], None), (130, [], 130)],
    ids=["period", "fault", "horizon"],
)
def test_a_window_ends_before_anything_that_changes_the_network(
    end_ms: int, faults: list[dict[str, Any]], horizon_ms: int | None
) -> None:
    lockstep, _ = barrier(faults, radio={"latency_ms": 1000.0})
    lockstep.horizon_ns = None if horizon_ms is None else horizon_ms * MS
    grants = lockstep.start()
    assert window(grants) == (0, end_ms)
    assert lockstep.decided_ns == end_ms * MS - 1, "what is injected now acts after the window"


@pytest.mark.parametrize(
    ("times_ms", "message"),
    [([49], "a step at 49000000, where 50000000 to 79999999"), ([80], "80000000"), ([55, 55], "where 55000001 to")],
)
def test_a_step_outside_its_window_or_out_of_order_is_refused(times_ms: list[int], message: str) -> None:
    lockstep, _ = barrier(radio={"latency_ms": 30.0})
    yield_all(lockstep, lockstep.start(), v01=50 * MS)
    (grant,) = lockstep.step().values()
    steps = [wire.Step(time_ms * MS, wire.Traffic([SentFrame("v01", b"x")])) for time_ms in times_ms]
    with pytest.raises(ProtocolError, match=message):
        lockstep.receive("v01", wire.Yield(b"n", grant.seq, None, [], [], steps, 1))


def test_packets_of_a_window_are_shown_before_it_and_decided_after_it() -> None:
    lockstep, emulation = barrier(radio={"latency_ms": 30.0, "jitter_ms": 20.0, "access_jitter_ms": 0.0})
    for process_id, grant in lockstep.start().items():
        frames = [SentFrame("v01", b"x")] if process_id == "v01" else []
        lockstep.receive(process_id, yielded(grant, 30 * MS if process_id == "v01" else 31 * MS, frames=frames))
    grants = lockstep.step()
    assert window(grants) == (30, 60)
    arrivals_ns = {node: packets_of(lockstep, node)[0].received_ns for node in IDS[1:]}
    assert all(31 * MS < arrival_ns < 60 * MS for arrival_ns in arrivals_ns.values())
    assert [emulation.engine.counts[Outcome.delivered], emulation.engine.counts[Outcome.pending]] == [0, 3]
    # v02's program ends a nanosecond before its packet arrives, and v03's as it arrives.
    ends_ns = {"v02": arrivals_ns["v02"] - 1, "v03": arrivals_ns["v03"]}
    for process_id, grant in grants.items():
        ended = wire.Traffic((), (), [wire.Ending(process_id, "finished")])
        steps = [wire.Step(ends_ns[process_id], ended)] if process_id in ends_ns else []
        lockstep.receive(process_id, wire.Yield(b"n", grant.seq, None, [], [], steps, 1))
    assert lockstep.step() == {}
    rows = {row["receiver"]: row["outcome"] for row in emulation.engine.trace.to_table().to_pylist()}
    assert rows == {"v02": "receiver_down", "v03": "delivered", "v04": "delivered"}
    events = [(event.node, event.time_ns) for event in emulation.folder.events if event.kind == "finished"]
    assert sorted(events) == sorted(ends_ns.items())


def test_a_window_longer_than_the_least_latency_is_noticed() -> None:
    lockstep, _ = barrier(radio={"latency_ms": 1.0, "jitter_ms": 0.0})
    lockstep._lookahead_ns = 4 * MS
    grants = lockstep.start()
    for process_id, grant in grants.items():
        lockstep.receive(process_id, yielded(grant, 150 * MS, frames=[SentFrame(process_id, b"x")]))
    with pytest.raises(AssertionError, match="foreseen up to 3999999 ns"):
        lockstep.step()


def test_a_flood_that_nobody_takes_is_bounded_and_that_of_a_window_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("emulator.drivers.lockstep.INBOX_LIMIT", 5)
    radio = {
        "latency_ms": 30.0,
        "jitter_ms": 0.0,
        "access_jitter_ms": 0.0,
        "bitrate_mbps": 1000.0,
        "queue_frames": 50,
        "loss": 0.0,
    }
    lockstep, _ = barrier(radio=radio)
    for process_id, grant in lockstep.start().items():
        frames = [SentFrame("v01", bytes([n])) for n in range(20)] if process_id == "v01" else []
        timers_ns = {"v01": 100 * MS, "v02": 30 * MS, "v03": 110 * MS}
        lockstep.receive(process_id, yielded(grant, timers_ns.get(process_id), frames=frames))
    grants = lockstep.step()
    assert [each.payload[0] for each in packets_of(lockstep, "v02")] == list(range(20)), "it may take each in turn"
    yield_all(lockstep, grants)
    grants = lockstep.step()
    assert times(grants) == {"v01": 100 * MS, "v03": 110 * MS}
    assert [each.payload[0] for each in packets_of(lockstep, "v03")] == list(range(15, 20)), "the newest ones"


# All rules at once: vehicles that do something at random.


@dataclass
class Vehicle:
    """A program without a loop: what it does hangs on its own random numbers and on what it is told alone."""

    node: str
    incarnation: int
    seed: int
    timer_ns: int | None = None
    packets: list[wire.WirePacket] = field(default_factory=list)
    fixes: list[wire.WireFix] = field(default_factory=list)
    begun: bool = False

    def __post_init__(self) -> None:
        self.draw = random.Random(f"{self.seed}/{self.node}/{self.incarnation}")
        self.hears, self.locates = self.draw.random() < 0.7, self.draw.random() < 0.6

    @property
    def next_ns(self) -> float:
        """Time at which it has something to do, as far as it knows."""
        arrivals_ns = [packet.received_ns for packet in self.packets] if self.hears else []
        return min([math.inf if self.timer_ns is None else self.timer_ns, *arrivals_ns])

    def wake(self, now_ns: int, diary: list[tuple[Any, ...]]) -> list[SentFrame]:
        """Do what is to be done at this instant, and write it down."""
        come = [packet for packet in self.packets if packet.received_ns <= now_ns]
        packets, fixes = (come if self.hears else []), (self.fixes if self.locates else [])
        rings = self.timer_ns is not None and self.timer_ns <= now_ns
        if self.begun and not (packets or fixes or rings):
            return []
        self.begun = True
        told = [(p.sender, p.sent_ns, p.received_ns, p.payload) for p in packets], [f.time_ns for f in fixes]
        diary.append((now_ns, self.incarnation, *told, rings))
        self.packets, self.fixes = self.packets[len(come) :], []
        wait_ns = self.draw.choice([1, 10 * MS, 77_777_777, 200 * MS, None])
        self.timer_ns = None if wait_ns is None else now_ns + wait_ns
        if rings and wait_ns == 1:
            self.timer_ns = now_ns + 50 * MS  # not for ever in steps of a nanosecond
        # An answer to every packet would be answered without end.
        sent = self.draw.choice([0, 0, 1, 2]) if fixes or rings else self.draw.choice([0] * 9 + [1])
        return [
            SentFrame(self.node, f"{self.node} {self.incarnation} {len(diary)} {n}".encode()) for n in range(sent)
        ]


class Course(Processes):
    """Runs vehicles in processes to the end, and checks every grant. Yields come in any order."""

    def __init__(
        self, emulation: Emulation, groups: Sequence[Sequence[str]], seed: int, order: random.Random
    ) -> None:
        self.emulation = emulation
        self.permanent = len(groups) == 1
        self.lockstep = Lockstep(emulation, groups, permanent=self.permanent)
        self.groups = {nodes[0]: nodes for nodes in groups}
        self.seed = seed
        self.order = order
        self.vehicles = {node: Vehicle(node, 0, seed) for node in IDS}
        self.diary: dict[str, list[tuple[Any, ...]]] = {node: [] for node in IDS}
        self.sent_ns: dict[bytes, int] = {}
        self.seqs: dict[str, int] = {}
        self.paused: set[str] = set()
        self.answers: list[Heard] = []
        self.end_ns = self.barriers = 0

    def run(self) -> tuple[str, dict[str, list[tuple[Any, ...]]]]:
        asyncio.run(run_in_lockstep(self.lockstep, self))
        return self.emulation.engine.trace.sha256(), self.diary

    async def act(self, actions: ProcessActions) -> None:
        self.paused = actions.paused
        for node in actions.start:
            self.vehicles[node] = Vehicle(node, self.emulation.incarnation[node], self.seed)
            if not self.permanent:
                self.seqs.pop(node, None)

    def send(self, process_id: str, message: wire.Grant | wire.Batch, mail: Mail | None = None) -> None:
        assert isinstance(message, wire.Grant) and mail is not None
        self.barriers += not self.answers
        begin_ns = self.answers[0].arrived_ns if self.answers else self.end_ns
        assert begin_ns <= message.time_ns < message.end_ns, "windows are in order"
        self.end_ns = message.end_ns
        self.answers.append(Heard(process_id, self.answer(process_id, mail.within(message)), begin_ns))

    async def receive(self, timeout_s: float = math.inf) -> Heard:
        assert self.lockstep.owed.keys() == {each.process_id for each in self.answers}
        with pytest.raises(AssertionError):
            self.lockstep.step()  # while one of them is still owed
        return self.answers.pop(self.order.randrange(len(self.answers)))

    def answer(self, process_id: str, grant: wire.Grant) -> wire.Yield:
        """Give a process its grant, let its vehicles pass through the window, and yield."""
        assert grant.seq == self.seqs.get(process_id, -1) + 1
        self.seqs[process_id] = grant.seq
        for packet in grant.packets:
            assert self.sent_ns[packet.payload] == packet.sent_ns, "nothing is delivered that was not sent before"
            assert packet.sent_ns <= packet.received_ns < grant.end_ns
            self.vehicles[packet.node].packets.append(packet)
        for fix in grant.fixes:
            assert fix.time_ns <= grant.time_ns
            self.vehicles[fix.node].fixes.append(fix)
        nodes = [node for node in self.groups[process_id] if self.emulation.up[node] and node not in self.paused]
        steps = []
        now_ns = grant.time_ns
        while now_ns < grant.end_ns:
            frames = [f for node in nodes for f in self.vehicles[node].wake(now_ns, self.diary[node])]
            self.sent_ns |= {frame.payload: now_ns for frame in frames}
            steps += [wire.Step(now_ns, wire.Traffic(frames))] if frames else []
            now_ns = min([grant.end_ns, *(round(min(self.vehicles[node].next_ns, 2**62)) for node in nodes)])
        living = [self.vehicles[node] for node in self.groups[process_id] if self.emulation.up[node]]
        timers = [vehicle.timer_ns for vehicle in living if vehicle.timer_ns is not None]
        radio = [vehicle.node for vehicle in living if vehicle.hears]
        gnss = [vehicle.node for vehicle in living if vehicle.locates]
        return wire.Yield(b"n", grant.seq, min(timers, default=None), radio, gnss, steps, 1)


GROUPINGS = [ALONE, [["v01", "v02"], ["v03", "v04"]], [["v01"], ["v02", "v03", "v04"]], [IDS]]


def faults_of(kind: str, **more: Any) -> st.SearchStrategy[dict[str, Any]]:
    starts_s, durations_s = st.sampled_from([0.0, 0.1, 0.2, 0.35, 0.5]), st.sampled_from([0.1, 0.25, 0.4])
    return st.builds(lambda at_s, duration_s: fault(kind, at_s, duration_s, **more), starts_s, durations_s)


# Faults that act on all processes alike, so that any grouping of the nodes allows them.
schedules = st.lists(
    st.one_of(
        *map(faults_of, ["kill", "restart", "pause"]),
        faults_of("loss", probability=0.5),
        faults_of("delay", delay_ms=120),
    ),
    max_size=3,
)


@pytest.mark.slow
@settings(max_examples=6, deadline=None)
@given(
    faults=schedules,
    seed=st.integers(0, 1000),
    groups=st.sampled_from(GROUPINGS[1:]),
    order=st.randoms(use_true_random=False),
    latency_ms=st.sampled_from([0.001, 2.3, 20, 300]),
)
def test_neither_windows_nor_the_grouping_of_nodes_nor_the_order_of_yields_change_a_run(
    faults: list[dict[str, Any]], seed: int, groups: list[list[str]], order: random.Random, latency_ms: float
) -> None:
    run = {"duration_s": 1.6, "settle_s": 0.1, "seed": seed}
    one, windows = (
        scenario_of(faults, "agents.beacon:main", run={**run, "windows": windows}, radio={"latency_ms": latency_ms})
        for windows in (False, True)
    )
    reference = Course(emulation_of(one), ALONE, seed, random.Random(0)).run()
    for processes in (ALONE, groups):
        assert Course(emulation_of(windows), processes, seed, order).run() == reference
