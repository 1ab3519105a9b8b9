"""Exceptions that nobody handles make a run invalid; whatever asyncio takes for handled does not."""

import asyncio
import contextlib
import gc
import json
import logging
import signal
import sys
import threading
from collections.abc import Awaitable, Callable
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from emulator.checks.judge import judge
from emulator.checks.run import check_no_exceptions
from emulator.drivers.conclude import conclude
from emulator.drivers.emulation import MOST_EXCEPTIONS, Emulation
from emulator.records.events import Event, kinds_of
from emulator.records.recorded_run import RecordedRun
from emulator.records.verdicts import CheckResult, Verdict
from tests.support.multi_loop_driver import run_apart, run_forked, run_together, scenario_of
from vnet.node import Node
from vnet.runtime.unhandled import UnhandledExceptions

pytestmark = pytest.mark.slow

Run = Callable[[Any], Emulation]
Program = Callable[[Node], Awaitable[None]]
held: list[object] = []
"""Objects that a program's process holds when the run ends."""


@pytest.fixture(autouse=True)
def _quiet(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.CRITICAL, "asyncio")
    held.clear()


async def fails(after_s: float = 0.5) -> None:
    await asyncio.sleep(after_s)
    raise ValueError("boom")


async def sends(node: Node) -> None:
    async for _ in node.gnss:
        await node.radio.broadcast(b"x")


# Programs whose exceptions nobody handles.


def half_way(act: Callable[[], object]) -> Program:
    """Return a program that does something at half a second, holds nothing of it, and goes on."""

    async def program(node: Node) -> None:
        await asyncio.sleep(0.5)
        act()
        await sends(node)

    return program


def job() -> asyncio.Future[int]:
    return asyncio.get_running_loop().run_in_executor(None, int, "x")


async def forgets_a_task(node: Node) -> None:
    asyncio.create_task(fails())  # noqa: RUF006
    await sends(node)


async def holds_a_task(node: Node) -> None:
    task = asyncio.create_task(fails())
    await sends(node)
    await task


async def leaves_a_task_to_the_collector(node: Node) -> None:
    async def knows_itself() -> None:
        task = asyncio.current_task()
        await asyncio.sleep(0.5)
        raise ValueError(f"boom of {task is not None}")

    asyncio.create_task(knows_itself())  # noqa: RUF006
    await sends(node)


async def collects(node: Node) -> None:
    asyncio.get_running_loop().call_later(1.0, gc.collect)
    await leaves_a_task_to_the_collector(node)


async def fails_a_future(node: Node) -> None:
    await asyncio.sleep(0.5)
    held.append(future := asyncio.get_running_loop().create_future())
    future.set_exception(ValueError("boom"))
    await sends(node)


async def shields_and_forgets(node: Node) -> None:
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(asyncio.shield(fails()), 0.1)
    await sends(node)


async def fails_at_the_end(node: Node) -> None:
    try:
        await sends(node)
    finally:
        raise ValueError("boom")


async def a_task_fails_at_the_end(node: Node) -> None:
    held.append(asyncio.create_task(fails_at_the_end(node)))
    await asyncio.sleep(99)


async def waits_for_itself(node: Node) -> None:
    lock = asyncio.Lock()
    async with lock, lock:
        pass


async def waits_crosswise(node: Node) -> None:
    locks = asyncio.Lock(), asyncio.Lock()

    async def takes(first: asyncio.Lock, second: asyncio.Lock) -> None:
        async with first:
            await asyncio.sleep(0.5)
            async with second:
                pass

    await asyncio.gather(takes(*locks), takes(*locks[::-1]))


async def consumes_for_ever(node: Node) -> None:
    queue: asyncio.Queue[bytes] = asyncio.Queue()
    await queue.put(b"")
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(node.gnss.receive(), 0.01)
    while True:
        await queue.get()


