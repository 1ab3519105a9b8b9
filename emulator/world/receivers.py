"""GNSS receivers: each vehicle's errors beyond the common one, and the headings and speeds that it is told."""

from __future__ import annotations

import math

import numpy as np

from emulator.scenario.random_streams import stream
from emulator.scenario.scenario import Scenario
from emulator.world.common_error import gauss_markov
from vnet.types import Array
from vnet.units import NS_PER_S

M_PER_KM = 1000.0
SLOWEST_MPS = 1e-9
"""Speed of a vehicle that stands, as a divisor."""
EVERY = slice(None)
"""All periods."""


def noise_m(scenario: Scenario, periods: int, count: int) -> Array:
    """Draw the receivers' white noise (K, N, 2) in metres."""
    seed = scenario.run.seed
    normal = [stream(seed, "gnss", vehicle).standard_normal((periods, 2)) for vehicle in range(count)]
    return scenario.world.gnss.sigma_m * np.stack(normal, axis=1)


def further_error_m(
    scenario: Scenario, position_m: Array, middle_m: Array, receiver_m: Array | None
) -> Array | None:
    """Return what fixes have beyond truth, common error and noise (K, N, 2), in metres; None if there is nothing.

    That is multipath, outliers, the gradient of the common error at `position_m` (K, N, 2) around `middle_m` (2,),
    and what the receivers of a file have beyond their mean, `receiver_m` (K, R, 2).
    """
    gnss, common = scenario.world.gnss, scenario.world.common_error
    periods, count = position_m.shape[:2]
    parts: list[Array] = []
    if gnss.multipath_sigma_m:
        parts.append(_multipath_m(scenario, periods, count))
    if gnss.outlier_probability and gnss.outlier_m:
        parts.append(_outliers_m(scenario, periods, count))
    if common.gradient_m_per_km:
        law = common.gradient_m_per_km, common.tau_s
        gradient = gauss_markov(scenario, "common error gradient", law, (periods, 2, 2))
        parts.append(np.einsum("kij,knj->kni", gradient, (position_m - middle_m) / M_PER_KM))
    if receiver_m is not None:
        parts.append(receiver_m[:periods, np.arange(count) % receiver_m.shape[1]])
    return np.sum(parts, axis=0) if parts else None


def _multipath_m(scenario: Scenario, periods: int, count: int) -> Array:
    law = scenario.world.gnss.multipath_sigma_m, scenario.world.gnss.multipath_tau_s
    return np.stack([gauss_markov(scenario, "multipath", law, (periods, 2), n) for n in range(count)], axis=1)


def _outliers_m(scenario: Scenario, periods: int, count: int) -> Array:
    gnss = scenario.world.gnss
    draws = np.stack([stream(scenario.run.seed, "outlier", n).random((periods, 2)) for n in range(count)], axis=1)
    angle = 2 * math.pi * draws[..., 1]
    away_m = np.where(draws[..., 0] < gnss.outlier_probability, gnss.outlier_m, 0.0)
    return np.stack([away_m * np.cos(angle), away_m * np.sin(angle)], axis=-1)


class MotionSensors:
    """Headings and speeds as receivers tell them: the truth with noise that is drawn in advance.

    `rows` are the periods of the truth that is given: all at once, or one after the other as vehicles drive.
    """

    def __init__(self, scenario: Scenario, periods: int, count: int) -> None:
        self._gnss, seed = scenario.world.gnss, scenario.run.seed

        def normal(name: str, is_needed: bool) -> Array | None:
            if not is_needed:
                return None
            return np.stack([stream(seed, name, n).standard_normal(periods) for n in range(count)], axis=1)

        self._heading_normal = normal("heading", self._gnss.heading)
        self._speed_normal = normal("speed", self._gnss.speed_sigma_mps > 0)

    def heading_rad(self, heading_rad: Array, speed: Array, rows: slice = EVERY) -> Array:
        """Return the headings (k, N) of fixes in radians, [0, 2π); NaN for a fix without one."""
        gnss = self._gnss
        if self._heading_normal is None:
            return np.full(heading_rad.shape, np.nan)
        sigma_rad: Array | float = gnss.heading_sigma_rad
        if gnss.heading_speed_sigma_mps:
            by_speed = gnss.heading_speed_sigma_mps / np.maximum(speed, SLOWEST_MPS)
            sigma_rad = np.minimum(np.hypot(sigma_rad, by_speed), math.pi)
        heading = np.mod(heading_rad + sigma_rad * self._heading_normal[rows], 2 * np.pi)
        if gnss.heading_min_speed_mps:
            heading[speed < gnss.heading_min_speed_mps] = np.nan
        return np.asarray(heading)

    def speed_mps(self, speed: Array, rows: slice = EVERY) -> Array:
        """Return the speeds (k, N) of fixes in m/s, which are never negative; NaN for an absent vehicle."""
        if self._speed_normal is None:
            return speed
        return np.asarray(np.abs(speed + self._gnss.speed_sigma_mps * self._speed_normal[rows]))


def speed_mps(position_m: Array, period_ns: int, moves: bool) -> Array:
    """Return the vehicles' speeds (K, N) from positions (K, N, 2) in metres; NaN for an absent vehicle.

    They are means over the periods before and after. Vehicles that do not drive stand, however they sway.
    """
    absent = np.isnan(position_m[..., 0])
    if not moves:
        return np.where(absent, np.nan, 0.0)
    step_mps = np.linalg.norm(np.diff(position_m, axis=0), axis=2) / (period_ns / NS_PER_S)
    edge = np.full((1, position_m.shape[1]), np.nan)
    before, after = np.concatenate([edge, step_mps]), np.concatenate([step_mps, edge])
    known = np.isfinite(before).astype(int) + np.isfinite(after)
    total = np.nan_to_num(before) + np.nan_to_num(after)
    return np.where(absent, np.nan, total / np.maximum(known, 1))
