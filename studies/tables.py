"""Tables and the statistics in them: means over seeds, their intervals, paired tests, and Markdown.

Missing values (None or NaN: nobody reported, or a run had no counted period) are left out; a standard error needs
two seeds and is NaN without. What is compared is compared seed by seed, because two mechanisms that ran with the
same seed met the same world, and most of the spread over seeds is the world's.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vnet.types import Array

MISSING = "–"
_NUMBER = re.compile(r"[-−+]?\d")

Values = Sequence[float] | Sequence[float | None]


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table aligned in the source as well; columns of numbers are flush right. Ends without a newline."""
    cells = [[cell.replace("|", r"\|") for cell in row] for row in (header, *rows)]
    assert all(len(row) == len(header) for row in cells), "a row has more or fewer cells than the header"
    columns = list(zip(*cells, strict=True))
    widths = [max(3, *map(len, column)) for column in columns]
    right = [_is_numeric(column[1:]) for column in columns]
    rule = ["-" * (width - 1) + ":" if flush else "-" * width for width, flush in zip(widths, right, strict=True)]
    lines = [
        [
            cell.rjust(width) if flush else cell.ljust(width)
            for cell, width, flush in zip(row, widths, right, strict=True)
        ]
        for row in cells
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in [lines[0], rule, *lines[1:]])


def mean_and_error(values: Values, digits: int = 3) -> str:
    """ "0.234 ± 0.012": mean ± standard error over seeds; one seed: no error; none: a dash."""
    return with_error(*mean_and_standard_error(values), f".{digits}f")


def with_error(value: float, error: float, form: str) -> str:
    """ "1.35 ± 0.02" for the form ".2f"; an error of NaN is left out, and a value of NaN is a dash."""
    if math.isnan(value):
        return MISSING
    return f"{value:{form}}" + ("" if math.isnan(error) else f" ± {error:{form.lstrip('+')}}")


def in_seeds(count: int) -> str:
    """Number of seeds, and the spread given beside their mean: "10 seeds, ± standard error"."""
    return "1 seed" if count == 1 else f"{count} seeds, ± standard error"


def mean_and_standard_error(values: Values) -> tuple[float, float]:
    """The mean (NaN of no values) and its standard error (NaN of fewer than two)."""
    found = as_floats(values)
    found = found[~np.isnan(found)]
    return (float(np.mean(found)) if len(found) else math.nan), _standard_error(found)


def paired_difference(a: Values, b: Values) -> tuple[float, float]:
    """Mean and standard error of a − b, seed by seed. Pairs with a missing value are left out."""
    assert len(a) == len(b), "values of the same seeds are needed"
    return mean_and_standard_error((as_floats(a) - as_floats(b)).tolist())


def paired_ratio(a: Values, b: Values) -> tuple[float, float]:
    """The ratio of the means of a and b, and its standard error from what is left of a after a share of b.

    It is what a reader gets who divides two means of a table. The error is that of a ratio estimator (Cochran 1977,
    chapter 6).
    """
    assert len(a) == len(b), "values of the same seeds are needed"
    pairs = np.column_stack([as_floats(a), as_floats(b)])
    above, below = pairs[~np.isnan(pairs).any(axis=1)].T
    if not len(below) or not np.mean(below) > 0:
        return math.nan, math.nan
    ratio = float(np.mean(above) / np.mean(below))
    return ratio, _standard_error(above - ratio * below) / float(np.mean(below))


def as_floats(values: Values) -> Array:
    """An array (K,) with NaN for None."""
    return np.array([math.nan if value is None else value for value in values], dtype=float)


def _standard_error(found: Array) -> float:
    return float(np.std(found, ddof=1) / math.sqrt(len(found))) if len(found) > 1 else math.nan


def _is_numeric(column: Sequence[str]) -> bool:
    """Return True if a column holds numbers and dashes, and at least one number."""
    filled = [cell for cell in column if cell not in ("", MISSING)]
    return bool(filled) and all(_NUMBER.match(cell) for cell in filled)


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
