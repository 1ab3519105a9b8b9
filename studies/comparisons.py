"""Comparisons of the cooperative program: with parts of it removed, with textbook baselines, in other worlds.

A study is a number of variants of one scenario, each a change of the program, of its options or of the world. All
run with the same seeds, so that differences are paired; the hears-all bound is that of each run itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from emulator.cells.cells import Cell
from emulator.scenario.loading import scenario_of
from studies.figures import ERROR_COLUMNS, against_time, series_of
from studies.measure import DIVERGENT_M, DIVERGENT_S, DIVERGENT_SIGMAS, study_cell
from studies.paper import BOUND, BOUND_POSITION, COOPERATIVE, Labels, counted_from, default_scenario
from studies.reports import (
    MISSING,
    Result,
    column,
    markdown_table,
    paired_ratio,
    paired_tests,
    select,
    shown_interval,
    unique,
)
from vnet.errors import VnetError, counted

BASELINES = "agents.baselines:main"
REFERENCE_OPTIONS: dict[str, Any] = {"exchange": "information", "particles": 1000}
"""Options of the first variant of each study."""
EQUAL_RIDGE_M2 = 1e6
"""Ridge of the quadratic program beside which nothing else counts: all weights are equal."""
COMMON_APART_S = 300.0
"""Time in the file of a recorded common error from the beginning of one seed's run to that of the next one's."""
CHURN_S = 900.0
"""Length of a run with churn."""
CHURN_EVERY_S = 30.0
"""Time from one loss of vehicles to the next."""
CHURN_FOR_S = 10.0
"""Time for which they are away; they come back with nothing remembered."""
CHURN_VEHICLES = 2
"""Number of vehicles that are lost at once."""


@dataclass(frozen=True)
class Variant:
    """A change: the program's options, and any other keys of the scenario, by "section.key"."""

    options: Mapping[str, Any] = field(default_factory=dict)
    keys: Mapping[str, Any] = field(default_factory=dict)
    entry: str = COOPERATIVE


def _with(**options: Any) -> Variant:
    return Variant(REFERENCE_OPTIONS | options)


def _in_world(**gnss: Any) -> Variant:
    return Variant(REFERENCE_OPTIONS, {f"world.gnss.{name}": value for name, value in gnss.items()})


def _baseline(method: str) -> Variant:
    return Variant({"method": method}, entry=BASELINES)


ABLATION: dict[str, Variant] = {
    "reference": _with(),
    "equal weights": _with(ridge_m2=EQUAL_RIDGE_M2),
    "random weights": _with(fusion="random"),
    "priors not pooled": _with(fusion="none"),
    "nothing passed on": _with(relay_increments=0),
    "neither": _with(fusion="none", relay_increments=0),
    "200 particles": _with(particles=200),
    "2000 particles": _with(particles=2000),
    "no heading": _in_world(heading=False),
    "no defence": _with(defence=False),
    "every fix passed on": Variant({"exchange": "particles", "particles": 200}),
    "particles, one hop": Variant({"exchange": "particles", "particles": 200, "relay": False}),
}
"""The reference, and what becomes of it without each of its parts."""
BASELINE: dict[str, Variant] = {
    "reference": _with(),
    "intersection": _baseline("intersection"),
    "diffusion": _baseline("diffusion"),
    "alone": _baseline("alone"),
    "differential": _baseline("differential"),
}
"""The reference, and textbook methods."""
RECEIVERS: dict[str, Variant] = {
    "reference": _with(),
    "3 m": _in_world(sigma_m=3.0),
    "0.1 m": _in_world(sigma_m=0.1),
    "0.03 m": _in_world(sigma_m=0.03),
    "multipath 1 m": _in_world(multipath_sigma_m=1.0),
    "multipath 1 m, told": _in_world(multipath_sigma_m=1.0, covariance="total"),
    "outliers 2 %": _in_world(outlier_probability=0.02),
    "gradient 0.1 m/km": Variant(REFERENCE_OPTIONS, {"world.common_error.gradient_m_per_km": 0.1}),
    "no heading": _in_world(heading=False),
}
"""The same program in worlds whose receivers are better or worse, also than it assumes."""
CHURN: dict[str, Variant] = {"reference": _with(), "priors not pooled": _with(fusion="none")}
"""Runs of 15 minutes in which vehicles leave and come back."""
FACTORS: dict[str, dict[str, Variant]] = {
    "exchange": {"information": _with(), "particles": Variant({"exchange": "particles"})},
    "relay": {"": Variant(), "no relay": Variant({"relay_increments": 0, "relay": False})},
    "particles": {str(count): Variant({"particles": count}) for count in (200, 1000)},
    "heading": {"": Variant(), "no heading": Variant({}, {"world.gnss.heading": False})},
    "defence": {"": Variant(), "no defence": Variant({"defence": False})},
}
"""Levels of each factor of the full ablation."""


