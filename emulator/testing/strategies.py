"""A hypothesis strategy for schedules of faults. Needs hypothesis: `pip install vnet-emulator[hypothesis]`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

from emulator.scenario.faults import Fault
from emulator.scenario.loading import Source
from emulator.testing.campaign_plan import ScheduleConstraints, draw_fault, known_kinds
from emulator.testing.scenarios import make_scenario
from vnet.extras import require

if TYPE_CHECKING:
    from hypothesis import strategies as st

T = TypeVar("T")


class _Drawn:
    """A Chooser whose choices hypothesis draws and shrinks.

    Whatever there are several of is drawn number first (and not with `st.lists`): hypothesis then learns to drop
    any of them, however large.
    """

    def __init__(self, draw: st.DrawFn) -> None:
        self._draw = draw

    def integer(self, low: int, high: int) -> int:
        from hypothesis import strategies as st

        return self._draw(st.integers(low, high))

    def choice(self, items: Sequence[T]) -> T:
        from hypothesis import strategies as st

        return self._draw(st.sampled_from(items))

    def subset(self, items: Sequence[T], most: int) -> list[T]:
        chosen = {self.integer(0, len(items) - 1) for _ in range(self.integer(1, most))}
        return [items[number] for number in sorted(chosen)]


def faults(
    scenario: Source, *, kinds: Sequence[str] | None = None, most: int = 4, **changes: Any
) -> st.SearchStrategy[tuple[Fault, ...]]:
    """Schedules of at most `most` faults for a scenario, changed as by `vnet_emulation`: give both the same.

    A failing schedule shrinks to the fewest faults, then the earliest and shortest, of the fewest vehicles and
    with the smallest parameters, that still fail; to none if it fails without.
    """
    require("emulator.testing.strategies.faults", "hypothesis")
    from hypothesis import strategies as st

    allowed = known_kinds(kinds)

    @cache
    def ground() -> ScheduleConstraints:
        return ScheduleConstraints.of(make_scenario(scenario, changes))

    @st.composite
    def fault(draw: st.DrawFn) -> Fault:
        return draw_fault(_Drawn(draw), ground(), allowed)

    @st.composite
    def schedule(draw: st.DrawFn) -> tuple[Fault, ...]:
        return tuple(draw(fault()) for _ in range(draw(st.integers(0, most))))

    return schedule()
