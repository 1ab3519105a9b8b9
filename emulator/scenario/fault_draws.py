"""How a campaign draws a fault: the choices to be made, and the bounds of a parameter beside its declaration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

T = TypeVar("T")


class Chooser(Protocol):
    """A source of choices: a random generator in campaigns, hypothesis in property tests.

    The first choice everywhere is the simplest one, so that hypothesis shrinks to it.
    """

    def integer(self, low: int, high: int) -> int:
        """Choose a whole number, low ≤ n ≤ high."""

    def choice(self, items: Sequence[T]) -> T:
        """Choose one of these."""

    def subset(self, items: Sequence[T], most: int) -> list[T]:
        """Choose at least one of these and at most `most`, in their order."""


@dataclass(frozen=True)
class Drawn:
    """A parameter's range in campaigns: whole numbers from `low` to `high`, times `times`, divided by `per`.

    Written beside the type of a field, `Annotated[float, Drawn(1, 10, per=10)]`. A parameter that is a pair of
    numbers gets two draws. A parameter without one keeps its default.
    """

    low: int
    high: int
    times: int = 1
    per: int = 1

    def draw(self, choose: Chooser) -> float:
        """Draw one number."""
        return choose.integer(self.low, self.high) * self.times / self.per
