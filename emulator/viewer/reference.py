"""The reference of a run that is drawn: fed with its messages, period by period."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from emulator.records.period_figures import figures_if_here
from emulator.records.reference import Setting, reference_of
from emulator.records.tables import STATES, columns_of
from emulator.scenario.declared import declared, load_entry
from emulator.scenario.recorded import parse_recorded_scenario
from emulator.stream.messages import unpack
from vnet.errors import VnetError
from vnet.types import Array


class DrawnReference:
    """Takes the messages of a run; see `emulator.records.reference`. Raises VnetError if it has no reference."""

    def __init__(self, scene: Mapping[str, Any]) -> None:
        scenario = parse_recorded_scenario(scene["scenario"], Path("scenario"))
        kind = reference_of(scenario)
        self.label, self._columns, self._count = f"{kind.NAME}: {kind.TEXT}", kind.COLUMNS, len(scene["node_ids"])
        point_m = unpack(scene["lane_point_m"], 2).astype(float)
        heading_rad = unpack(scene["lane_heading_rad"])[:, 0].astype(float)
        component = np.frombuffer(scene["component"], dtype="<i2")
        self._sizes = {
            name: each.type.list_size if pa.types.is_fixed_size_list(each.type) else 1
            for name, each in columns_of(STATES, figures_if_here(scenario.program)).items()
        }
        if unknown := [name for name in self._columns if name not in self._sizes]:
            raise VnetError(f"its column {unknown[0]!r} is neither vnet's nor declared")
        self._reference = kind(Setting(scenario, component, point_m, heading_rad))

    def step(self, period: Mapping[str, Any]) -> dict[str, float]:
        """Take a period; returns its figures of the whole network by name. Periods may be left out."""
        told = {**period["columns"], **period}
        states = {name: self._column(name, told[name]) for name in self._columns}
        up = np.frombuffer(period["up"], dtype=np.uint8).astype(bool)
        states["fix_m"] = np.where(up[:, None], states["fix_m"], np.nan)
        figures = self._reference.step(int(period["time_ns"]), states)
        return {name: figure for name, figure in figures.items() if not isinstance(figure, list)}

    def _column(self, name: str, data: bytes) -> Array:
        """Return a column of the states, with a row for each vehicle."""
        size = self._sizes[name]
        if size == 1:
            return unpack(data)[:, 0].astype(float)
        return np.broadcast_to(unpack(data, size).astype(float), (self._count, size))


def published(scene: Mapping[str, Any]) -> dict[str, tuple[str, float]]:
    """Return what has been published of such a run, as its programs declare it: a label and a value by figure."""
    found: dict[str, tuple[str, float]] = {}
    try:
        scenario = parse_recorded_scenario(scene["scenario"], Path("scenario"))
        for entry in declared(scenario.program, "PUBLISHED"):
            found |= load_entry(entry)(scene)
    except VnetError:  # a run is drawn all the same
        return {}
    return found
