"""Figures of a cell of the paper's experiments: errors, consistency, coverage, lane-level success, convergence."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa

from emulator.cells.cells import Cell
from emulator.drivers.emulation import Emulation
from emulator.records.distributions import chi2_quantile
from emulator.records.metrics import reference_series
from emulator.records.recorded_run import RecordedRun
from emulator.records.recorded_world import RecordedWorld
from emulator.records.reported import reported_figures
from emulator.records.run import first_lasting
from vnet.errors import VnetError
from vnet.types import Array
from vnet.units import NS_PER_S

DIVERGENT_M = 10.0
"""Common error above which a vehicle is on its way to divergence, in metres."""
DIVERGENT_S = 5.0
"""Time for which the error has to stay above it, in seconds."""


DIVERGENT_SIGMAS = 5.0
"""Stated deviations of the common error above which a vehicle is, by another definition, on its way there."""
COVERED = 0.95
"""Probability of the ellipses whose coverage is counted."""
BATCH_S = 10.0
"""Length of a batch: its mean of normalized errors is one sample."""
LANE_LEVEL_M = {"within_05_m": 0.5, "within_15_m": 1.5}
"""Distances of positions from the truth that count as success: in the lane, and on the road's right half."""
CONVERGED_FACTOR = 1.5
"""A network has converged once its RMSE is at most so many times that of the settled run …"""
CONVERGED_S = 5.0
"""… for so long on end."""
REFERENCE = "reference_"
"""Prefix of the figures of a run's reference, and of the columns of a cell's metrics with those of each period."""


def measure(emulation: Emulation, from_s: float) -> tuple[dict[str, Any], pa.Table]:
    """Figures of a run from `from_s` on: roots of mean squares over the periods, in metres.

    Of the common error at the end of the period (`rmse_m`, `deviation_m`, by component), right after stacking
    (`stacked_…`), of positions; means of the consistency figures; `divergent` vehicles (MODEL 6); bytes a period;
    what `consistency_figures`, `others_figures` and, as `reference_…`, the run's reference have. Returned beside is
    the table of metrics, with the reference's figures of each period as further columns.
    """
    rows = [row for row in emulation.metrics.rows if row.time_ns >= from_s * 1e9]

    def rms(name: str) -> float | None:
        values = [getattr(row, name) for row in rows if getattr(row, name) is not None]
        return float(np.sqrt(np.mean(np.square(values)))) if values else None

    def mean(name: str) -> float | None:
        values = [getattr(row, name) for row in rows if getattr(row, name) is not None]
        return float(np.mean(values)) if values else None

    states = emulation.metrics.states_table()
    recorded = _recorded(emulation, states)
    common_m = recorded.vectors("common_error_estimate_m") - recorded.vectors("common_error_m")
    reference, metrics = _reference(recorded), emulation.metrics.metrics_table()
    figures = {
        "rmse_m": rms("common_error_rmse_m"),
        "deviation_m": rms("deviation_m"),
        "bias_m": rms("bias_m"),
        "stacked_rmse_m": rms("stacked_rmse_m"),
        "stacked_deviation_m": rms("stacked_deviation_m"),
        "component_rmse_m": _rms_columns([row.component_rmse_m for row in rows]),
        "position_rmse_m": rms("position_rmse_m"),
        "fix_rmse_m": rms("fix_rmse_m"),
        "consensus_error_m": rms("consensus_error_m"),
        "common_error_anees": mean("common_error_anees"),
        "position_anees": mean("position_anees"),
        "divergent": len(first_divergences(np.linalg.norm(common_m, axis=2), emulation.world.period_ns)),
        "bytes": sent.mean if (sent := reported_figures(states).get("bytes")) else None,
        "not_finite": sum(row.not_finite for row in rows),
        "metrics_sha256": emulation.metrics.sha256(),
        **consistency_figures(recorded, from_s),
        **others_figures(recorded, from_s),
    }
    settled = after(reference, math.ceil(from_s * NS_PER_S / emulation.world.period_ns))
    figures |= {REFERENCE + name: value for name, value in settled.items()}
    for name, series in reference.items():
        if series.ndim == 1:
            metrics = metrics.append_column(REFERENCE + name, pa.array(series, from_pandas=True))
    return figures, metrics


