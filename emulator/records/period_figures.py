"""The figures of periods, of many at once: an operation on arrays costs the same for one period and for a hundred.

Every figure is the same bit by bit however many periods are computed together: a run's hash of its metrics has it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import starmap
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from emulator.world.world import Instant
from vnet.types import Array

VECTORS = {
    "estimate_m": 2,
    "covariance_m2": 4,
    "common_error_estimate_m": 2,
    "common_error_covariance_m2": 4,
    "mean_m": 2,
    "stacked_common_error_m": 2,
}
"""Columns of the states of which figures are made, and the numbers that each entry has."""
_Mask: TypeAlias = NDArray[np.bool_]


@dataclass(frozen=True)
class PeriodFigures:
    """One row of the metrics. Lengths in metres; None where no node reported what is needed.

    x_i is vehicle i's estimate of the common error c, x̄ the mean of all x_i, m_i what vehicle i takes for the mean.
    ANEES are means of εᵀ P⁻¹ ε / 2, so that 1 is consistent (Bar-Shalom, Li, Kirubarajan 2001, 5.4).
    """

    period: int
    """Counts from 0."""
    time_ns: int
    """Its start."""
    reporting: int
    """Number of vehicles that reported in it."""
    common_error_rmse_m: float | None
    """√(mean‖x_i − c‖²) over the network."""
    deviation_m: float | None
    """√(mean‖x_i − x̄‖²): how far the vehicles are from agreeing."""
    bias_m: float | None
    """‖x̄ − c‖."""
    stacked_rmse_m: float | None
    """As `common_error_rmse_m`, right after fusion, before the map."""
    stacked_deviation_m: float | None
    """As `deviation_m`, right after fusion, before the map."""
    component_rmse_m: list[float | None]
    """`common_error_rmse_m` of each connected component of the network: of the period's, where links change."""
    component_deviation_m: list[float | None]
    """`deviation_m` of each connected component, from its own mean."""
    position_rmse_m: float | None
    """RMSE of the vehicles' estimates of their positions."""
    fix_rmse_m: float | None
    """RMSE of the raw fixes."""
    consensus_error_m: float | None
    """√(mean‖m_i − x̄‖²), with x̄ of the vehicle's component."""
    common_error_anees: float | None
    """ANEES of the common error."""
    position_anees: float | None
    """ANEES of the positions."""
    not_finite: int
    """Number of reports that held NaN or infinity."""


@dataclass(frozen=True)
class Period:
    """Truth of a period, and who reported in it. `component` (N,) labels each vehicle's connected component."""

    instant: Instant
    component: NDArray[np.intp]
    reporting: int
    """Number of vehicles that reported."""
    not_finite: int
    """Number of reports that held NaN or infinity."""


def vectors(values: Sequence[Sequence[float] | None], size: int) -> Array:
    """Return a column of the states as an array (rows, size); NaN where nothing was reported."""
    array = np.full((len(values), size), np.nan)
    reported = [row for row, value in enumerate(values) if value is not None]
    if reported:
        array[reported] = [value for value in values if value is not None]
    return array


def figures_of(periods: Sequence[Period], reported: Mapping[str, Array]) -> list[PeriodFigures]:
    """Return the figures of each period.

    `reported` has the columns `VECTORS`, each an array (rows, size) with a row for each vehicle and period, vehicle
    by vehicle within a period.
    """
    found: list[PeriodFigures] = []
    vehicles = len(periods[0].component)
    for first, end in _alike(periods):
        rows = slice(first * vehicles, end * vehicles)
        columns = {name: array[rows].reshape(end - first, vehicles, -1) for name, array in reported.items()}
        found += _figures(periods[first:end], columns)
    return found


def _alike(periods: Sequence[Period]) -> Iterator[tuple[int, int]]:
    """Divide periods into ranges in which vehicles form the same components."""
    first = 0
    for number, period in enumerate(periods):
        component = periods[first].component
        if period.component is not component and not np.array_equal(period.component, component):
            yield first, number
            first = number
    yield first, len(periods)


