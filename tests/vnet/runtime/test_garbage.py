"""Garbage of programs: when it is collected, and what acts then."""

import asyncio
import gc
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any

import pytest

from tests.vnet.runtime.test_host import World
from vnet import Node
from vnet.reports import Report
from vnet.runtime import host, outside_loop
from vnet.runtime.outside_loop import BLOCKS_A_COUNT, BLOCKS_FROZEN, MOST_UNCOLLECTED, collected_by_schedule
from vnet.transport import wire

SECOND_NS = 1_000_000_000
PERIOD_NS = 100_000_000


class InCycle:
    """An object that calls `act` when the collector finds it."""

    def __init__(self, act: Callable[[], object]) -> None:
        self.itself, self.act = self, act

    def __del__(self) -> None:
        self.act()


@pytest.fixture
def unfrozen(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Have nothing frozen; afterwards all is frozen again, as `tests/conftest.py` has done."""
    monkeypatch.setattr(outside_loop, "_found_frozen", 0)
    gc.unfreeze()
    yield
    gc.collect()
    gc.freeze()


@pytest.fixture
def thresholds() -> Iterator[tuple[int, int, int]]:
    """Have the collector's thresholds as they were, whatever a test does."""
    before = gc.get_threshold()
    yield before
    gc.set_threshold(*before)


@pytest.mark.usefixtures("unfrozen")
def test_the_collector_waits_within_the_block_alone(thresholds: tuple[int, int, int]) -> None:
    gc.set_threshold(500, 7, 8)
    with collected_by_schedule():
        with collected_by_schedule():
            assert gc.get_threshold()[0] == MOST_UNCOLLECTED
            assert gc.get_freeze_count() > 0
        assert gc.get_threshold()[0] == MOST_UNCOLLECTED
    assert gc.get_threshold() == (500, 7, 8)
    assert gc.get_freeze_count() == 0


@pytest.mark.slow
@pytest.mark.usefixtures("unfrozen")
@pytest.mark.parametrize(
    ("objects_before", "threshold", "collects"), [(1, 700, True), (1, 0, False), (10**9, 700, False)]
)
def test_what_earlier_runs_have_left_is_collected_once_it_is_much(
    objects_before: int,
    threshold: int,
    collects: bool,
    thresholds: tuple[int, int, int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(outside_loop, "_objects", objects_before)
    monkeypatch.setattr(outside_loop, "_blocks", BLOCKS_A_COUNT - 1)
    found: list[bool] = []
    left = InCycle(lambda: found.append(True))
    gc.set_threshold(threshold and 10**9)
    del left
    with collected_by_schedule():
        assert bool(found) is collects


def test_a_collector_that_is_switched_off_by_its_threshold_stays_so(thresholds: tuple[int, int, int]) -> None:
    gc.set_threshold(0)
    with collected_by_schedule():
        assert gc.get_threshold()[0] == 0
    assert gc.get_threshold()[0] == 0


@pytest.mark.usefixtures("unfrozen")
def test_what_was_frozen_before_stays_frozen_and_is_counted_seldom(monkeypatch: pytest.MonkeyPatch) -> None:
    count, counts = gc.get_freeze_count, []

    def counted() -> int:
        counts.append(count())
        return counts[-1]

    monkeypatch.setattr(gc, "get_freeze_count", counted)

    def pass_blocks(number: int) -> None:
        for _ in range(number):
            with collected_by_schedule():
                pass

    gc.freeze()
    pass_blocks(BLOCKS_FROZEN)
    assert len(counts) == 1 and count() > 0
    gc.unfreeze()
    pass_blocks(1)
    assert len(counts) == 2 and count() == 0
    gc.freeze()
    pass_blocks(1)
    assert len(counts) == 3 and count() > 0


@pytest.mark.parametrize("others", [(), ("v2",), ("v2", "v3")])
def test_garbage_is_found_at_the_next_second_whoever_shares_the_loop(others: tuple[str, ...]) -> None:
    found_ns: list[int] = []

    async def program(node: Node) -> None:
        if node.id != "v1":
            while True:
                await asyncio.sleep(0.07)
        for _ in range(4):
            await asyncio.sleep(0.65)
            InCycle(lambda: found_ns.append(node.now_ns))

    World(*others, "v1").run(program)
    assert found_ns == [SECOND_NS, 2 * SECOND_NS, 2 * SECOND_NS, 3 * SECOND_NS]


@pytest.fixture
def collects_each_period(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have young garbage collected each 100 ms, and so all of it each second."""
    monkeypatch.setattr(host, "COLLECTION_NS", PERIOD_NS)


@pytest.mark.slow
@pytest.mark.usefixtures("collects_each_period")
def test_nothing_is_collected_where_nothing_has_run() -> None:
    collections: dict[int, list[int]] = {1: [], 2: []}
    world = World("v1")

    def count(phase: str, info: dict[str, int]) -> None:
        if phase == "start" and info["generation"]:
            collections[info["generation"]].append(world.loop.now_ns // PERIOD_NS)

    async def program(node: Node) -> None:
        gc.callbacks.append(count)
        for duration_s in (0.55, 0.3, 1.5):
            await asyncio.sleep(duration_s)
        gc.callbacks.remove(count)

    gc.collect()  # what other tests have left
    world.run(program)
    assert collections == {1: [1, 6, 9], 2: [10]}


@pytest.mark.usefixtures("collects_each_period")
def test_what_has_grown_old_is_found_with_all_the_rest() -> None:
    found_ns: list[int] = []

    async def program(node: Node) -> None:
        kept = [InCycle(lambda: found_ns.append(node.now_ns))]
        await asyncio.sleep(0.35)
        kept.clear()
        await asyncio.sleep(1.5)

    World("v1").run(program)
    assert found_ns == [SECOND_NS]


def test_an_abandoned_generator_is_closed_by_its_program_at_the_next_second() -> None:
    closed: list[tuple[int, int]] = []

    async def numbers(node: Node) -> AsyncIterator[int]:
        try:
            for number in range(9):
                yield number
        finally:
            at_ns = node.now_ns
            await asyncio.sleep(0.25)
            closed.append((at_ns, node.now_ns))

    async def program(node: Node) -> None:
        kept: list[Any] = [numbers(node)]
        kept.append(kept)
        await anext(kept[0])
        del kept
        await asyncio.sleep(2)

    World("v1").run(program)
    assert closed == [(SECOND_NS, SECOND_NS + 250_000_000)]


class Pauses(World):
    """A world in which v1 is paused from 0.9 s on, until 1.5 s, where another shares its loop."""

    def __init__(self, *nodes: str) -> None:
        super().__init__(*nodes)
        opens = self.host.open_window

        def open_window(grant: wire.Grant) -> int:
            self.host.pause(["v1"] if 900_000_000 <= grant.time_ns < 1_500_000_000 else [])
            return opens(grant)

        self.host.open_window = open_window  # type: ignore[method-assign, assignment]

    @property
    def reports(self) -> list[Report]:
        return [report for traffic in self.traffic for report in traffic.reports]

    @property
    def notes(self) -> list[wire.Note]:
        return [note for traffic in self.traffic for note in traffic.notes]


def test_what_is_found_of_a_paused_vehicle_is_said_when_its_pause_is_over() -> None:
    """A process that is paused collects when it goes on."""

    async def program(node: Node) -> None:
        def says() -> None:
            node.report(late=True)
            node.log("late")
            node.event("late")

        if node.id == "v1":
            InCycle(says)
        while True:
            await asyncio.sleep(0.1)

    world = Pauses("v1", "v2").run(program)
    assert [report.time_ns for report in world.reports] == [1_500_000_000]
    assert [note.time_ns for note in world.notes] == [1_500_000_000] * 2


def test_what_is_found_starts_no_task_that_would_be_nobodys() -> None:
    refused: list[str] = []
    acted: list[str] = []

    async def acts() -> None:
        acted.append("task")

    async def program(node: Node) -> None:
        loop = asyncio.get_running_loop()

        def starts(start: Callable[[], object]) -> None:
            try:
                start()
            except RuntimeError as error:
                refused.append(str(error))

        def task() -> None:
            coroutine = acts()
            try:
                acted.append(asyncio.create_task(coroutine).get_name())
            finally:
                coroutine.close()

        InCycle(lambda: starts(task))
        InCycle(lambda: starts(lambda: loop.call_soon(acted.append, "soon")))
        InCycle(lambda: starts(lambda: loop.call_later(0.1, acted.append, "later")))
        await asyncio.sleep(2)

    World("v1").run(program)
    assert acted == []
    assert len(refused) == 3
    assert all("garbage collector" in text for text in refused)