def _recorded(emulation: Emulation, states: pa.Table) -> RecordedRun:
    """Return the states of a run as those of its folder."""
    nothing, world = pa.table({}), RecordedWorld.of(emulation.world)
    return RecordedRun(emulation.scenario, nothing, states, nothing, (), world=world)


def _reference(recorded: RecordedRun) -> dict[str, Array]:
    """Return the figures of a run's reference in each period; none if it has no reference."""
    try:
        return reference_series(recorded)
    except VnetError:
        return {}


def _rms_columns(rows: list[list[float | None]]) -> list[float]:
    """Root mean square of each column; none where vehicles move and the number of components changes."""
    if len({len(row) for row in rows}) > 1:
        return []
    table = np.array([[np.nan if value is None else value for value in row] for row in rows], dtype=float)
    return [float(value) for value in np.sqrt(np.mean(table**2, axis=0))]


study_cell = partial(Cell, measure=measure)
"""A cell whose figures are those of `measure`."""


def after(series: Mapping[str, Array], first: int) -> dict[str, float | list[float | None] | None]:
    """Return each figure from period `first` on: the root of the mean square of one in metres, of others the mean.

    None of nothing.
    """
    return {
        name: _settled(name, values[first:])
        if values.ndim == 1
        else [_settled(name, column[first:]) for column in values.T]
        for name, values in series.items()
    }


def _settled(name: str, values: Array) -> float | None:
    return _of_known(_root_of_mean, values**2) if name.endswith("_m") else _of_known(np.mean, values)


def _of_known(figure: Callable[[Array], Any], values: Array) -> float | None:
    """Return a figure of those values that are finite; None if none is."""
    known = values[np.isfinite(values)]
    return float(figure(known)) if len(known) else None


def _root_of_mean(squares: Array) -> float:
    return math.sqrt(squares.mean())


def consistency_figures(recorded: RecordedRun, from_s: float) -> dict[str, Any]:
    """Return figures of the states of a run from `from_s` on; None where nothing was reported.

    median_error_m, median_position_error_m: medians over vehicles and periods. median_anees: that of the normalized
    squared errors of the common error, relative to the one of χ² with 2 degrees of freedom: 1 if consistent.
    coverage_95, position_coverage_95: share of the 95 % ellipses of common error and position that hold the truth.
    anees_batches: means of the normalized squared errors of the common error, one of each 10 s. within_05_m,
    within_15_m: share of the positions that are so near the truth. converged_s: beginning of the first 5 s in which
    the RMSE of the common error is at most 1.5 times that from `from_s` on. divergent_sigmas: number of vehicles
    that are beyond 5 stated deviations of the common error for 5 s at any time.
    """
    period_ns = recorded.scenario.period_ns
    first = math.ceil(from_s * NS_PER_S / period_ns)
    common_m = recorded.vectors("common_error_estimate_m") - recorded.vectors("common_error_m")
    position_m = recorded.vectors("estimate_m") - recorded.vectors("position_m")
    common_nees = normalized(common_m, recorded.matrices("common_error_covariance_m2"))
    position_nees = normalized(position_m, recorded.matrices("covariance_m2"))
    inside = chi2_quantile(COVERED, 2)
    away_m = np.linalg.norm(position_m[first:], axis=2)
    return {
        "median_error_m": _of_known(np.median, np.linalg.norm(common_m[first:], axis=2)),
        "median_position_error_m": _of_known(np.median, away_m),
        "median_anees": _of_known(np.median, common_nees[first:] / chi2_quantile(0.5, 2)),
        "coverage_95": _share(common_nees[first:], inside),
        "position_coverage_95": _share(position_nees[first:], inside),
        "anees_batches": batch_means(common_nees[first:] / 2, max(1, round(BATCH_S * NS_PER_S / period_ns))),
        **{name: _share(away_m, limit_m) for name, limit_m in LANE_LEVEL_M.items()},
        "converged_s": converged_s(common_m, first, period_ns),
        "divergent_sigmas": len(first_divergences(np.sqrt(common_nees), period_ns, DIVERGENT_SIGMAS)),
    }