UNHANDLED: dict[Program, tuple[str, float]] = {
    forgets_a_task: ("in a task", 0.5),
    holds_a_task: ("in a task", 0.5),
    leaves_a_task_to_the_collector: ("in a task", 0.5),
    collects: ("in a task", 0.5),
    half_way(lambda: asyncio.get_running_loop().call_later(0.2, lambda: 1 / 0)): ("in a callback", 0.7),
    half_way(lambda: asyncio.get_running_loop().call_soon(int, "x")): ("in a callback", 0.5),
    half_way(lambda: asyncio.create_task(asyncio.sleep(0)).add_done_callback(lambda _: int("x"))): (
        "in a callback",
        0.5,
    ),
    half_way(job): ("in an executor job", 0.5),
    half_way(lambda: held.append(job())): ("in an executor job", 0.5),
    half_way(lambda: asyncio.gather(fails(0), asyncio.sleep(9))): ("in a task", 0.5),
    half_way(lambda: held.append(asyncio.gather(fails(0), fails(0.2)))): ("in a task", 0.5),
    shields_and_forgets: ("in a task", 0.5),
    fails_a_future: ("in a future", 0.5),
    fails_at_the_end: ("in main", 3.0),
    a_task_fails_at_the_end: ("in a task", 3.0),
    waits_for_itself: ("in a task", 3.0),
    waits_crosswise: ("in all tasks", 3.0),
    consumes_for_ever: ("in a task", 3.0),
}


# Programs that handle them.


async def gathers(node: Node) -> None:
    await asyncio.gather(fails(), asyncio.sleep(0.1), return_exceptions=True)
    with pytest.raises(ValueError):
        await asyncio.gather(fails(), fails(0.7))
    await sends(node)


async def waits_for(node: Node) -> None:
    with pytest.raises(ValueError):
        await asyncio.wait_for(fails(), 1.0)
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(fails(), 0.1)
    await sends(node)


async def groups(node: Node) -> None:
    with pytest.raises(ExceptionGroup):
        async with asyncio.TaskGroup() as group:
            group.create_task(fails())
            group.create_task(fails(0.5))
            group.create_task(asyncio.sleep(9))
    await sends(node)


async def shields(node: Node) -> None:
    inner = asyncio.create_task(fails())
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(asyncio.shield(inner), 0.1)
    with pytest.raises(ValueError):
        await inner
    await sends(node)


async def cancels(node: Node) -> None:
    task = asyncio.create_task(fails())
    await asyncio.sleep(0.2)
    task.cancel()
    await sends(node)


async def awaits_late(node: Node) -> None:
    task = asyncio.create_task(fails())
    await asyncio.sleep(2.0)
    with pytest.raises(ValueError):
        await task
    await sends(node)


async def awaits_at_the_end(node: Node) -> None:
    task = asyncio.create_task(fails())
    try:
        await sends(node)
    finally:
        assert isinstance(task.exception(), ValueError)


async def awaits_a_job(node: Node) -> None:
    with pytest.raises(ValueError):
        await asyncio.to_thread(int, "x")
    await sends(node)


async def sleeps_for_ever(node: Node) -> None:
    await asyncio.sleep(1e18)


async def listens_to_nobody(node: Node) -> None:
    done = asyncio.Event()
    listener = asyncio.create_task(node.radio.receive())
    listener.add_done_callback(lambda _: done.set())
    while True:
        await done.wait()
        done.clear()
        listener = asyncio.create_task(node.radio.receive())
        listener.add_done_callback(lambda _: done.set())


async def waits_for_a_thread(node: Node) -> None:
    never = threading.Event()
    threading.Thread(target=never.wait, daemon=True).start()
    try:
        await asyncio.Event().wait()
    finally:
        never.set()


async def has_a_handler(node: Node) -> None:
    asyncio.get_running_loop().set_exception_handler(lambda loop, context: None)
    await forgets_a_task(node)


async def handles_what_is_its_own(node: Node) -> None:
    if node.id != "v01":
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: None)
        assert asyncio.get_running_loop().get_exception_handler() is not None
    else:
        assert asyncio.get_running_loop().get_exception_handler() is None
    await forgets_a_task(node)


@pytest.mark.parametrize("run", [run_together, run_forked])
def test_an_exception_handler_is_that_of_its_vehicle_alone(run: Run) -> None:
    emulation = run(scenario_of([], entry(handles_what_is_its_own), run={"nodes_per_process": 2}))
    assert [event.node for event in exceptions(emulation)] == ["v01"]


HANDLED = [
    gathers, waits_for, groups, shields, cancels, awaits_late, awaits_at_the_end, awaits_a_job, sleeps_for_ever,
    listens_to_nobody, waits_for_a_thread, has_a_handler,
]  # fmt: skip


