"""The drawing of faults in campaigns: a source of choices, and the bounds of a parameter."""

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

    @property
    def step(self) -> float:
        """Distance of two neighbouring numbers that can be drawn."""
        return self.times / self.per

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and greatest number that can be drawn."""
        return self.low * self.times / self.per, self.high * self.times / self.per

    def between(self, low: float, high: float) -> Drawn:
        """Return the same steps between other bounds. Raises ValueError for what is no multiple of a step."""
        steps = [round(bound / self.step) for bound in (low, high)]
        if (
            any(abs(n * self.step - bound) > 1e-9 for n, bound in zip(steps, (low, high), strict=True))
            or low > high
        ):
            raise ValueError(f"two multiples of {self.step:g} are needed, the lower one first")
        return Drawn(steps[0], steps[1], self.times, self.per)

    def draw(self, choose: Chooser) -> float:
        """Draw one number."""
        return choose.integer(self.low, self.high) * self.times / self.per