def others_figures(recorded: RecordedRun, from_s: float) -> dict[str, Any]:
    """Return figures from `from_s` on of the vehicles that run the scenario's program; none where all do.

    others_rmse_m, others_position_rmse_m: roots of mean squares over vehicles and periods. others_anees: mean of
    the normalized squared errors of the common error, 1 if consistent. others_divergent: number of vehicles that
    are beyond 10 m, or 5 stated deviations, for 5 s at any time.
    """
    if not recorded.scenario.program.exceptions:
        return {}
    period_ns, others = recorded.scenario.period_ns, recorded.runs_the_program
    first = math.ceil(from_s * NS_PER_S / period_ns)
    common_m = (recorded.vectors("common_error_estimate_m") - recorded.vectors("common_error_m"))[:, others]
    position_m = (recorded.vectors("estimate_m") - recorded.vectors("position_m"))[:, others]
    squares = normalized(common_m, recorded.matrices("common_error_covariance_m2")[:, others])
    divergent = first_divergences(np.linalg.norm(common_m, axis=2), period_ns)
    divergent |= first_divergences(np.sqrt(squares), period_ns, DIVERGENT_SIGMAS)
    return {
        "others_rmse_m": _of_known(_root_of_mean, np.sum(common_m[first:] ** 2, axis=2)),
        "others_position_rmse_m": _of_known(_root_of_mean, np.sum(position_m[first:] ** 2, axis=2)),
        "others_anees": _of_known(np.mean, squares[first:] / 2),
        "others_divergent": len(divergent),
    }


def normalized(error_m: Array, covariance_m2: Array) -> Array:
    """Return εᵀ P⁻¹ ε (K, N) of errors (K, N, 2); NaN where either is missing or P is not positive definite."""
    (a, b), (_, d) = np.moveaxis(covariance_m2, (2, 3), (0, 1))
    determinant = a * d - b * b
    x, y = np.moveaxis(error_m, 2, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = (d * x * x - 2 * b * x * y + a * y * y) / determinant
    return np.asarray(np.where((determinant > 0) & (a > 0), squares, np.nan))


def _share(values: Array, limit: float) -> float | None:
    return _of_known(lambda known: np.mean(known <= limit), values)


def batch_means(values: Array, periods: int) -> list[float]:
    """Return the means of values (K, N) over batches of so many periods, without what is left over at the end."""
    batches = [values[start : start + periods] for start in range(0, len(values) - periods + 1, periods)]
    return [float(np.nanmean(batch)) for batch in batches if np.isfinite(batch).any()]


def converged_s(error_m: Array, first: int, period_ns: int) -> float | None:
    """Return when the network's error (K, N, 2) has come down to that of the settled run; None if it never does."""
    squares = np.sum(error_m**2, axis=2)
    known = np.isfinite(squares)
    count = known.sum(axis=1)
    mean = np.where(count > 0, np.where(known, squares, 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)
    settled = mean[first:][np.isfinite(mean[first:])]
    if not len(settled):
        return None
    good = np.sqrt(mean) <= CONVERGED_FACTOR * np.sqrt(settled.mean())
    length = max(1, round(CONVERGED_S * NS_PER_S / period_ns))
    run = np.convolve(good, np.ones(length), mode="valid")
    found = np.flatnonzero(run >= length)
    return float(found[0] * period_ns / NS_PER_S) if len(found) else None


def first_divergences(error_m: Array, period_ns: int, limit: float = DIVERGENT_M) -> dict[int, int]:
    """Return the period in which each divergent vehicle first met the definition, by vehicle, in order of time.

    `error_m` (periods, N) are the common errors, in metres as the `limit` is, or both in stated deviations. NaN,
    where nobody knows or nobody judges, interrupts a divergence.
    """
    return first_lasting(error_m > limit, period_ns, DIVERGENT_S)