def full_ablation() -> dict[str, Variant]:
    """Return every combination of the factors; the first is the reference."""
    variants = {}
    for levels in product(*(factor.items() for factor in FACTORS.values())):
        name = ", ".join(label for label, _ in levels if label)
        options: dict[str, Any] = {}
        keys: dict[str, Any] = {}
        for _, variant in levels:
            options |= variant.options
            keys |= variant.keys
        variants[name] = Variant(options, keys)
    return variants


STUDIES: dict[str, Callable[[], dict[str, Variant]]] = {
    "ablation": lambda: ABLATION,
    "ablation-full": full_ablation,
    "baselines": lambda: BASELINE,
    "receivers": lambda: RECEIVERS,
    "churn": lambda: CHURN,
}
"""The studies by name."""


def comparison_cells(
    study: str,
    networks: Mapping[str, Mapping[str, Any]],
    seeds: Sequence[int],
    duration_s: float,
    world: Mapping[str, Any] | None = None,
) -> list[Cell]:
    """Return a cell for each network, variant and seed; `world` has further keys of all scenarios."""
    cells = []
    for network, section in networks.items():
        for name, variant in STUDIES[study]().items():
            for seed in seeds:
                labels: Labels = {"network": network, "mechanism": name, "seed": seed}
                start = {"world.common_error.start_s": COMMON_APART_S * (seed - 1)} if world else {}
                faults = list(_churn(duration_s)) if study == "churn" else []
                plain = default_scenario(section, seed, variant.options, duration_s, faults, entry=variant.entry)
                scenario = scenario_of(plain, {**(world or {}), **start, **variant.keys})
                cells.append(study_cell(labels, scenario, counted_from(duration_s)))
    return cells


def recorded_common(path: Path) -> dict[str, Any]:
    """Return the keys of a world whose common error is recorded. Raises VnetError for a file that is not there.

    The runs of seed s begin `COMMON_APART_S` · (s − 1) after time 0 of the file.
    """
    if not path.is_file():
        raise VnetError(f"--common {path}: no such file")
    return {"world.common_error.kind": "file", "world.common_error.path": str(path.resolve())}


def _churn(duration_s: float) -> Iterator[dict[str, Any]]:
    """Yield the faults of a run with churn."""
    start_s = CHURN_EVERY_S
    while start_s + CHURN_FOR_S <= duration_s - CHURN_FOR_S:
        nodes = {"count": CHURN_VEHICLES}
        yield {"kind": "kill", "at_s": start_s, "duration_s": CHURN_FOR_S, "nodes": nodes}
        start_s += CHURN_EVERY_S


# The report.


def draw(cells: Sequence[Cell], folder: Path) -> Iterator[Path]:
    """Draw the errors of each variant against time, and the bound's where all have the same; yield the PNGs."""
    for network in dict.fromkeys(cell.labels["network"] for cell in cells):
        if series := series_of(cells, folder, network=network):
            title = f"{str(network).upper()}: errors against time"
            path = folder / f"{network}_against_time"
            yield against_time(_with_bound(series), path, title, columns=ERROR_COLUMNS)


def _with_bound(series: Mapping[str, list[pa.Table]]) -> dict[str, list[pa.Table]]:
    """Return the series with that of the bound, if the variants with the same seeds have the same."""
    first, *others = series.values()
    if BOUND not in first[0].column_names or any(_bounds(each) != _bounds(first[: len(each)]) for each in others):
        return dict(series)
    names = ["time_ns", *ERROR_COLUMNS]
    bound = [table.select(["time_ns", BOUND, BOUND_POSITION]).rename_columns(names) for table in first]
    return {**series, "bound": bound}


def _bounds(tables: Sequence[pa.Table]) -> list[Any]:
    return [table[BOUND].to_pylist() if BOUND in table.column_names else None for table in tables]


HEADER = [
    "variant",
    "c [m]",
    "c : bound",
    "position [m]",
    "ANEES of c",
    "of the bound",
    "95 % ellipses: c / position",
]
HEADER += ["within 0.5 / 1.5 m", "converged [s]", "bytes", "diverged"]


