"""Exceptions in threads that programs start and in `__del__` count like those that asyncio tells of."""

import _thread
import asyncio
import contextlib
import gc
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any

import pytest

from emulator.records.verdicts import Verdict
from tests.emulator.drivers.test_unhandled import (
    RUNS,
    Program,
    entry,
    exceptions,
    half_way,
    judged,
    places,
    run_all,
    sends,
)
from tests.support.multi_loop_driver import run_together, scenario_of
from vnet.node import Node

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _nothing_left_by_other_tests() -> None:
    """Discard what an earlier test has left in a cycle: a run that finds it would be told of its failure."""
    gc.collect()


class FailsWhenDiscarded:
    def __del__(self) -> None:
        raise ValueError("boom")


def run_thread(target: Callable[..., object], *args: object) -> None:
    """Start a thread and wait for it, as no emulated time passes meanwhile."""
    thread = threading.Thread(target=target, args=args)
    thread.start()
    thread.join()


# Programs that are told of.


async def fails_in_a_thread(node: Node) -> None:
    await asyncio.sleep(0.5)
    run_thread(int, "x")
    await sends(node)


async def fails_in_a_thread_of_a_job(node: Node) -> None:
    await asyncio.sleep(0.5)
    await asyncio.to_thread(run_thread, int, "x")
    await sends(node)


async def fails_when_discarded_at_the_end(node: Node) -> None:
    kept = FailsWhenDiscarded()
    try:
        await sends(node)
    finally:
        del kept


async def ignores_the_end_of_a_generator(node: Node) -> None:
    def numbers() -> Any:
        try:
            yield 1
        finally:
            raise ValueError("boom")

    await asyncio.sleep(0.5)
    next(numbers())
    await sends(node)


async def fails_in_a_raw_thread(node: Node) -> None:
    await asyncio.sleep(0.5)
    before, begun = _thread._count(), threading.Event()

    def fails() -> None:
        begun.set()
        int("x")

    _thread.start_new_thread(fails, ())
    while not begun.is_set() or _thread._count() > before:  # no object to join; it counts from its own beginning on
        os.sched_yield()
    await asyncio.sleep(0.1)
    await sends(node)


async def submits_and_forgets(node: Node) -> None:
    await asyncio.sleep(0.5)
    with ThreadPoolExecutor(1) as executor:
        executor.submit(int, "x")
    await sends(node)


async def imports_an_executor_and_forgets(node: Node) -> None:
    await asyncio.sleep(0.5)

    class Named:
        def __init_subclass__(cls, name: str) -> None:
            cls.__module__ = name

    class Pool(Executor, Named, name="concurrent.futures.process"):
        def submit(self, *_: Any, **__: Any) -> Future[Any]:
            job: Future[Any] = Future()
            job.set_exception(ValueError("boom"))
            return job

    Pool().submit(int, "x")
    await sends(node)


TOLD: dict[Program, tuple[str, float]] = {
    submits_and_forgets: ("in an executor job", 0.5),
    imports_an_executor_and_forgets: ("in an executor job", 0.5),
    fails_in_a_thread: ("in a thread", 0.5),
    half_way(lambda: run_thread(run_thread, int, "x")): ("in a thread", 0.5),
    fails_in_a_thread_of_a_job: ("in a thread", 0.5),
    half_way(FailsWhenDiscarded): ("in __del__", 0.5),
    half_way(lambda: run_thread(FailsWhenDiscarded)): ("in __del__", 0.5),
    fails_when_discarded_at_the_end: ("in __del__", 3.0),
    ignores_the_end_of_a_generator: ("in numbers", 0.5),
}


async def fails_its_own_way(node: Node) -> None:
    await [*TOLD][int(node.id[1:]) - 1](node)


@pytest.mark.parametrize("run", RUNS)
def test_what_the_loop_never_sees_is_told_with_its_instant(run: str) -> None:
    emulation = run_all(entry(fails_its_own_way), len(TOLD), run)
    assert places(emulation) == [(f"v{n:02}", told) for n, told in enumerate(TOLD.values(), 1)]
    assert judged(emulation).verdict is Verdict.INVALID


def test_a_thread_without_an_object_is_told_of() -> None:
    emulation = run_together(scenario_of([], entry(fails_in_a_raw_thread), vehicles=2))
    assert sorted((event.node or "") for event in exceptions(emulation)) == ["v01", "v02"]


# Programs that are not.


async def submits_and_asks(node: Node) -> None:
    with ThreadPoolExecutor(1) as executor:
        job = executor.submit(int, "x")
        called_back = executor.submit(int, "x")
        called_back.add_done_callback(lambda job: None)
    await asyncio.sleep(1.0)
    with contextlib.suppress(ValueError):
        job.result()
    await sends(node)


@pytest.mark.parametrize("run", RUNS)
def test_a_job_whose_end_somebody_asks_for_is_handled(run: str) -> None:
    assert exceptions(run_all(entry(submits_and_asks), 2, run)) == []


async def leaves_a_thread(node: Node) -> None:
    run_thread(sys.exit, 3)
    await sends(node)


async def handles_it_by_a_hook(node: Node) -> None:
    ours, threading.excepthook = threading.excepthook, lambda failed: None
    run_thread(int, "x")
    threading.excepthook = ours
    await sends(node)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("program", [leaves_a_thread, handles_it_by_a_hook])
