"""The hears-all bound of a recorded run: one Kalman filter a component that hears every fix without loss.

It is told more than any vehicle: the world's laws, each vehicle's lane, and which fixes are outliers. So no program
that learns from the same fixes can be expected to do better. It exists where vehicles stand on straight lanes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray

from emulator.radio.connectivity import component_links
from emulator.records.recorded_run import RecordedRun
from emulator.scenario.scenario import Scenario
from emulator.world.world import components
from vnet.cmm.kalman_bound import KalmanBound, LaneModel, MultipathLaneModel
from vnet.errors import VnetError
from vnet.types import Array, Mask
from vnet.units import NS_PER_S

MOST_VEHICLES = 100
"""Most vehicles for which the bound is computed: a step of so many takes some milliseconds."""
MOST_WORK = 20_000_000
"""Most periods times vehicles squared of a run that is finished: 15 minutes of 38 vehicles."""
OUTLIER_SIGMAS = 5.0
"""Fixes further than so many deviations from the truth are outliers."""
LEAST_SIGMA_M = 1e-3
"""Least deviation that the filter assumes of anything, in metres: with 0 nothing would be left to estimate."""
COLUMNS = ("period", "node", "position_m", "heading_rad", "fix_m", "common_error_m", "common_error_estimate_m")
"""Columns of the states from which the bound is computed."""
SAME_RAD = 1e-4
"""Angle within which a vehicle's heading is that of its lane."""


def why_no_bound(scenario: Scenario, vehicles: int) -> str:
    """Return why a run has no such bound; "" if it has one."""
    if scenario.network.moves:
        return "vehicles that drive have no hears-all bound: it needs straight lanes"
    if scenario.roadside:
        return "there are roadside units, which stand on no lane: the hears-all bound needs straight lanes"
    if vehicles > MOST_VEHICLES:
        return f"the hears-all bound is computed for {MOST_VEHICLES} vehicles at most"
    if scenario.world.common_error.gradient_m_per_km:
        return "a common error with a gradient has no hears-all bound"
    return ""


def lane_model(scenario: Scenario) -> LaneModel:
    """Return the laws of the scenario's world."""
    common, lateral, gnss = scenario.world.common_error, scenario.world.lateral, scenario.world.gnss
    laws: dict[str, float] = {
        "common_sigma_m": max(common.sigma_m, LEAST_SIGMA_M),
        "common_tau_s": common.tau_s,
        "lateral_sigma_m": max(reflected_deviation_m(lateral.sigma_m, lateral.half_width_m), LEAST_SIGMA_M),
        "lateral_tau_s": lateral.tau_s,
    }
    if not gnss.multipath_sigma_m:
        return LaneModel(**laws)
    return MultipathLaneModel(
        **laws, multipath_sigma_m=gnss.multipath_sigma_m, multipath_tau_s=gnss.multipath_tau_s
    )


def reflected_deviation_m(sigma_m: float, half_width_m: float) -> float:
    """Return the deviation of an Ornstein-Uhlenbeck process that is reflected: a normal one, truncated."""
    if sigma_m == 0:
        return 0.0
    edge = half_width_m / sigma_m
    density = math.exp(-(edge**2) / 2) / math.sqrt(2 * math.pi)
    if edge < 0.1:  # the process is uniform, and the difference of two equal numbers says nothing
        return half_width_m / math.sqrt(3)
    return sigma_m * math.sqrt(1 - 2 * edge * density / math.erf(edge / math.sqrt(2)))


def lanes_of(
    position_m: Array, heading_rad: Array, lane_point_m: Array, lane_heading_rad: Array
) -> NDArray[np.intp]:
    """Return the lane (N,) on which each vehicle stands: of those along its heading the nearest.

    Positions and points are in metres (N, 2) and (L, 2), headings in radians. Raises VnetError for a vehicle
    without one.
    """
    normal = np.column_stack([np.sin(lane_heading_rad), -np.cos(lane_heading_rad)])
    across_m = np.abs(position_m @ normal.T - np.sum(normal * lane_point_m, axis=1))
    turn_rad = np.abs(np.mod(lane_heading_rad - heading_rad[:, None] + np.pi, 2 * np.pi) - np.pi)
    across_m[turn_rad > SAME_RAD] = np.inf
    if not lane_point_m.size or np.isinf(across_m.min(axis=1)).any():
        raise VnetError("a vehicle is on no lane along its heading")
    return np.asarray(across_m.argmin(axis=1))


