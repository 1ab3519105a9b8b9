"""Tables and the figures in them: means over seeds, their standard errors, and Markdown.

Missing values (None or NaN: nobody reported, or a run had no counted period) are left out; a standard error needs
two seeds and is NaN without. What is compared is compared seed by seed, because two mechanisms that ran with the
same seed met the same world, and most of the spread over seeds is the world's.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

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
