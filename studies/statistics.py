"""Intervals and tests over seeds: 95 % confidence by Student's t, paired tests, corrected for their number."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from studies.tables import MISSING, Values, as_floats, with_error

CONFIDENCE = 0.95
"""Confidence of all intervals."""


def interval_95(values: Values) -> tuple[float, float]:
    """Return the mean (NaN of no value) and half the width of its 95 % interval (NaN of fewer than two)."""
    known = as_floats(values)
    known = known[~np.isnan(known)]
    if not len(known):
        return math.nan, math.nan
    return float(known.mean()), _half_width(known)


def _half_width(known: np.ndarray) -> float:
    from scipy.special import stdtrit

    if len(known) < 2:
        return math.nan
    quantile = float(stdtrit(len(known) - 1, (1 + CONFIDENCE) / 2))
    return quantile * float(np.std(known, ddof=1)) / math.sqrt(len(known))


def shown_interval(values: Values, digits: int = 3) -> str:
    """Return "0.234 ± 0.012", mean and half-width of the 95 % interval; one value has none, and none is a dash."""
    return with_error(*interval_95(values), f".{digits}f")


@dataclass(frozen=True)
class PairedTest:
    """A comparison with a reference, seed by seed.

    difference and half_width: the mean difference and half its 95 % confidence interval. p: that of the paired
    t-test, 1 where nothing differs; adjusted_p: by Holm's method for all comparisons that were made together.
    """

    name: str
    pairs: int
    difference: float
    half_width: float
    p: float
    adjusted_p: float

    @property
    def shown(self) -> list[str]:
        """Difference, p and adjusted p as texts."""
        if not self.pairs:
            return [MISSING] * 3
        return [with_error(self.difference, self.half_width, "+.4f"), _shown_p(self.p), _shown_p(self.adjusted_p)]


def paired_tests(compared: Mapping[str, tuple[Values, Values]]) -> list[PairedTest]:
    """Return the tests of values against a reference's, by name; pairs with a missing value are left out.

    Holm's method bounds the probability that any of them is called different by chance.
    """
    tests = [(name, *_paired(*values)) for name, values in compared.items()]
    adjusted = holm([p for *_, p in tests])
    return [
        PairedTest(name, pairs, difference, half_width, p, one)
        for (name, pairs, difference, half_width, p), one in zip(tests, adjusted, strict=True)
    ]


def _paired(values: Values, reference: Values) -> tuple[int, float, float, float]:
    from scipy.special import stdtr

    assert len(values) == len(reference), "values of the same seeds are needed"
    difference = as_floats(values) - as_floats(reference)
    known = difference[~np.isnan(difference)]
    mean, half_width = interval_95(known.tolist())
    if len(known) < 2:
        return len(known), mean, half_width, math.nan
    error = float(np.std(known, ddof=1)) / math.sqrt(len(known))
    if error == 0:
        return len(known), mean, half_width, 1.0 if mean == 0 else 0.0
    return len(known), mean, half_width, 2 * float(stdtr(len(known) - 1, -abs(mean) / error))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for their number (Holm 1979); NaN stays, and counts as no comparison."""
    known = [index for index, p in enumerate(p_values) if not math.isnan(p)]
    adjusted, largest = list(p_values), 0.0
    for rank, index in enumerate(sorted(known, key=lambda each: p_values[each])):
        largest = max(largest, min(1.0, (len(known) - rank) * p_values[index]))
        adjusted[index] = largest
    return adjusted


def _shown_p(p: float) -> str:
    if math.isnan(p):
        return MISSING
    return "< 0.001" if p < 0.001 else f"{p:.3f}"