class HearsAll:
    """The filters of all components; `component` (N,) is the label of each vehicle's.

    point_m (N, 2) and heading_rad (N,) are a point and the direction of each vehicle's lane; `members` are the
    vehicles of each component.
    """

    def __init__(
        self, scenario: Scenario, point_m: Array, heading_rad: Array, component: NDArray[np.integer[Any]]
    ) -> None:
        gnss, model = scenario.world.gnss, lane_model(scenario)
        self._noise_m2 = max(gnss.sigma_m, LEAST_SIGMA_M) ** 2 * np.eye(2)
        self._farthest_m = OUTLIER_SIGMAS * math.hypot(gnss.sigma_m, gnss.multipath_sigma_m, LEAST_SIGMA_M)
        self.members = [np.flatnonzero(component == label) for label in np.unique(component).tolist()]
        self._filters = [KalmanBound(point_m[some], heading_rad[some], model) for some in self.members]
        self._count = len(component)

    def step(self, dt_s: float, fix_m: Array, position_m: Array, common_m: Array) -> None:
        """Advance by `dt_s` and take the fixes (N, 2), NaN where there is none; the truth tells outliers."""
        away_m = np.linalg.norm(fix_m - position_m - common_m, axis=1)
        used_m = np.where((away_m <= self._farthest_m)[:, None], fix_m, np.nan)
        for some, bound in zip(self.members, self._filters, strict=True):
            bound.step(dt_s, used_m[some], self._noise_m2)

    def _of_vehicles(self, found: Sequence[Array]) -> Array:
        """Return an array (N, …) of what each component's filter says (n, …) of its vehicles, or (1, …) of all."""
        whole = np.empty((self._count, *found[0].shape[1:]))
        for some, values in zip(self.members, found, strict=True):
            whole[some] = values
        return whole

    @property
    def common_m(self) -> Array:
        """Estimate (N, 2) of the common error for each vehicle, that of its component."""
        return self._of_vehicles([bound.common_m[None] for bound in self._filters])

    @property
    def common_covariance_m2(self) -> Array:
        """Its covariance (N, 2, 2)."""
        return self._of_vehicles([bound.common_covariance_m2[None] for bound in self._filters])

    @property
    def position_m(self) -> Array:
        """Estimates (N, 2) of the positions."""
        return self._of_vehicles([bound.position_m for bound in self._filters])


@dataclass(frozen=True)
class BoundSeries:
    """Errors of the bound in each period (K,), over the vehicles that reported a common error; NaN where none did.

    common_rmse_m, position_rmse_m: in metres. common_anees: 1 for a consistent filter.
    component_rmse_m: (K, C), the first for each component.
    """

    common_rmse_m: Array
    position_rmse_m: Array
    common_anees: Array
    component_rmse_m: Array

    def after(self, first: int) -> dict[str, Any]:
        """Return roots of the mean squares from period `first` on, of ANEES the mean, by name; None of nothing."""
        return {
            "common_rmse_m": _rms(self.common_rmse_m[first:]),
            "position_rmse_m": _rms(self.position_rmse_m[first:]),
            "common_anees": _mean(self.common_anees[first:]),
            "component_rmse_m": [_rms(column) for column in self.component_rmse_m[first:].T],
        }


def _mean(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None


def _rms(values: Array) -> float | None:
    mean = _mean(values**2)
    return None if mean is None else math.sqrt(mean)


def bound_of(recorded: RecordedRun) -> BoundSeries:
    """Return the errors of the bound of a recorded run. Raises VnetError with the reason if it has none.

    Of the states the columns of `COLUMNS` are needed.
    """
    scenario, world, count = recorded.scenario, recorded.world, len(recorded.node_ids)
    if problem := why_no_bound(scenario, count):
        raise VnetError(problem)
    if recorded.periods * count**2 > MOST_WORK:
        raise VnetError(f"the hears-all bound of {count} vehicles is not computed for {recorded.periods:,} periods")
    if world is None:
        raise VnetError("the lanes of the run were not recorded")
    reported = np.asarray(np.isfinite(recorded.vectors("common_error_estimate_m")).all(axis=2))
    if not reported.any():
        raise VnetError("no program reported a common error")
    position_m, start = recorded.vectors("position_m"), pc.equal(recorded.states["period"], 0)
    heading_rad = recorded.states.filter(start)["heading_rad"].to_numpy()
    links = component_links(scenario, world.radio_inputs, world.position_m)
    lane = lanes_of(position_m[0], heading_rad, world.lane_point_m, world.lane_heading_rad)
    filters = HearsAll(
        scenario,
        world.lane_point_m[lane],
        world.lane_heading_rad[lane],
        components(world.position_m, scenario.radio.range_m, links),
    )
    return _series(filters, scenario.period_ns / NS_PER_S, recorded, reported)


def _series(filters: HearsAll, dt_s: float, recorded: RecordedRun, reported: Mask) -> BoundSeries:
    """Run the filters over all periods; `reported` (K, N) are the reports that count."""
    fix_m, position_m, common_m = (recorded.vectors(name) for name in ("fix_m", "position_m", "common_error_m"))
    periods = len(fix_m)
    common, position, anees = (np.full(periods, np.nan) for _ in range(3))
    by_component = np.full((periods, len(filters.members)), np.nan)
    for k in range(periods):
        filters.step(dt_s if k else 0.0, fix_m[k], position_m[k], common_m[k])
        counts = reported[k]
        if not counts.any():
            continue
        error_m = filters.common_m - common_m[k]
        squares = np.sum(error_m**2, axis=1)
        common[k] = np.sqrt(squares[counts].mean())
        position[k] = np.sqrt(np.sum((filters.position_m - position_m[k])[counts] ** 2, axis=1).mean())
        inverse = np.linalg.inv(filters.common_covariance_m2[counts])
        anees[k] = np.einsum("ni,nij,nj->n", error_m[counts], inverse, error_m[counts]).mean() / 2
        for number, some in enumerate(filters.members):
            if counts[some].any():
                by_component[k, number] = np.sqrt(squares[some][counts[some]].mean())
    return BoundSeries(common, position, anees, by_component)