def report(study: str, results: Sequence[Result], duration_s: float) -> str:
    """Return the table of each network, and the tests against the first variant, in Markdown."""
    parts = [f"# Comparison: {study}"]
    for network in unique(results, "network"):
        rows = [row for row in results if row["network"] == network]
        parts += [f"## {network.upper()}", markdown_table(HEADER, [*_bound_rows(rows), *_rows(rows)]), _tests(rows)]
    parts.append(_notes(results, duration_s))
    return "\n\n".join(parts) + "\n"


def _rows(results: Sequence[Result]) -> Iterator[list[str]]:
    for name in unique(results, "mechanism"):
        rows = select(results, mechanism=name)
        yield [
            name,
            shown_interval(column(rows, "rmse_m")),
            _ratio(rows),
            shown_interval(column(rows, "position_rmse_m")),
            shown_interval([value for row in rows for value in row["anees_batches"]], 2),
            _of_known(rows, "reference_common_error_anees", ".2f"),
            f"{_percent(rows, 'coverage_95')} / {_percent(rows, 'position_coverage_95')}",
            f"{_percent(rows, 'within_05_m')} / {_percent(rows, 'within_15_m')}",
            _of_known(rows, "converged_s", ".1f", np.median),
            _of_known(rows, "bytes", ".0f"),
            f"{sum(column(rows, 'divergent'))} / {sum(column(rows, 'divergent_sigmas'))}",
        ]


def _bound_rows(results: Sequence[Result]) -> Iterator[list[str]]:
    """Yield a row of the bound, if it is the same for all variants."""
    seeds: dict[int, set[float | None]] = {}
    for row in results:
        seeds.setdefault(row["seed"], set()).add(row.get("reference_common_error_rmse_m"))
    if any(len(found) > 1 or None in found for found in seeds.values()):
        return
    rows = select(results, mechanism=unique(results, "mechanism")[0])
    common, position = (column(rows, f"reference_{name}_rmse_m") for name in ("common_error", "position"))
    anees = shown_interval(column(rows, "reference_common_error_anees"), 2)
    yield ["bound", shown_interval(common), "1", shown_interval(position), anees, *[MISSING] * 6]


def _ratio(rows: Sequence[Result]) -> str:
    bounds = [row.get("reference_common_error_rmse_m") for row in rows]
    ratio, _ = paired_ratio(column(rows, "rmse_m"), bounds)
    return MISSING if np.isnan(ratio) else f"{ratio:.2f}"


def _of_known(rows: Sequence[Result], name: str, form: str, figure: Callable[[list[float]], Any] = np.mean) -> str:
    known = [row[name] for row in rows if row.get(name) is not None]
    return format(figure(known), form) if known else MISSING


def _percent(rows: Sequence[Result], name: str) -> str:
    return _of_known(rows, name, ".1%").replace("%", " %")


def _tests(results: Sequence[Result]) -> str:
    """Return the tests of each variant against the first, by errors of c and of positions."""
    first, *others = unique(results, "mechanism")
    seeds = {name: set(column(select(results, mechanism=name), "seed")) for name in (first, *others)}

    def values(name: str, of: str, figure: str) -> list[float]:
        both = seeds[first] & seeds[name]
        return [row[figure] for row in select(results, mechanism=of) if row["seed"] in both]

    tables = [
        paired_tests({name: (values(name, name, figure), values(name, first, figure)) for name in others})
        for figure in ("rmse_m", "position_rmse_m")
    ]
    rows = [
        [common.name, str(common.pairs), *common.shown, *position.shown]
        for common, position in zip(*tables, strict=True)
    ]
    header = ["against the first", "seeds", "c [m]", "p", "adjusted p", "position [m]", "p", "adjusted p"]
    return markdown_table(header, rows) if rows else ""


def _notes(results: Sequence[Result], duration_s: float) -> str:
    seeds, variants = len(unique(results, "seed")), len(unique(results, "mechanism"))
    tests = counted(max(0, variants - 1), "comparison")
    return (
        f"{duration_s:g} s, counted from {counted_from(duration_s):g} s on; {counted(seeds, 'seed')}; ± half a "
        f"95 % interval (Student's t). Tests are paired t-tests, {tests} a network and figure, adjusted by Holm's "
        "method. The bound is a Kalman filter a component that hears every fix of it. ANEES is the mean of batches "
        "of 10 s, 1 for a consistent filter. Ellipses: the share of the stated 95 % ellipses that hold the truth. "
        "Converged: median of the time from which on, for 5 s, the error of c is at most 1.5 times its later one. "
        f"Diverged: vehicles whose c was over {DIVERGENT_M:g} m off for {DIVERGENT_S:g} s / beyond "
        f"{DIVERGENT_SIGMAS:g} stated deviations for {DIVERGENT_S:g} s."
    )