def entry(program: Program) -> str:
    return f"{program.__module__}:{program.__name__}"


def exceptions(emulation: Emulation) -> list[Event]:
    return [event for event in emulation.folder.events if event.kind == "exception"]


def judged(emulation: Emulation) -> CheckResult:
    judgement, _ = conclude(emulation, 1.0, "simulate")
    return next(check for check in judgement.checks if check.name == "no_exceptions")


RUNS = {
    "simulated": (run_together, 1),
    "processes": (run_apart, 1),
    "shared": (run_apart, 2),
    "forked": (run_forked, 1),
}


async def fails_its_own_way(node: Node) -> None:
    await [*UNHANDLED][int(node.id[1:]) - 1](node)


async def handles_its_own_way(node: Node) -> None:
    await HANDLED[int(node.id[1:]) - 1](node)


def run_all(program: str, count: int, run: str) -> Emulation:
    """Run a program of `count` vehicles, each of which does another thing."""
    drive, nodes_per_process = RUNS[run]
    return drive(scenario_of([], program, vehicles=count, run={"nodes_per_process": nodes_per_process}))


def places(emulation: Emulation) -> list[tuple[str | None, tuple[str, float]]]:
    """Return of each exception its vehicle, where it was raised and when."""
    events = exceptions(emulation)
    assert all("Error" in event.details["where"] for event in events)
    return sorted((e.node, (e.details["place"].partition(" (")[0], e.time_ns / 1e9)) for e in events)


@pytest.mark.parametrize("run", RUNS)
def test_what_nobody_handles_is_told_with_its_instant(run: str) -> None:
    emulation = run_all(entry(fails_its_own_way), len(UNHANDLED), run)
    assert places(emulation) == [(f"v{n:02}", told) for n, told in enumerate(UNHANDLED.values(), 1)]
    assert judged(emulation).verdict is Verdict.INVALID


def test_what_a_program_handles_is_none() -> None:
    emulation = run_all(entry(handles_its_own_way), len(HANDLED), "simulated")
    assert exceptions(emulation) == []
    assert judged(emulation).verdict is Verdict.VALID
    assert not [event for event in emulation.folder.events if event.kind == "crashed"]


def test_the_node_goes_on_and_the_trace_does_not_depend_on_it() -> None:
    failing = run_together(scenario_of([], entry(forgets_a_task)))
    sound = run_together(scenario_of([], entry(sends)))
    assert failing.engine.trace.to_table().equals(sound.engine.trace.to_table())


FAULTS = [
    {"kind": "kill", "at_s": 1.0, "duration_s": 0.5, "nodes": {"ids": ["v01"]}},
    {"kind": "restart", "at_s": 1.1, "duration_s": 0.4, "nodes": {"ids": ["v02"]}},
]


@pytest.mark.parametrize("program", [forgets_a_task, holds_a_task, fails_at_the_end, collects])
def test_faults_on_processes_change_nothing_between_live_and_simulated(program: Callable[..., Any]) -> None:
    # What is left of the killed would fail when collected.
    faults = FAULTS[1:] if program is fails_at_the_end else FAULTS
    together, apart = (run(scenario_of(faults, entry(program))) for run in (run_together, run_apart))

    def told(emulation: Emulation) -> list[tuple[Any, ...]]:
        return sorted((event.time_ns, event.node, event.details["place"]) for event in exceptions(emulation))

    assert told(together) == told(apart)
    forked = run_forked(scenario_of(faults, entry(program)))
    assert [(e.time_ns, e.kind, e.node) for e in forked.folder.events] == [
        (e.time_ns, e.kind, e.node) for e in together.folder.events
    ]
    restarted = [time_ns / 1e9 for time_ns, node, _ in told(apart) if node == "v02"]
    killed = [time_ns / 1e9 for time_ns, node, _ in told(apart) if node == "v01"]
    if program is fails_at_the_end:
        assert (restarted, killed) == ([1.1, 3.0], [3.0])
    elif program is forgets_a_task:
        assert (restarted, killed) == ([0.5, 2.0], [0.5, 2.0])
    else:
        assert (restarted, killed) == ([0.5, 2.0], [2.0]), "the killed one might have awaited it"


