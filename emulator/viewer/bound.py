"""The hears-all bound: the error of one filter that hears every fix, at once and without loss.

One particle filter for each connected component of the network, on the same fixes as the vehicles', with the
constants of the world itself. No cooperation of vehicles that hear only each other can be expected to do better.

A step of it takes milliseconds, so that there are two a second, on the mean of each vehicle's fixes: as errors and
speeds hardly change it says what all of them say.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from emulator.scenario.recorded import parse_recorded_scenario
from emulator.stream.messages import unpack
from vnet.cmm.map_matching import MIN_MAP_LOG_LIKELIHOOD
from vnet.cmm.rbpf import Observation, Rbpf, RbpfConfig
from vnet.roads.lanes import LaneMap

PARTICLES = 500
STEP_NS = 500_000_000


class HearsAllBound:
    """Fed with the messages of a run, period by period; see the module's text."""

    def __init__(self, scene: Mapping[str, Any], particles: int = PARTICLES) -> None:
        scenario = parse_recorded_scenario(scene["scenario"], Path("scenario"))
        world = scenario.world
        self._node_ids = scene["node_ids"]
        self._component = np.frombuffer(scene["component"], dtype="<i2")
        self._covariance_m2 = np.eye(2) * max(world.gnss.sigma_m, 1e-3) ** 2
        self._knows_heading = world.gnss.heading
        self._period_ns: int = scene["period_ns"]
        self._begun = False
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
            min_map_log_likelihood=MIN_MAP_LOG_LIKELIHOOD,
        )
        seeds = np.random.default_rng(scenario.run.seed).spawn(int(self._component.max()) + 1)
        self._filters = [Rbpf(config, lanes, seed) for seed in seeds]
        self._forget_fixes()
        self._next_ns: int | None = None
        self._last_ns = 0

    def step(self, period: Mapping[str, Any]) -> float | None:
        """Take the fixes of a period; returns the RMSE of the common error (m) over the vehicles.

        None before the first step, and where nothing was reported of a common error: then there is nothing to
        compare with. Periods that were left out are bridged.
        """
        time_ns = int(period["time_ns"])
        if self._next_ns is None:
            self._last_ns, self._next_ns = time_ns, time_ns + STEP_NS - self._period_ns
        self._take(period, time_ns)
        if time_ns >= self._next_ns:
            self._next_ns = time_ns + STEP_NS
            self._advance(time_ns)
            self._begun = True
        reporting = np.isfinite(unpack(period["common_error_estimate_m"], 2)).all(axis=1)
        if not self._begun or not reporting.any():
            return None
        error_m = np.array([rbpf.estimate_m for rbpf in self._filters]) - unpack(period["common_error_m"], 2)[0]
        squares = np.sum(error_m**2, axis=1)[self._component]
        return float(np.sqrt(squares[reporting].mean()))

    def _forget_fixes(self) -> None:
        """Forget the fixes since the last step."""
        count = len(self._node_ids)
        self._fixes = np.zeros(count, dtype=int)
        self._sum_m, self._sum_s = np.zeros((count, 2)), np.zeros(count)

    def _take(self, period: Mapping[str, Any], time_ns: int) -> None:
        fix_m = unpack(period["fix_m"], 2)
        up = np.frombuffer(period["up"], dtype=np.uint8).astype(bool)
        seen = up & np.isfinite(fix_m).all(axis=1)
        self._fixes += seen
        self._sum_m[seen] += fix_m[seen]
        self._sum_s[seen] += (time_ns - self._last_ns) / 1e9
        self._heading_rad = unpack(period["heading_rad"])[:, 0].tolist()

    def _advance(self, time_ns: int) -> None:
        """One step of all filters, on the mean of each vehicle's fixes, as old as they are in the mean."""
        elapsed_s, self._last_ns = (time_ns - self._last_ns) / 1e9, time_ns
        seen = self._fixes > 0
        fixes = np.maximum(self._fixes, 1)
        mean_m, age_s = self._sum_m / fixes[:, None], elapsed_s - self._sum_s / fixes
        covariance_m2 = self._covariance_m2 / fixes[:, None, None]
        for label, rbpf in enumerate(self._filters):
            observations = {}
            for n in np.flatnonzero(seen & (self._component == label)).tolist():
                heading_rad = self._heading_rad[n] if self._knows_heading else None
                observations[self._node_ids[n]] = Observation(
                    mean_m[n], covariance_m2[n], heading_rad, float(age_s[n])
                )
            rbpf.step(elapsed_s, observations)
        self._forget_fixes()
