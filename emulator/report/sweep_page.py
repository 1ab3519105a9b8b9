"""The page of a sweep: each figure against the varied keys, with 95 % confidence intervals of its mean.

Programs that are varied are compared in pairs: the same seed has drawn the same network, noise and losses for both.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from emulator.pages.canvas import CURVES, GREY, NAVY, Canvas, canvas, legend
from emulator.pages.page import render, table
from emulator.records.distributions import student_quantile
from emulator.records.period_figures import KeyFigure, estimates_differ, figures_if_here
from emulator.records.verdicts import Verdict
from emulator.report.drawing import DASHES, Drawing, draw_charts
from emulator.scenario.program import Program
from emulator.scenario.scenario import Run
from vnet.errors import counted
from vnet.runtime.programs import search_programs_in
from vnet.units import label_of

CONFIDENCE = 0.95
FEWEST_SEEDS = 5
"""Seeds from which on an interval says something: with 4 it is 1.6 standard deviations wide, with 2 nine."""
PROGRAM = "program.entry"
"""The varied key whose values are compared in pairs, on the same seeds."""
COLOURS = (*CURVES, NAVY, GREY)
"""Colours of the curves; a ninth curve is not drawn."""
MOST_CHARTS = 24
ASIDE = 0.012
"""Step between the intervals of two curves, as a share of the axis."""
PLAIN = (1e-9, 1e9)
"""Halves of intervals that are written without an exponent."""
ROUNDING = 1e-12
"""Share of a number below which a spread is that of its rounding."""
NO_FIGURES = ("seed", "vehicles", "emulated_s", "wall_s", "real_time_factor")
"""Numbers of a row that are no results."""
Rows = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Mean:
    """Mean of a figure over seeds, half of its confidence interval (None for one seed), and their number."""

    value: float
    half: float | None
    count: int

    def __str__(self) -> str:
        """Two significant digits of the interval's half, and the mean to the same place."""
        if self.half is None:
            return f"{self.value:.4g}"
        half = float(f"{self.half:.1e}")
        if not PLAIN[0] <= half < PLAIN[1]:
            return f"{self.value:.4g} ± {half:.2g}"
        place = 1 - math.floor(math.log10(half))
        return " ± ".join(f"{round(number, place) + 0.0:.{max(0, place)}f}" for number in (self.value, half))


def mean_of(values: Sequence[float], size: float = 0.0) -> Mean:
    """Return the mean of one number or more, with the interval of Student's t distribution.

    `size` is the largest number of which values are differences: what its rounding alone explains is 0.
    """
    count, mean = len(values), float(np.mean(values))
    if abs(mean) <= ROUNDING * size:
        mean = 0.0
    if count == 1:
        return Mean(mean, None, 1)
    half = float(student_quantile((1 + CONFIDENCE) / 2, count - 1) * np.std(values, ddof=1) / np.sqrt(count))
    if half <= ROUNDING * max(size, *map(abs, values)):
        half = 0.0
    return Mean(mean, half, count)


def too_few(seeds: int) -> str:
    """Return what is to be said of so few seeds; "" for enough."""
    if seeds >= FEWEST_SEEDS:
        return ""
    return f"{counted(seeds, 'seed')}: too few for a confidence interval; {FEWEST_SEEDS} or more are needed"


def _key_of(program: Program) -> Sequence[KeyFigure]:
    search_programs_in(program.folders)
    return figures_if_here(program).key


def sweep_page(run: Run, programs: Sequence[Program], rows: Rows, varied: Sequence[str]) -> str:
    """Return the page of the rows of a sweep of these programs over the keys `varied`."""
    key = tuple(each for program in programs for each in _key_of(program))
    names = figures_of(rows, varied, key)
    shown = _changing(rows, names)
    titles = {name: heading(name, key) for name in (shown[:MOST_CHARTS] if varied else names)}
    drawers = {
        f"figure-{i}": (title, partial(_draw, rows, varied, name, title))
        for i, (name, title) in enumerate(titles.items())
    }
    charts, missing = draw_charts(drawers if varied else {})
    counts = Counter(row["verdict"] for row in rows)
    seeds = len({row["seed"] for row in rows})
    lengths_s = [row["emulated_s"] for row in rows]
    ends = [f"{end_s:g}" for end_s in (min(lengths_s), max(lengths_s))]
    return render(
        "sweep.html.j2",
        title=f"Sweep {run.name}",
        facts=[
            f"{counted(len(rows), 'run')} of {' to '.join(dict.fromkeys(ends))} s of emulated time",
            f"{counted(seeds, 'seed')} for each combination of values",
            ", ".join(program.entry for program in programs),
        ],
        too_few=too_few(seeds),
        verdicts=[(Verdict(name), count) for name, count in sorted(counts.items())],
        charts=charts,
        missing=missing,
        left_out=len(shown) - len(charts) if varied else 0,
        means=table(_means(rows, varied, titles)),
        differences=table(differences(rows, varied, titles)),
        failed=table(_failed(rows, varied)),
    )


def figures_of(rows: Rows, varied: Sequence[str], key: Sequence[KeyFigure] = ()) -> list[str]:
    """Return the names of the figures, those that programs report first."""
    names = dict.fromkeys(name for row in rows for name in row)
    found = [n for n in names if n not in (*NO_FIGURES, *varied) and not n.startswith("frames_")]
    numeric = [n for n in found if any(_is_number(row.get(n)) for row in rows)]
    if not any(estimates_differ(row.get("position_rmse_m"), row.get("fix_rmse_m")) for row in rows):
        of_positions = ["position_anees", *(each.name for each in key if each.of_positions)]
        numeric = [name for name in numeric if name not in of_positions]
    own = [name.removeprefix("last.") for name in numeric if name.startswith("last.")]
    return sorted(numeric, key=lambda name: name.removeprefix("last.") not in own)


