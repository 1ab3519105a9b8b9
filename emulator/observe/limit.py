"""The limit of cooperation: what one filter would find that heard every fix, at once and without loss.

One particle filter for each connected component of the network, on the same fixes as the vehicles', with the
constants of the world itself. No cooperation of vehicles that hear only each other can be expected to do better.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from typing import Any

import numpy as np

from emulator.observe.observation import unpack
from vnet.cmm.rbpf import Observation, Rbpf, RbpfConfig
from vnet.roads.lanes import LaneMap
from vnet.scenario import Scenario

PARTICLES = 500
LEAST_LOG_ROAD = -6.0
"""As the vehicles: one whose fixes are false must not outvote all others."""


class Limit:
    """Fed with the messages of a run, period by period; see the module's text."""

    def __init__(self, scene: Mapping[str, Any], particles: int = PARTICLES) -> None:
        data = tomllib.loads(scene["scenario"])
        data.pop("inputs", None)
        scenario = Scenario.model_validate(data)
        world = scenario.world
        self._node_ids = scene["node_ids"]
        self._component = np.frombuffer(scene["component"], dtype="<i2")
        self._covariance_m2 = np.eye(2) * max(world.gnss.sigma_m, 1e-3) ** 2
        self._knows_heading = world.gnss.heading
        lanes = LaneMap(
            unpack(scene["lane_point_m"], 2).astype(float),
            unpack(scene["lane_heading_rad"])[:, 0].astype(float),
            world.lateral.half_width_m,
        )
        config = RbpfConfig(
            particles,
            max(world.common_error.sigma_m, 1e-3),
            world.common_error.tau_s,
            lateral_tau_s=world.lateral.tau_s,
            least_log_road=LEAST_LOG_ROAD,
        )
        seeds = np.random.default_rng(scenario.run.seed).spawn(int(self._component.max()) + 1)
        self._filters = [Rbpf(config, lanes, seed) for seed in seeds]
        self._last_ns: int | None = None

    def step(self, period: Mapping[str, Any]) -> float | None:
        """Take the fixes of a period; returns the RMSE of the common error (m) over the vehicles.

        None where nothing was reported of a common error: then there is nothing to compare with. Periods that
        were left out are bridged.
        """
        fix_m = unpack(period["fix_m"], 2)
        heading_rad = unpack(period["heading_rad"])[:, 0]
        up = np.frombuffer(period["up"], dtype=np.uint8).astype(bool)
        seen = up & np.isfinite(fix_m).all(axis=1)
        time_ns = int(period["time_ns"])
        elapsed_s = 0.0 if self._last_ns is None else (time_ns - self._last_ns) / 1e9
        self._last_ns = time_ns
        truth_m = unpack(period["common_error_m"], 2)[0]
        squares = np.zeros(len(self._node_ids))
        for label, rbpf in enumerate(self._filters):
            group = self._component == label
            rbpf.step(
                elapsed_s,
                {self._node_ids[i]: self._see(fix_m[i], heading_rad[i]) for i in np.flatnonzero(group & seen)},
            )
            squares[group] = np.sum((rbpf.estimate_m - truth_m) ** 2)
        reporting = np.isfinite(unpack(period["common_error_estimate_m"], 2)).all(axis=1)
        return float(np.sqrt(squares[reporting].mean())) if reporting.any() else None

    def _see(self, fix_m: Any, heading_rad: float) -> Observation:
        heading = float(heading_rad) if self._knows_heading else None
        return Observation(fix_m.astype(float), self._covariance_m2, heading)
