"""The hears-all bound of a run, its reference: one Kalman filter a component that hears every fix without loss.

It is told more than any vehicle: the world's laws, each vehicle's lane, and which fixes are outliers. So no program
that learns from the positions of the same fixes, for vehicles that may drive, can be expected to do better. What
their speeds tell, as that vehicles stand, it leaves aside. It exists where vehicles stand on straight lanes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.cmm.kalman_bound import KalmanBound, LaneModel, MultipathLaneModel
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
SAME_RAD = 1e-4
"""Angle within which a vehicle's heading is that of its lane."""


def why_no_bound(scenario: Any, vehicles: int) -> str:
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


def lane_model(scenario: Any) -> LaneModel:
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
    """The filters of all components; `members` are the vehicles of each.

    `setting` has the `scenario`, the label of each vehicle's `component`, a point and the direction of each lane
    (`lane_point_m`, `lane_heading_rad`), and the number of `periods` of a run that is over. Raises VnetError for
    one without a bound.
    """

    NAME = "bound"
    TEXT = "a Kalman filter that hears every fix of its component"
    COLUMNS = ("position_m", "heading_rad", "fix_m", "common_error_m", "common_error_estimate_m")

    def __init__(self, setting: Any) -> None:
        self._scenario, self._count = setting.scenario, len(setting.component)
        if problem := why_no_bound(self._scenario, self._count):
            raise VnetError(problem)
        if (setting.periods or 0) * self._count**2 > MOST_WORK:
            raise VnetError(
                f"the hears-all bound of {self._count} vehicles is not computed for {setting.periods:,} periods"
            )
        gnss = self._scenario.world.gnss
        self._lanes = setting.lane_point_m, setting.lane_heading_rad
        self._noise_m2 = max(gnss.sigma_m, LEAST_SIGMA_M) ** 2 * np.eye(2)
        self._farthest_m = OUTLIER_SIGMAS * math.hypot(gnss.sigma_m, gnss.multipath_sigma_m, LEAST_SIGMA_M)
        self.members = [np.flatnonzero(setting.component == each) for each in np.unique(setting.component).tolist()]
        self._filters: list[KalmanBound] = []
        self._last_ns = 0

    def step(self, time_ns: int, states: Mapping[str, Array]) -> dict[str, float | list[float]]:
        """Take the fixes of a period, NaN where there is none; the truth tells outliers. Periods may be left out.

        Returns the errors over the vehicles that report a common error; nothing where none does.
        """
        position_m, fix_m, common_m = states["position_m"], states["fix_m"], states["common_error_m"]
        if not self._filters:
            self._place(position_m, states["heading_rad"])
            self._last_ns = time_ns
        elapsed_s, self._last_ns = (time_ns - self._last_ns) / NS_PER_S, time_ns
        away_m = np.linalg.norm(fix_m - position_m - common_m, axis=1)
        used_m = np.where((away_m <= self._farthest_m)[:, None], fix_m, np.nan)
        for some, bound in zip(self.members, self._filters, strict=True):
            bound.step(elapsed_s, used_m[some], self._noise_m2)
        counts = np.asarray(np.isfinite(states["common_error_estimate_m"]).all(axis=1))
        return self._errors(position_m, common_m, counts) if counts.any() else {}

    def _place(self, position_m: Array, heading_rad: Array) -> None:
        """Make the filters: vehicles stand on their lanes."""
        lane = lanes_of(position_m, heading_rad, *self._lanes)
        point_m, heading_rad = self._lanes[0][lane], self._lanes[1][lane]
        model = lane_model(self._scenario)
        self._filters = [KalmanBound(point_m[some], heading_rad[some], model) for some in self.members]

    def _errors(self, position_m: Array, common_m: Array, counts: Mask) -> dict[str, float | list[float]]:
        error_m = self._of_vehicles([bound.common_m[None] for bound in self._filters]) - common_m
        squares = np.sum(error_m**2, axis=1)
        away_m = self._of_vehicles([bound.position_m for bound in self._filters]) - position_m
        covariance_m2 = self._of_vehicles([bound.common_covariance_m2[None] for bound in self._filters])
        inverse = np.linalg.inv(covariance_m2[counts])
        anees = np.einsum("ni,nij,nj->n", error_m[counts], inverse, error_m[counts]).mean() / 2
        return {
            "common_error_rmse_m": float(np.sqrt(squares[counts].mean())),
            "position_rmse_m": float(np.sqrt(np.sum(away_m[counts] ** 2, axis=1).mean())),
            "common_error_anees": float(anees),
            "component_rmse_m": [
                float(np.sqrt(squares[some][counts[some]].mean())) if counts[some].any() else math.nan
                for some in self.members
            ],
        }

    def _of_vehicles(self, found: Sequence[Array]) -> Array:
        """Return an array (N, …) of what each component's filter says (n, …) of its vehicles, or (1, …) of all."""
        whole = np.empty((self._count, *found[0].shape[1:]))
        for some, values in zip(self.members, found, strict=True):
            whole[some] = values
        return whole
