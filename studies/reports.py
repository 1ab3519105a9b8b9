"""Reports of the experiments in Markdown: their tables, the statistics in them, and the paper's figures beside.

Missing values (None or NaN: nobody reported, or a run had no counted period) are left out; a standard error needs
two seeds and is NaN without. What is compared is compared seed by seed, because two mechanisms that ran with the
same seed met the same world, and most of the spread over seeds is the world's.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from emulator.records.metrics import anees_band
from studies.paper import ALPHAS, PAPER_RMSE_M
from vnet.types import Array

MISSING = "–"
_NUMBER = re.compile(r"[-−+]?\d")

Values = Sequence[float] | Sequence[float | None]

Result = Mapping[str, Any]
BOUND_RATIO = 1.35
"""Optimized weights are wanted within so many times the bound, on each network and in each component."""

PAPER_TABLE1: dict[float | str, tuple[float, float]] = {
    "optimized": (0.13, 0.58),
    0.05: (0.38, 0.81),
    0.1: (0.33, 0.63),
    0.2: (0.28, 0.60),
    0.4: (0.21, 0.56),
    0.5: (0.20, 0.57),
    0.6: (0.21, 0.58),
    0.8: (0.33, 0.59),
    0.9: (0.46, 0.62),
    0.95: (0.68, 0.80),
}
"""√variance and √MSE in metres: Table I of Shen, Sun and Zhao, "Semi-Interpenetrating Cooperative Localization in
Connected Vehicle Networks"."""


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
    from scipy.special import stdtrit

    mean, error = mean_and_standard_error(values)
    known = np.count_nonzero(~np.isnan(as_floats(values)))
    return mean, float(stdtrit(known - 1, (1 + CONFIDENCE) / 2)) * error


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
    error = _standard_error(known)
    if math.isnan(error):
        return len(known), mean, half_width, math.nan
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


def select(results: Sequence[Result], **labels: object) -> list[Result]:
    """The results with these labels, by seed."""
    found = [row for row in results if all(row[key] == value for key, value in labels.items())]
    return sorted(found, key=lambda row: int(row["seed"]))


def column(rows: Sequence[Result], name: str) -> list[float]:
    """One figure of each row."""
    return [row[name] for row in rows]


def unique(results: Sequence[Result], label: str) -> list[Any]:
    """The values of a label in the order in which they come."""
    return list(dict.fromkeys(row[label] for row in results))


def table1(results: Sequence[Result]) -> str:
    """Table I: the network's √variance and √MSE for each constant α, and for optimized weights."""
    rows = []
    for name in ("optimized", *(f"{alpha:g}" for alpha in ALPHAS)):
        found = select(results, weights=name)
        paper = PAPER_TABLE1["optimized" if name == "optimized" else float(name)]
        variance, error = column(found, "stacked_deviation_m"), column(found, "stacked_rmse_m")
        rows.append([name, mean_and_error(variance), mean_and_error(error), f"{paper[0]:.2f}", f"{paper[1]:.2f}"])
    header = ["α", "√variance [m]", "√MSE [m]", "the paper's √variance", "the paper's √MSE"]
    title = "# Table I: four vehicles on a directed ring"
    return f"{title}\n\n{markdown_table(header, rows)}\n\n{_table1_summary(results)}\n"


def _table1_summary(results: Sequence[Result]) -> str:
    means = {
        alpha: float(np.mean(column(select(results, weights=f"{alpha:g}"), "stacked_deviation_m")))
        for alpha in ALPHAS
    }
    best = min(means, key=lambda alpha: means[alpha])
    worst = max(means, key=lambda alpha: means[alpha])
    ratio, error = paired_ratio(
        column(select(results, weights="optimized"), "stacked_deviation_m"),
        column(select(results, weights=f"{best:g}"), "stacked_deviation_m"),
    )
    return (
        f"√variance is smallest at α = {best:g} and largest at α = {worst:g}; optimized weights have "
        f"{with_error(ratio, error, '.2f')} times that of the best constant. "
        f"{in_seeds(len(unique(results, 'seed')))}; estimates right after stacking, before the road weighs them."
    )