def test_what_ends_a_thread_quietly_is_none(program: Program) -> None:
    emulation = run_together(scenario_of([], entry(program), vehicles=2))
    assert exceptions(emulation) == []
    assert judged(emulation).verdict is Verdict.VALID


async def fails_in_a_job_whose_threads_another_started(node: Node) -> None:
    loop = asyncio.get_running_loop()
    if node.id == "v01":
        await loop.run_in_executor(None, int, "1")
    await asyncio.sleep(0.5)
    if node.id == "v02":
        await loop.run_in_executor(None, lambda: bool(FailsWhenDiscarded()))
    await sends(node)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_job_is_that_of_who_gave_it_whoever_started_the_thread() -> None:
    emulation = run_together(scenario_of([], entry(fails_in_a_job_whose_threads_another_started), vehicles=2))
    assert [event.node for event in exceptions(emulation)] == ["v02"]


async def is_answered_by_a_thread_in_vain(node: Node) -> None:
    loop = asyncio.get_running_loop()
    answer = loop.create_future()

    def give() -> None:
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(answer.set_result, None)

    run_thread(give)
    await answer


def test_who_is_never_answered_is_told_that_a_thread_was_refused() -> None:
    (told,) = exceptions(run_together(scenario_of([], entry(is_answered_by_a_thread_in_vain), vehicles=1)))
    error = told.details["error"]
    assert error.startswith("DeadlockError")
    assert "a thread called into the loop" in error


survivors: list[Callable[[], None]] = []
"""Ends of threads of vehicles that have been killed."""


async def outlives_its_vehicle(node: Node) -> None:
    if node.id == "v01" and node.incarnation == 0:
        killed = threading.Event()
        thread = threading.Thread(target=lambda: int("x" * killed.wait()))
        thread.start()
        survivors.extend([killed.set, thread.join])
    await asyncio.sleep(2.0)
    while survivors:
        survivors.pop(0)()
    await sends(node)


def test_a_thread_that_outlives_a_killed_vehicle_is_not_told_of() -> None:
    kill = {"kind": "kill", "at_s": 1.0, "duration_s": 1.5, "nodes": {"ids": ["v01"]}}
    emulation = run_together(scenario_of([kill], entry(outlives_its_vehicle), vehicles=2, run={"duration_s": 2.4}))
    assert survivors == []
    assert exceptions(emulation) == []


def test_the_hooks_are_given_back() -> None:
    before = (sys.unraisablehook, threading.excepthook)
    run_together(scenario_of([], entry(fails_in_a_thread), vehicles=2))
    assert (sys.unraisablehook, threading.excepthook) == before


async def collects_what_fails(node: Node) -> None:
    kept = FailsWhenDiscarded()
    kept.itself = kept  # type: ignore[attr-defined]
    del kept
    gc.collect()
    await sends(node)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_what_the_collector_finds_is_left_to_python() -> None:
    emulation = run_together(scenario_of([], entry(collects_what_fails), vehicles=2))
    assert exceptions(emulation) == []


class WaitsWhenDiscarded:
    """Part of a cycle; a collection that finds it goes on once it may."""

    def __init__(self, found: threading.Event, may_go_on: threading.Event) -> None:
        self.itself, self.found, self.may_go_on = self, found, may_go_on

    def __del__(self) -> None:
        self.found.set()
        self.may_go_on.wait(60)


async def fails_while_a_thread_collects(node: Node) -> None:
    found, may_go_on = threading.Event(), threading.Event()

    def collect() -> None:
        gc.disable()  # or another thread's collection finds it
        try:
            WaitsWhenDiscarded(found, may_go_on)
            gc.collect()
        finally:
            gc.enable()

    await asyncio.sleep(0.5)
    thread = threading.Thread(target=collect)
    thread.start()
    assert found.wait(60)
    loop = asyncio.get_running_loop()
    loop.call_soon(int, "x")
    loop.call_soon(may_go_on.set)
    loop.call_soon(thread.join)
    await sends(node)


def test_what_fails_while_another_thread_collects_is_told_at_once() -> None:
    """It counts although the vehicle is killed later; what a collection has found by then does not."""
    kill = {"kind": "kill", "at_s": 1.0, "duration_s": 9.0, "nodes": {"ids": ["v01"]}}
    emulation = run_together(scenario_of([kill], entry(fails_while_a_thread_collects), vehicles=1))
    assert [(event.node, event.time_ns) for event in emulation.folder.events if event.kind == "exception"] == [
        ("v01", 500_000_000)
    ]


async def has_groups_in_tasks(node: Node) -> None:
    async def group() -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(asyncio.sleep(99))
            await asyncio.sleep(99)

    async def holds_on() -> None:
        try:
            await asyncio.sleep(99)
        finally:
            await asyncio.sleep(99)

    tasks = [asyncio.create_task(each()) for each in (group, holds_on)]
    await sends(node)
    await asyncio.gather(*tasks)


def test_what_is_left_of_a_killed_vehicle_is_discarded_in_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    ignored: list[str] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda args: ignored.append(str(args.exc_value)))
    kill = {"kind": "kill", "at_s": 1.0, "duration_s": 1.0, "nodes": {"ids": ["v01"]}}
    emulation = run_together(scenario_of([kill], entry(has_groups_in_tasks), vehicles=2))
    assert [event.node for event in emulation.folder.events if event.kind == "restarted"] == ["v01"]
    assert exceptions(emulation) == []
    del emulation
    gc.collect()
    assert ignored == []
