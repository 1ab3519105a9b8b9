"""The hears-all bound of a run that is drawn: fed with its messages, period by period."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from emulator.records.hears_all import HearsAll, lanes_of, why_no_bound
from emulator.scenario.recorded import parse_recorded_scenario
from emulator.stream.messages import unpack
from vnet.errors import VnetError
from vnet.types import Array
from vnet.units import NS_PER_S


class HearsAllBound:
    """Takes the messages of a run; see `emulator.records.hears_all`. Raises VnetError if the run has no bound."""

    def __init__(self, scene: Mapping[str, Any]) -> None:
        self._scenario = parse_recorded_scenario(scene["scenario"], Path("scenario"))
        if problem := why_no_bound(self._scenario, len(scene["node_ids"])):
            raise VnetError(problem)
        self._point_m = unpack(scene["lane_point_m"], 2).astype(float)
        self._heading_rad = unpack(scene["lane_heading_rad"])[:, 0].astype(float)
        self._component = np.frombuffer(scene["component"], dtype="<i2")
        self._filters: HearsAll | None = None
        self._last_ns = 0

    def step(self, period: Mapping[str, Any]) -> float | None:
        """Take the fixes of a period; returns the RMSE of the common error (m) over the vehicles.

        None where nothing was reported of a common error: then there is nothing to compare with. Periods that were
        left out are bridged.
        """
        time_ns = int(period["time_ns"])
        position_m = unpack(period["position_m"], 2).astype(float)
        common_m = unpack(period["common_error_m"], 2).astype(float)[0]
        if self._filters is None:
            self._filters = self._placed(position_m, unpack(period["heading_rad"])[:, 0].astype(float))
            self._last_ns = time_ns
        elapsed_s, self._last_ns = (time_ns - self._last_ns) / NS_PER_S, time_ns
        up = np.frombuffer(period["up"], dtype=np.uint8).astype(bool)
        fix_m = np.where(up[:, None], unpack(period["fix_m"], 2), np.nan)
        self._filters.step(elapsed_s, fix_m, position_m, common_m)
        reporting = np.isfinite(unpack(period["common_error_estimate_m"], 2)).all(axis=1)
        if not reporting.any():
            return None
        squares = np.sum((self._filters.common_m - common_m) ** 2, axis=1)
        return float(np.sqrt(squares[reporting].mean()))

    def _placed(self, position_m: Array, heading_rad: Array) -> HearsAll:
        lane = lanes_of(position_m, heading_rad, self._point_m, self._heading_rad)
        return HearsAll(self._scenario, self._point_m[lane], self._heading_rad[lane], self._component)