def _figures(periods: Sequence[Period], columns: Mapping[str, Array]) -> list[PeriodFigures]:
    """Return the figures of K periods whose `columns` are arrays (K, N, size)."""
    instants = [period.instant for period in periods]
    position, fix = np.array([each.position_m for each in instants]), np.array([each.fix_m for each in instants])
    truth = np.array([each.common_error_m for each in instants])[:, None]
    common, stacked = columns["common_error_estimate_m"], columns["stacked_common_error_m"]
    error, position_error = common - truth, columns["estimate_m"] - position
    mean, component = _means(common), periods[0].component
    groups = [component == label for label in range(int(component.max()) + 1)]
    of_component = np.full_like(common, np.nan)
    for group in groups:
        of_component[:, group] = _means(common[:, group])
    bias = (mean - truth)[:, 0]
    found: Iterator[Any] = zip(
        _rms(error),
        _rms(common - mean),
        map(_number_or_none, np.hypot(bias[:, 0], bias[:, 1]).tolist()),
        _rms(stacked - truth),
        _rms(stacked - _means(stacked)),
        _by_period([_rms(error[:, group]) for group in groups], len(periods)),
        _by_period([_rms(common[:, group] - _means(common[:, group])) for group in groups], len(periods)),
        _rms(position_error),
        _rms(fix - position),
        _rms(columns["mean_m"] - of_component),
        _anees(error, columns["common_error_covariance_m2"]),
        _anees(position_error, columns["covariance_m2"]),
        strict=True,
    )
    heads = [(each.instant.period, each.instant.time_ns, each.reporting) for each in periods]
    rows = zip(heads, found, periods, strict=True)
    return list(starmap(PeriodFigures, ((*head, *figures, period.not_finite) for head, figures, period in rows)))


def _by_period(figures: list[list[float | None]], periods: int) -> list[list[float | None]]:
    """Turn the figures of each component in each period into those of each period by component."""
    return [[figure[number] for figure in figures] for number in range(periods)]


def _means(array: Array) -> Array:
    """Return the mean (K, 1, 2) of the vectors (K, N, 2) of each period, of those that are known."""
    known = _finite(array)
    whole, partly = _divide(known)
    means = np.full((len(array), 1, array.shape[2]), np.nan)
    if len(whole):
        means[whole] = array[whole].mean(axis=1, keepdims=True)
    for number in partly:
        means[number] = array[number][known[number]].mean(axis=0)
    return means


def _rms(array: Array) -> list[float | None]:
    """Return the root mean square of the vectors (K, N, 2) of each period, of those that are known."""
    means = _means_of_known(np.sum(array**2, axis=2), _finite(array))
    return [None if mean is None else math.sqrt(mean) for mean in means]


def _anees(error: Array, covariance: Array) -> list[float | None]:
    """Return the ANEES of each period, of errors (K, N, 2) whose covariances (K, N, 4) are positive definite."""
    matrix = covariance.reshape(*error.shape, 2)
    usable = _finite(error) & _finite(covariance)
    usable[usable] = _are_positive_definite(matrix[usable])
    inverse = np.linalg.inv(matrix[usable])
    x, y = error[usable].T
    # Not einsum, whose order of summation depends on the number of vehicles.
    (xx, xy), (yx, yy) = inverse.transpose(1, 2, 0)
    square = np.zeros(error.shape[:2])
    square[usable] = x * xx * x + x * xy * y + y * yx * x + y * yy * y
    return [None if mean is None else mean / 2 for mean in _means_of_known(square, usable)]


def _means_of_known(numbers: Array, known: _Mask) -> list[float | None]:
    """Return the mean of the numbers (K, N) of each period, of those that are known; None where none is."""
    found: list[float | None] = [None] * len(numbers)
    whole, partly = _divide(known)
    means = numbers[whole].mean(axis=1).tolist() if len(whole) else []
    for number, mean in zip(whole.tolist(), means, strict=True):
        found[number] = mean
    for number in partly:
        found[number] = float(numbers[number][known[number]].mean())
    return found


def _finite(array: Array) -> _Mask:
    """Return which of the vectors (K, N, size) are finite, as (K, N)."""
    finite: _Mask = np.all(np.isfinite(array), axis=2)
    return finite


def _divide(known: _Mask) -> tuple[NDArray[np.intp], list[int]]:
    """Return the numbers of the periods in which all vehicles are known, and of those in which only some are."""
    some = known.any(axis=1)
    whole = some & known.all(axis=1)
    return np.flatnonzero(whole), np.flatnonzero(some & ~whole).tolist()


def _are_positive_definite(matrix: Array) -> _Mask:
    """Return which of the matrices (n, 2, 2) are positive definite."""
    definite: _Mask = (np.linalg.det(matrix) > 1e-18) & (np.trace(matrix, axis1=1, axis2=2) > 0)
    return definite


def _number_or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None
