"""The figures of a run, period by period (MODEL 6): how wrong the vehicles are, and how much they differ.

`states` has a row for each node and period, `metrics` one for each period. Programs that report no common error
(or nothing at all) leave nulls.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from emulator.records.distributions import chi2_quantiles
from emulator.records.reported import Figure, ValueColumns, figures_among
from emulator.records.states import COMMON_VALUES, STATES
from emulator.world.world import Instant
from vnet.node import Report, Value
from vnet.types import Array

ROWS_A_PIECE = 2048
"""Largest number of states kept as Python numbers, except for the rest of a period."""
_SIZES = {"common_error_m": 2, "common_error_covariance_m2": 4, "mean_m": 2, "stacked_common_error_m": 2}


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
    """`common_error_rmse_m` of each connected component of the network: where vehicles move, of the period's."""
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


class Metrics:
    """Collects reports and truth. `component` (N,) labels each node's connected component; -1 if not there."""

    def __init__(self, node_ids: Sequence[str], component: NDArray[np.intp], period_ns: int) -> None:
        self._number = {node: number for number, node in enumerate(node_ids)}
        self._node_ids = list(node_ids)
        self._component = component
        self._period_ns = period_ns
        self.rows: list[PeriodFigures] = []
        self._states: dict[str, list[Any]] = {name: [] for name in STATES.names}
        self._values = ValueColumns()
        self._packed: list[pa.Table] = []

    def record(
        self, instant: Instant, reports: Sequence[Report], component: NDArray[np.intp] | None = None
    ) -> PeriodFigures:
        """Take the last report of each node in one period; returns the period's figures.

        Where vehicles move, `component` is that of the period.
        """
        if component is not None:
            self._component = component
        last = {report.node: report for report in reports}
        estimate = collect(self._number, last, lambda r: r.estimate_m, 2)
        covariance = collect(self._number, last, lambda r: r.covariance_m2, 4)
        named = {
            name: collect(self._number, last, lambda r, name=name: r.values.get(name), size)
            for name, size in _SIZES.items()
        }
        self._store(instant, last)
        figures = self._figures(instant, len(last), sum(map(_is_not_finite, reports)), estimate, covariance, named)
        self.rows.append(figures)
        return figures

    def _figures(
        self,
        instant: Instant,
        reporting: int,
        not_finite: int,
        estimate: Array,
        covariance: Array,
        named: dict[str, Array],
    ) -> PeriodFigures:
        common = named["common_error_m"]
        error = common - instant.common_error_m
        position_error = estimate - instant.position_m
        groups = [self._component == label for label in range(int(self._component.max()) + 1)]
        component_mean = np.full_like(common, np.nan)
        for group in groups:
            component_mean[group] = _mean(common[group])
        bias = _mean(common) - instant.common_error_m
        stacked = named["stacked_common_error_m"]
        return PeriodFigures(
            instant.period,
            instant.time_ns,
            reporting,
            _rms(error),
            _rms(common - _mean(common)),
            _number_or_none(float(np.hypot(*bias))),
            _rms(stacked - instant.common_error_m),
            _rms(stacked - _mean(stacked)),
            [_rms(error[group]) for group in groups],
            [_rms(common[group] - _mean(common[group])) for group in groups],
            _rms(position_error),
            _rms(instant.fix_m - instant.position_m),
            _rms(named["mean_m"] - component_mean),
            _anees(error, named["common_error_covariance_m2"]),
            _anees(position_error, covariance),
            not_finite,
        )

    def _store(self, instant: Instant, last: dict[str, Report]) -> None:
        states, count = self._states, len(self._node_ids)
        states["period"] += [instant.period] * count
        states["time_ns"] += [instant.time_ns] * count
        states["node"] += self._node_ids
        states["position_m"] += instant.position_m.tolist()
        states["heading_rad"] += instant.heading_rad.tolist()
        states["fix_m"] += instant.fix_m.tolist()
        states["common_error_m"] += [instant.common_error_m.tolist()] * count
        for number, node in enumerate(self._node_ids):
            report = last.get(node)
            values = {} if report is None else dict(report.values)
            figures = figures_among(values)
            states["estimate_m"].append(None if report is None else report.estimate_m)
            states["covariance_m2"].append(None if report is None else report.covariance_m2)
            for name, column in COMMON_VALUES.items():
                value = values.pop(name, None)
                fits = isinstance(value, list) and len(value) == _SIZES.get(name, len(value))
                states[column].append(value if fits else None)
            states["values"].append(self._other_values(len(self.rows) * count + number, values, figures))
        if len(states["period"]) >= ROWS_A_PIECE:
            self._pack()

    def _other_values(
        self, row: int, values: dict[str, Value], figures: dict[str, Figure]
    ) -> list[tuple[str, list[float]]]:
        """Put the figures of a row of the states into columns; returns the values that have none."""
        others = []
        for name, value in sorted(values.items()):
            has_column = name in figures and self._values.put(row, name, figures[name])
            if not has_column and not isinstance(value, str):
                others.append((name, value if isinstance(value, list) else [value]))
        return others

    def _pack(self) -> None:
        """Put the rows so far into a table: as Python's numbers they take up many times the room."""
        self._packed.append(pa.table(self._states, schema=STATES))
        self._states = {name: [] for name in STATES.names}

    def states_table(self) -> pa.Table:
        """A row for each node and period; the columns of `STATES`, then those of reported values."""
        self._pack()
        return self._values.add_to(pa.concat_tables(self._packed).unify_dictionaries())

    def metrics_table(self) -> pa.Table:
        """A row for each period; columns are the fields of `PeriodFigures`."""
        return pa.Table.from_pylist([asdict(row) for row in self.rows], schema=METRICS)

    def sha256(self) -> str:
        """A hash of the metrics' content, bit by bit."""
        return hashlib.sha256(repr(self.rows).encode()).hexdigest()