async def fails_often(node: Node) -> None:
    while True:
        asyncio.get_running_loop().call_soon(int, f"x of {node.id}")
        await asyncio.sleep(0.1)


def test_a_flood_is_cut_and_counted() -> None:
    emulation = run_together(scenario_of([], entry(fails_often), vehicles=2))
    check = judged(emulation)
    assert len(exceptions(emulation)) == 2 * MOST_EXCEPTIONS
    left_out = [
        (e.node, e.details["what"], e.details["count"]) for e in emulation.folder.events if e.kind == "left_out"
    ]
    assert left_out == [("v01", "exception", 30 - MOST_EXCEPTIONS), ("v02", "exception", 30 - MOST_EXCEPTIONS)]
    assert check.figures["count"] == 60
    assert check.text.startswith("2 vehicles: ValueError: invalid literal for int() with base 10: 'x of v01', in")


async def exits(node: Node) -> None:
    async def leave() -> None:
        await asyncio.sleep(0.5)
        raise SystemExit(3 if node.id == "v01" else 0)

    held.append(asyncio.create_task(leave()))
    await sends(node)


@pytest.mark.parametrize("run", [run_together, run_apart])
def test_sys_exit_in_a_task_ends_the_node_alone(run: Run) -> None:
    emulation = run(scenario_of([], entry(exits), vehicles=3))
    ended = [(event.kind, event.node, event.time_ns) for event in emulation.folder.events if event.node]
    kinds = {"v01": "crashed", "v02": "finished", "v03": "finished"}
    assert ended == [(kind, node, 500_000_000) for node, kind in kinds.items()]


async def interrupts(node: Node) -> None:
    await asyncio.sleep(0.5)
    if node.id == "v01":
        raise KeyboardInterrupt
    asyncio.get_running_loop().call_soon(signal.default_int_handler, 2, None)
    await sends(node)


async def awaits_what_it_cancelled(node: Node) -> None:
    await asyncio.sleep(0.5)
    task = asyncio.create_task(asyncio.sleep(9))
    task.cancel()
    await task


async def leaves_as_a_generator(node: Node) -> None:
    await asyncio.sleep(0.5)
    raise GeneratorExit


async def exits_in_a_callback(node: Node) -> None:
    asyncio.get_running_loop().call_later(0.5, sys.exit, 3)
    await sends(node)


async def exits_at_the_end(node: Node) -> None:
    async def leave() -> None:
        try:
            await asyncio.sleep(99)
        finally:
            raise SystemExit(3)

    held.append(asyncio.create_task(leave()))
    await sends(node)


@pytest.mark.parametrize(
    ("program", "run"),
    [
        *product([awaits_what_it_cancelled, leaves_as_a_generator, exits_in_a_callback], [run_together, run_apart]),
        (interrupts, run_together),
    ],
)
def test_who_leaves_by_another_way_has_crashed(program: Callable[..., Any], run: Run) -> None:
    emulation = run(scenario_of([], entry(program), vehicles=2))
    ended = [(event.kind, event.node, event.time_ns) for event in emulation.folder.events if event.node]
    assert ended == [("crashed", "v01", 500_000_000), ("crashed", "v02", 500_000_000)]


def test_sys_exit_while_programs_are_ended_is_an_exception() -> None:
    emulation = run_together(scenario_of([], entry(exits_at_the_end), vehicles=2))
    told = [(event.node, event.details["error"]) for event in exceptions(emulation)]
    assert told == [("v01", "SystemExit: 3"), ("v02", "SystemExit: 3")]


def test_kinds_are_told_in_one_line_each() -> None:
    raised = [
        Event(500_000_000, "exception", f"v{n}", {"error": "ValueError", "place": "in a task (bg.py:5)"})
        for n in range(3)
    ]
    assert [str(kind) for kind in kinds_of(raised)] == [
        "3 vehicles: ValueError: in a task (bg.py:5), first at 0.5 s"
    ]
    crashed = [
        Event(0, "crashed", f"v{n}", {"error": "KeyError: 'x'", "where": 'File "a.py", line 3, in f'})
        for n in range(12)
    ]
    assert [str(kind) for kind in kinds_of(crashed)] == ["12 vehicles crashed at 0.0 s: KeyError: 'x'"]
    assert str(kinds_of([*crashed, Event(1, "crashed", "v99", crashed[0].details)])[0]).startswith(
        "13 vehicles crashed, first at"
    )
    (died,) = kinds_of([Event(1_250_000_000, "died", "v1", {"how": "SIGKILL"})])
    assert str(died) == "v1 died at 1.25 s: SIGKILL"