def _changing(rows: Rows, names: Sequence[str]) -> list[str]:
    """Those of the figures that are not the same in all rows."""
    return [name for name in names if len({row[name] for row in rows if _is_number(row.get(name))}) > 1]


def heading(name: str, key: Sequence[KeyFigure] = ()) -> str:
    """Return the title of a figure, with its unit."""
    plain = name.removeprefix("last.")
    title = next((each.title for each in key if each.name == plain), "")
    return label_of(plain, title) + (", at the end" if plain != name else "")


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _groups(rows: Rows, keys: Sequence[str]) -> list[tuple[tuple[Any, ...], list[Mapping[str, Any]]]]:
    """The rows by their values of some keys, in their order; true is another value than 1."""
    groups: dict[str, tuple[tuple[Any, ...], list[Mapping[str, Any]]]] = {}
    for row in rows:
        values = tuple(row[key] for key in keys)
        groups.setdefault(repr(values), (values, []))[1].append(row)
    return list(groups.values())


def _mean(rows: Rows, name: str) -> Mean | None:
    values = [row[name] for row in rows if _is_number(row.get(name))]
    return mean_of(values) if values else None


def _means(rows: Rows, varied: Sequence[str], titles: Mapping[str, str]) -> list[dict[str, Any]]:
    return [
        {**dict(zip(varied, values, strict=True)), "runs": len(group)}
        | {title: _shown(_mean(group, name), len(group)) or "–" for name, title in titles.items()}
        for values, group in _groups(rows, varied)
    ]


def differences(rows: Rows, varied: Sequence[str], titles: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the mean differences of each program's figures from the first program's, over pairs of equal seeds."""
    if PROGRAM not in varied:
        return []
    others = [key for key in varied if key != PROGRAM]
    found = []
    for values, group in _groups(rows, others):
        ((first,), base), *later = _groups(group, [PROGRAM])
        of_seed = {row["seed"]: row for row in base}
        for (program,), theirs in later:
            pairs = [(row, of_seed[row["seed"]]) for row in theirs if row["seed"] in of_seed]
            row = dict(zip(others, values, strict=True)) | {"programs": f"{program} − {first}", "pairs": len(pairs)}
            found.append(row | {title: _difference(pairs, name) for name, title in titles.items()})
    return found


def _difference(pairs: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]], name: str) -> str:
    numbers = [
        (one[name], two[name]) for one, two in pairs if _is_number(one.get(name)) and _is_number(two.get(name))
    ]
    size = max((abs(number) for pair in numbers for number in pair), default=0.0)
    return _shown(mean_of([one - two for one, two in numbers], size) if numbers else None, len(pairs))


def _shown(mean: Mean | None, count: int) -> str:
    """Return a mean as text, with its number in brackets where it is of fewer than `count`; "" for None."""
    if mean is None:
        return ""
    return f"{mean} ({mean.count})" if mean.count < count else str(mean)


def _failed(rows: Rows, varied: Sequence[str]) -> list[dict[str, Any]]:
    """The runs that are not valid, with the checks that failed."""
    names = (*varied, "seed", "verdict", "failed")
    return [{name: row[name] for name in names} for row in rows if row["verdict"] != Verdict.VALID]


def _draw(rows: Rows, varied: Sequence[str], name: str, title: str) -> Drawing:
    """Draw a figure against the varied key with the most values, of numbers if possible; the others make curves."""
    key = max(varied, key=lambda key: (_all_numbers(rows, key), len({str(row[key]) for row in rows})))
    others = [other for other in varied if other != key]
    curves = _groups(rows, others)
    shown = curves[: len(COLOURS)]
    names = [
        ", ".join(f"{other.rpartition('.')[2]} {value}" for other, value in zip(others, values, strict=True))
        for values, _ in shown
    ]
    made = canvas(key, title)
    ticks = None if _all_numbers(rows, key) else list(dict.fromkeys(str(row[key]) for row in rows))
    for number, ((_, curve), label, colour) in enumerate(zip(shown, names, COLOURS, strict=False)):
        _draw_curve(made, curve, key, name, colour, label, ticks, number - (len(shown) - 1) / 2)
    if ticks is not None:
        made.axes.set_xticks(range(len(ticks)), ticks)
    if others:
        legend(made)
    left = f" {len(curves) - len(shown)} more curves are not drawn." if len(curves) > len(shown) else ""
    return Drawing(made, f"Mean over seeds; bars: 95 % confidence interval of the mean.{left}")


def _draw_curve(
    made: Canvas,
    rows: Rows,
    key: str,
    name: str,
    colour: str,
    label: str,
    ticks: Sequence[str] | None,
    aside: float,
) -> None:
    """Draw a curve with its intervals; `aside` moves them by so many steps, so that none hides another."""
    points = [(values[0], mean) for values, group in _groups(rows, [key]) if (mean := _mean(group, name))]
    if not points:
        return
    if ticks is None:
        points.sort(key=lambda point: float(point[0]))
    at = [float(x) if ticks is None else ticks.index(str(x)) for x, _ in points]
    step = ASIDE * ((max(at) - min(at)) or 1.0)
    at = [x + aside * step for x in at]
    value = [mean.value for _, mean in points]
    half = [mean.half or 0.0 for _, mean in points]
    style: dict[str, Any] = {"color": colour, "marker": "o", "markersize": 3.5, "capsize": 3, "label": label}
    made.axes.errorbar(at, value, yerr=half, linestyle=DASHES[0] if ticks is None else "none", **style)


def _all_numbers(rows: Rows, key: str) -> bool:
    return all(_is_number(row[key]) for row in rows)