_ARROW = {
    "int": pa.int64(),
    "float": pa.float64(),
    "float | None": pa.float64(),
    "list[float | None]": pa.list_(pa.float64()),
}
METRICS = pa.schema([(field.name, _ARROW[str(field.type)]) for field in fields(PeriodFigures)])


def summarize(rows: Sequence[PeriodFigures]) -> dict[str, float | None]:
    """Means over the run after its first fifth, in which filters find their feet."""
    settled = rows[len(rows) // 5 :]
    names = [
        "common_error_rmse_m",
        "deviation_m",
        "bias_m",
        "position_rmse_m",
        "fix_rmse_m",
        "consensus_error_m",
        "common_error_anees",
        "position_anees",
    ]
    summary: dict[str, float | None] = {}
    for name in names:
        values = [value for row in settled if (value := getattr(row, name)) is not None]
        summary[name] = float(np.mean(values)) if values else None
    return summary


def collect(number: Mapping[str, int], last: Mapping[str, Report], get: Any, size: int) -> Array:
    """(N, size) of what `get` finds in each node's report; NaN where it finds nothing of that size."""
    array = np.full((len(number), size), np.nan)
    found = [(number[node], value) for node, report in last.items() if (value := get(report)) is not None]
    fitting = [(i, value) for i, value in found if isinstance(value, (list, tuple)) and len(value) == size]
    if fitting:
        at, values = zip(*fitting, strict=True)
        array[[*at]] = values
    return array


def _present(array: Array) -> Array:
    return array[np.isfinite(array).all(axis=1)]


def _mean(array: Array) -> Array:
    present = _present(array)
    return present.mean(axis=0) if len(present) else np.full(array.shape[1], np.nan)


def _rms(array: Array) -> float | None:
    present = _present(array)
    return float(np.sqrt(np.mean(np.sum(present**2, axis=1)))) if len(present) else None


def _anees(error: Array, covariance: Array) -> float | None:
    known = np.isfinite(error).all(axis=1) & np.isfinite(covariance).all(axis=1)
    error, matrix = error[known], covariance[known].reshape(-1, 2, 2)
    regular = (np.linalg.det(matrix) > 1e-18) & (np.trace(matrix, axis1=1, axis2=2) > 0)  # positive definite
    if not regular.any():
        return None
    error, matrix = error[regular], matrix[regular]
    return float(np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(matrix), error)) / 2)


def anees_band(samples: int) -> tuple[float, float]:
    """The 95 % band of the mean of so many independent samples of two degrees of freedom, 1 being consistent."""
    low, high = chi2_quantiles([0.025, 0.975], 2 * samples) / (2 * samples)
    return float(low), float(high)


def _is_not_finite(report: Report) -> bool:
    """Return whether any number of a report is NaN or infinite."""
    numbers = [*(report.estimate_m or ()), *(report.covariance_m2 or ())]
    for value in report.values.values():
        if not isinstance(value, str):
            numbers += value if isinstance(value, list) else [value]
    return not all(map(math.isfinite, numbers))


def _number_or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None
