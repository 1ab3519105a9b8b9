"""Figures of estimates beyond their errors: coverage, consistency in batches, lane-level success, convergence."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from emulator.records.distributions import chi2_quantiles
from emulator.records.divergence import DIVERGENT_SIGMAS, first_divergences
from emulator.records.recorded_run import RecordedRun
from vnet.types import Array
from vnet.units import NS_PER_S

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
    inside = float(chi2_quantiles(COVERED, 2))
    away_m = np.linalg.norm(position_m[first:], axis=2)
    return {
        "median_error_m": _median(np.linalg.norm(common_m[first:], axis=2)),
        "median_position_error_m": _median(away_m),
        "median_anees": _median(common_nees[first:] / float(chi2_quantiles(0.5, 2))),
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
        "others_rmse_m": _root_mean_square(common_m[first:]),
        "others_position_rmse_m": _root_mean_square(position_m[first:]),
        "others_anees": _mean(squares[first:] / 2),
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
    known = values[np.isfinite(values)]
    return float(np.mean(known <= limit)) if len(known) else None


def _mean(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if len(known) else None


def _root_mean_square(errors_m: Array) -> float | None:
    mean = _mean(np.sum(errors_m**2, axis=2))
    return None if mean is None else math.sqrt(mean)


def _median(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


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
