"""Processes that a run starts: where they stand among the others of the machine."""

import os
import shutil
import signal
from pathlib import Path

import pytest

from emulator.drivers import launch
from emulator.drivers.launch import COMMAND, Launcher
from emulator.drivers.router import ROUTER, SeparateRouter
from tests.support.processes import has_ended, wait_until
from vnet.transport.access import Access

pytestmark = pytest.mark.slow

BASH = shutil.which("bash") or "bash"
SAY = "import os; print(os.getsid(0), os.getpgrp() == os.getpid())"


@pytest.mark.parametrize("own_session", [False, True], ids=["agent", "what must not starve"])
def test_a_process_has_its_own_group_in_the_session_of_who_starts_it_or_its_own(
    tmp_path: Path, own_session: bool
) -> None:
    """Ctrl-C must not reach it; and Linux gives processor time to sessions first, then to processes by niceness."""
    launcher = Launcher(tmp_path)
    launcher.start("v1", ["-c", SAY], None, {}, own_session=own_session)
    pid = launcher.pids["v1"]
    launcher.wait_for("v1", 60.0)
    launcher.stop()
    assert launcher.log_tail("v1").split() == [str(pid if own_session else os.getsid(0)), "True"]


@pytest.mark.parametrize(("states", "is_told"), [("R" * 50, False), ("RRDRRRS", True), ("S", True)])
def test_an_end_is_overdue_unless_the_process_wants_to_run_at_each_look(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, states: str, is_told: bool
) -> None:
    """One that sleeps again and again was once taken for one that gets no processor."""
    seen = iter(states)
    monkeypatch.setattr(launch, "_state_of", lambda _: next(seen))
    launcher = Launcher(tmp_path)
    launcher.start("v1", ["-c", "import time; time.sleep(600)"], None, {})
    monkeypatch.setattr(launch, "cpu_time_ns", lambda _: 0)
    ends = launcher.stop(0.01)
    assert [end.how for end in ends.values()] == (["did not end within 0.01 s"] if is_told else [])


def test_a_router_ends_however_often_it_is_told(tmp_path: Path) -> None:
    """The kernel signals once for each thread of a killed emulator that becomes its parent in turn."""
    launcher = Launcher(tmp_path)
    SeparateRouter(Access.create("r", [["v01"]]), tmp_path / "access").start(launcher)
    ended = launcher.ended()
    while not ended:  # it ends by itself within a minute, or never
        launcher.signal(ROUTER, signal.SIGTERM)
        ended = launcher.ended()
    assert ended[ROUTER].status == 0


FORKS = "import os, sys, time; child = os.fork(); child or time.sleep(600); print(child, flush=True)"
"""Forks a child that would stay for ten minutes."""


@pytest.mark.parametrize("then", ["", "; sys.exit(3)", "; time.sleep(600)"])
def test_what_a_process_has_forked_ends_with_it(tmp_path: Path, then: str) -> None:
    launcher = Launcher(tmp_path)
    launcher.start("v1", ["-c", FORKS + then], None, {})
    while not launcher.log_tail("v1").strip():
        os.sched_yield()
    child = int(launcher.log_tail("v1"))
    if "sleep" in then:
        launcher.kill("v1")
    else:
        launcher.wait_for("v1", 60.0)
        assert launcher.ended()["v1"].status == (3 if then else 0)
    launcher.stop()
    assert has_ended(child, 60)


@pytest.mark.parametrize("leave", ["set -m; sleep 600", "setsid sleep 600"])
def test_what_a_command_has_started_is_paused_and_ends_with_it_outside_of_its_group(
    tmp_path: Path, leave: str
) -> None:
    """Shells with job control, `setsid` and `script` put what they start into a group of its own."""
    launcher, environment = Launcher(tmp_path), {**os.environ, COMMAND: str(tmp_path)}
    launcher.start_command("v1", [BASH, "-c", f"{leave} & echo $!; wait"], environment, 0)
    wait_until(lambda: bool(launcher.log_tail("v1").strip()))
    child, shell = int(launcher.log_tail("v1")), launcher.pids["v1"]
    wait_until(lambda: os.getpgid(child) != os.getpgid(shell))
    for number, state in ((signal.SIGSTOP, "T"), (signal.SIGCONT, "S")):
        launcher.signal_group("v1", number)
        wait_until(lambda: {launch._state_of(pid) for pid in (child, shell)} == {state})  # noqa: B023
    launcher.kill("v1")
    assert has_ended(child, 60)


def test_a_vnet_that_a_command_has_started_takes_nothing_of_that_command_for_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It once killed itself as the first of its own processes ended."""
    monkeypatch.setenv(COMMAND, "of another run")
    launcher = Launcher(tmp_path)
    launcher.start("v1", ["-c", ""], None, {})
    process = launcher._processes["v1"]
    assert isinstance(process, launch.GroupProcess) and process._strays() == []
    launcher.wait_for("v1", 60.0)
    launcher.stop()


def test_agents_wait_as_long_as_they_may_join_for_a_router_that_many_ask(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of a thousand that connect at once has to wait for others."""
    started: list[list[str]] = []
    launcher = Launcher(tmp_path, patience_s=600.0)
    monkeypatch.setattr(launcher, "start", lambda name, arguments, *_: started.append(arguments))
    launcher.start_agents("tcp/127.0.0.1:1", Access.create("run", [["v01"]]), [["v01"]])
    options = iter(started[0])
    told = {option: next(options) for option in options if option.endswith("-timeout-s")}
    assert told == {"--connect-timeout-s": "600.0", "--join-timeout-s": "600.0"}
