"""Content of a run in a recording: views are laid out for that, and for nothing else."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from emulator.viewer.drawing import Period

SAME_M = 1e-3
"""Distance up to which a reported position is the raw fix again, whose float32 rounds to millimetres."""


_OF_MEANS = ("consensus_error_m", "bias_m")


@dataclass(frozen=True)
class Content:
    """Kinds of data that a run has; `values` and `texts` are names that programs report."""

    common: bool = False
    """Estimates of the common error."""
    position: bool = False
    """Estimates of positions that are not the raw fixes again."""
    consensus: bool = False
    """Errors of the network's mean."""
    weights: bool = False
    """Fusion weights."""
    busy: bool = False
    """Channel busy ratios."""
    values: tuple[str, ...] = ()
    texts: tuple[str, ...] = ()

    def after(self, period: Period, values: list[str], texts: list[str]) -> Content:
        """Return the content of the run up to and with this period."""
        off_m = period.points("estimate_m") - period.points("fix_m")
        return replace(
            self,
            common=self.common or bool(np.isfinite(period.points("common_error_estimate_m")).any()),
            position=self.position or bool((np.abs(off_m) > SAME_M).any()),
            consensus=self.consensus or any(np.isfinite(period.figure(name)) for name in _OF_MEANS),
            weights=self.weights or bool(period.message["weights"]),
            busy=self.busy or bool(np.isfinite(period.numbers("busy_ratio")).any()),
            values=tuple(values),
            texts=tuple(texts),
        )


EVERYTHING = Content(common=True, position=True, consensus=True, weights=True, busy=True)
"""All views of estimates and of the radio, without values of a program's own."""