def table2(results: Sequence[Result]) -> str:
    """Table II: RMSE of each mechanism on each network, lanes bounded on one side (the paper's) and on two."""
    parts = ["# Table II: RMSE of the common error [m], the paper's profile"]
    for sides, name, title in (
        (1, "stacked_rmse_m", "Lanes bounded on one side, as the paper's; right after stacking"),
        (1, "rmse_m", "The same at the end of the period, once the roads have weighed the stack"),
        (2, "stacked_rmse_m", "Lanes bounded on both sides; right after stacking"),
    ):
        found = [row for row in results if row["sides"] == sides]
        if found:
            parts += [f"## {title}", _table2_section(found, name)]
    parts.append(f"{in_seeds(len(unique(results, 'seed')))}; 10 s.")
    return "\n\n".join(parts) + "\n"


def _table2_section(results: Sequence[Result], name: str) -> str:
    networks = unique(results, "network")
    rows = []
    for mechanism in unique(results, "mechanism"):
        row = [mechanism]
        for network in networks:
            row.append(mean_and_error(column(select(results, network=network, mechanism=mechanism), name)))
            row.append(f"{PAPER_RMSE_M[mechanism][network]:.2f}" if mechanism in PAPER_RMSE_M else "–")
        rows.append(row)
    row = ["random / optimized"]
    for network in networks:
        random, optimized = (
            column(select(results, network=network, mechanism=m), name) for m in ("random", "optimized")
        )
        ratio, error = paired_ratio(random, optimized)
        paper = PAPER_RMSE_M["random"][network] / PAPER_RMSE_M["optimized"][network]
        row += [with_error(ratio, error, ".2f"), f"{paper:.2f}"]
    header = ["mechanism", *(name for n in networks for name in (n.upper(), f"paper's {n.upper()}"))]
    return markdown_table(header, [*rows, row])


def default_profile(results: Sequence[Result]) -> str:
    """vnet's own profile: RMSE, the ratio to the bound, consistency and cost of each mechanism."""
    networks = unique(results, "network")
    mechanisms = unique(results, "mechanism")

    def table(title: str, cell: Callable[[list[Result], list[Result]], str]) -> str:
        rows = []
        for mechanism in mechanisms:
            row = [mechanism]
            for network in networks:
                found = select(results, network=network, mechanism=mechanism)
                bound = select(results, network=network, mechanism="bound")
                row.append(cell(*_same_seeds(found, bound)) if found else "–")
            rows.append(row)
        return f"## {title}\n\n" + markdown_table(["mechanism", *(n.upper() for n in networks)], rows)

    parts = [
        "# The default profile",
        _wanted(results, networks),
        table("RMSE of the common error [m]", lambda a, _: mean_and_error(column(a, "rmse_m"))),
        table("Relative to the bound, the same seeds", _ratio_to_bound),
        table("Relative to the bound, by component", _component_ratios),
        table("Network deviation [m]", lambda a, _: mean_and_error(column(a, "deviation_m"))),
        table("RMSE of the position [m]", lambda a, _: mean_and_error(column(a, "position_rmse_m"))),
        table("ANEES of the common error", lambda a, _: mean_and_error(column(a, "common_error_anees"), 2)),
        table("ANEES of the position", lambda a, _: mean_and_error(column(a, "position_anees"), 2)),
        table("Bytes a vehicle sends in a period; vehicles that diverged", _cost),
        _paired_differences(results, networks),
        _notes(results),
    ]
    return "\n\n".join(parts) + "\n"


def _same_seeds(rows: list[Result], bound: list[Result]) -> tuple[list[Result], list[Result]]:
    seeds = {row["seed"] for row in rows}
    return rows, [row for row in bound if row["seed"] in seeds]


def _ratio_to_bound(rows: list[Result], bound: list[Result]) -> str:
    ratio, error = paired_ratio(column(rows, "rmse_m"), column(bound, "rmse_m"))
    return with_error(ratio, error, ".2f")


def _component_ratios(rows: list[Result], bound: list[Result]) -> str:
    return " / ".join(f"{ratio:.2f}" for ratio in _by_component(rows, bound)) or "–"


