"""Content of a run in a recording: views are laid out for that, and for nothing else."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from emulator.records.period_figures import Estimate, ProgramFigures
from emulator.viewer.drawing import POSITION, Period

T = TypeVar("T")
SAME_M = 1e-3
"""Distance up to which a reported position is the raw fix again, whose float32 rounds to millimetres."""


@dataclass(frozen=True)
class Content:
    """Kinds of data that a run has; `values` and `texts` are names that programs report.

    Of what its program declares, those that have been reported: `estimates`, `charts`, and `peers`.
    """

    estimates: tuple[Estimate, ...] = ()
    """With `POSITION` if estimates are not the raw fixes again."""
    charts: tuple[tuple[str, str], ...] = ()
    """Id and title."""
    peers: tuple[str, ...] = ()
    busy: bool = False
    """Channel busy ratios."""
    values: tuple[str, ...] = ()
    texts: tuple[str, ...] = ()

    def after(self, period: Period, declared: ProgramFigures, values: list[str], texts: list[str]) -> Content:
        """Return the content of the run up to and with this period."""
        off_m = period.points("estimate_m") - period.points("fix_m")
        seen = [each for each in declared.estimates if np.isfinite(period.points(each.estimate)).any()]
        if (np.abs(off_m) > SAME_M).any():
            seen.append(POSITION)
        charts = [
            (each["id"], each["axis"])
            for each in declared.charts
            if any(np.isfinite(period.figure(name)) for name in each["lines"].values())
        ]
        return replace(
            self,
            estimates=_joined(self.estimates, seen),
            charts=_joined(self.charts, charts),
            peers=_joined(self.peers, [name for name, found in period.peers().items() if found]),
            busy=self.busy or bool(np.isfinite(period.numbers("busy_ratio")).any()),
            values=tuple(values),
            texts=tuple(texts),
        )


def _joined(known: tuple[T, ...], seen: Iterable[T]) -> tuple[T, ...]:
    return tuple(dict.fromkeys([*known, *seen]))


EVERYTHING = Content(estimates=(POSITION,), busy=True)
"""All of vnet's views of estimates and of the radio."""