def test_without_a_start_nothing_is_known() -> None:
    emulation = run_together(scenario_of([], entry(sends), vehicles=2))
    conclude(emulation, 1.0, "simulate")
    recorded = RecordedRun.open(emulation.folder.path)
    assert judge(recorded).verdict is Verdict.VALID
    recorded.events[:] = [event for event in recorded.events if event.kind != "started"]
    finding = check_no_exceptions(recorded)
    assert isinstance(finding, CheckResult)
    assert finding.verdict is Verdict.UNKNOWN


async def stops_the_loop(node: Node) -> None:
    await asyncio.sleep(0.1)
    asyncio.get_running_loop().stop()


@pytest.mark.parametrize("run", [run_together, run_apart])
def test_a_program_that_stops_the_loop_has_crashed(run: Run) -> None:
    events = run(scenario_of([], f"{__name__}:stops_the_loop", vehicles=2)).folder.events
    crashes = [(event.node, event.details["error"][:25]) for event in events if event.kind == "crashed"]
    assert crashes == [("v01", "RuntimeError: loop.stop()"), ("v02", "RuntimeError: loop.stop()")]


class ForgottenMeanwhile(dict[int, Any]):
    """Failures of which another thread forgets one as soon as it has been looked up."""

    def get(self, key: int, default: Any = None) -> Any:
        return self.pop(key, default)


def test_a_failure_that_another_thread_forgets_meanwhile_is_told_all_the_same() -> None:
    told = UnhandledExceptions(lambda node: 5, "v01", lambda node, line: None)
    loop = asyncio.new_event_loop()
    future = loop.create_future()
    future.set_exception(ValueError("x"))
    told._note(future, None, "in a future")
    told._failures = ForgottenMeanwhile(told._failures)
    assert told._unhandled({"future": future, "exception": future.exception()}) is False
    assert [each.error for each in told.take()] == ["ValueError: x"]
    loop.close()


async def crashes_in_a_group(node: Node) -> None:
    async with asyncio.TaskGroup() as group, asyncio.TaskGroup() as inner:
        inner.create_task(fails())
        group.create_task(asyncio.sleep(1.0))


async def crashes_in_a_library(node: Node) -> None:
    await asyncio.sleep(0.5)
    json.loads("{")


async def a_group_fails_in_a_task(node: Node) -> None:
    held.append(asyncio.create_task(crashes_in_a_group(node)))
    await sends(node)


@pytest.mark.parametrize("run", [run_together, run_forked])
def test_a_group_is_told_as_its_first_exception_in_the_program_s_own_line(run: Run) -> None:
    line = fails.__code__.co_firstlineno + 2
    for program, kind in ((crashes_in_a_group, "crashed"), (a_group_fails_in_a_task, "exception")):
        event = next(e for e in run(scenario_of([], entry(program))).folder.events if e.kind == kind)
        assert event.details["error"] == "ValueError: boom"
        assert f"{Path(__file__).name}:{line}" in event.details["place"]


def test_a_crash_in_a_library_is_told_at_the_program_s_own_line() -> None:
    emulation = run_together(scenario_of([], entry(crashes_in_a_library)))
    (kind,) = kinds_of(event for event in emulation.folder.events if event.kind == "crashed")
    line = crashes_in_a_library.__code__.co_firstlineno + 2
    assert f"{Path(__file__).name}:{line}" in str(kind)


async def crashes_at_length(node: Node) -> None:
    await asyncio.sleep(0.5)
    raise ValueError("x" * 100_000)


def test_of_a_long_message_the_beginning_is_told() -> None:
    """Live, one of more than 64 MiB would be refused as a message, and the crash told as a hang."""
    emulation = run_together(scenario_of([], entry(crashes_at_length)))
    event = next(event for event in emulation.folder.events if event.kind == "crashed")
    assert event.details["error"].startswith("ValueError: xxx") and len(str(event.details)) < 20_000
    assert event.details["where"].startswith("Traceback") and "crashes_at_length" in event.details["where"]