def _by_component(rows: list[Result], references: list[Result]) -> list[float]:
    """Ratios to the bound of each component; none if the components are not the same."""
    ours, bound = (np.array([row["component_rmse_m"] for row in some]) for some in (rows, references))
    if ours.shape != bound.shape:
        return []
    return [paired_ratio(a.tolist(), b.tolist())[0] for a, b in zip(ours.T, bound.T, strict=True)]


def _cost(rows: list[Result], _: list[Result]) -> str:
    size = [row["bytes"] for row in rows if row["bytes"] is not None]
    text = f"{np.mean(size):.0f} B" if size else "–"
    return f"{text}; {sum(row['divergent'] for row in rows)} in {len(rows)} runs"


def _wanted(results: Sequence[Result], networks: Sequence[str]) -> str:
    """The requirements on optimized weights, and whether they are met."""
    names = [f"at most {BOUND_RATIO} × the bound", "in each component", "no vehicle diverged"]
    names += [f"{a} not worse than {b}" for a, b in COMPARED]
    columns = []
    for network in networks:
        rows = select(results, network=network, mechanism="optimized")
        pair = _same_seeds(rows, select(results, network=network, mechanism="bound"))
        if not rows or len(pair[1]) != len(rows):
            columns.append(["–"] * len(names))
            continue
        ratio, error = paired_ratio(column(rows, "rmse_m"), column(pair[1], "rmse_m"))
        largest = max(_by_component(*pair), default=float("nan"))
        diverged = sum(column(rows, "divergent"))
        columns.append(
            [
                f"{_yes(ratio <= BOUND_RATIO)}: {with_error(ratio, error, '.2f')}",
                f"{_yes(largest <= BOUND_RATIO)}: {largest:.2f}",
                f"{_yes(diverged == 0)}: {diverged} in {len(rows)} runs",
                *(_not_worse(*_difference(results, network, a, b)) for a, b in COMPARED),
            ]
        )
    table = markdown_table(["", *(n.upper() for n in networks)], list(zip(names, *columns, strict=True)))
    return f"## What is wanted of optimized weights\n\n{table}"


COMPARED = (("optimized", "random"), ("random", "none"))
"""The first is wanted not worse than the second, by more than two standard errors of the paired difference."""


def _yes(so: bool) -> str:
    return "yes" if so else "**no**"


def _not_worse(difference: float, error: float, seeds: int) -> str:
    """Return whether a difference of errors is at most two standard errors above zero; unknown for one seed."""
    if seeds < 2:
        return "unknown" if seeds else "–"
    if difference > 2 * error:
        return f"**no**: worse by {difference:.3f} m"
    return "yes: better" if difference < -2 * error else "yes: no difference seen"


def _difference(results: Sequence[Result], network: str, a: str, b: str) -> tuple[float, float, int]:
    """RMSE of a less that of b over the seeds that both have: mean, standard error, seeds."""
    one, other = (select(results, network=network, mechanism=m) for m in (a, b))
    common = {row["seed"] for row in one} & {row["seed"] for row in other}
    values = [column([row for row in rows if row["seed"] in common], "rmse_m") for rows in (one, other)]
    return *paired_difference(*values), len(common)


def _paired_differences(results: Sequence[Result], networks: Sequence[str]) -> str:
    rows = []
    for a, b in (*COMPARED, ("optimized", "optimized, one hop")):
        row = [f"{a} − {b}"]
        for network in networks:
            difference, error, seeds = _difference(results, network, a, b)
            row.append(
                f"{with_error(difference, error, '+.3f')} ({seeds} seed{'s' if seeds > 1 else ''})"
                if seeds
                else "–"
            )
        rows.append(row)
    return "## Paired differences [m]\n\n" + markdown_table(["", *(n.upper() for n in networks)], rows)


def _notes(results: Sequence[Result]) -> str:
    runs = len(unique(results, "seed"))
    low, high = anees_band(runs)
    return (
        f"100 s, counted from 20 s on; up to {in_seeds(runs)}. `bound` is a Kalman filter "
        "a connected component that hears every fix of it. `one hop` mixes particles as the paper does and passes "
        "no fixes on. Not worse: not by more than two standard errors of the paired difference. ANEES is 1 for a "
        f"consistent filter; the 95 % band of {runs} independent samples of two degrees of freedom is {low:.2f} to "
        f"{high:.2f} (the samples within a run are not independent)."
    )
