"""Samples of trips, taken from a file in batches: checked, bounded, and sorted by vehicle.

A file is refused, with the row or line, for an invalid id or number, for a vehicle whose time goes backwards, and
for a vehicle with two positions at one time. Repeated samples count once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from emulator.scenario.network import node_id
from emulator.scenario.sections import FAR_S
from emulator.world.networks import MAX_COORDINATE_M
from emulator.world.projection import middle_deg, project
from vnet.errors import ScenarioError, first_names, shown
from vnet.transport.keys import is_segment
from vnet.types import Array

MOST_SAMPLES = 10_000_000
"""Most samples that are kept in memory."""
MOST_IDS = 100_000
"""Most vehicles that a file may name; far fewer can take part."""
METRES = ("x_m", "y_m")
"""Columns of positions in metres."""
DEGREES = ("lat_deg", "lon_deg")
"""Columns of positions in degrees."""
OPTIONAL = ("heading_rad", "speed_mps")
"""Columns that a file may lack."""
_BOUND = {
    "time_s": FAR_S,
    "x_m": MAX_COORDINATE_M,
    "y_m": MAX_COORDINATE_M,
    "lat_deg": 84.0,
    "lon_deg": 180.0,
    "heading_rad": 1e6,
    "speed_mps": 1e6,
}


@dataclass(frozen=True)
class Trip:
    """One vehicle's samples: `time_s` (n,) increasing, `position_m` (n, 2), and optionally `heading_rad` and
    `speed_mps` (n,).
    """

    node_id: str
    time_s: Array
    position_m: Array
    heading_rad: Array | None = None
    speed_mps: Array | None = None


class Samples:
    """The samples of a file, added in its order.

    `unit` is what messages count (row or line). Only samples within `window_s` are kept, if it is given.
    `origin_deg` (latitude, longitude) is the origin of the metres of trips that were in degrees, and `notes` are
    lines for the user; both are set by `trips`.
    """

    def __init__(self, path: Path, unit: str, window_s: tuple[float, float] | None = None) -> None:
        self._path = path
        self._unit = unit
        self.origin_deg: tuple[float, float] | None = None
        self.notes: list[str] = []
        self._window_s = window_s
        self._code: dict[str, int] = {}
        self._last: dict[str, Array] = {}
        self._kept: list[dict[str, Array]] = []
        self._count = 0
        self.taken = 0

    def add(self, ids: pa.Array, line: NDArray[np.int64], columns: dict[str, Array]) -> None:
        """Add a batch: ids (n,) as text, `line` (n,) the row or line of each, and `columns` (n,), always the same.

        Raise ScenarioError for the first invalid sample.
        """
        self.taken += len(line)
        for name, values in columns.items():
            wrong = np.flatnonzero(~(np.abs(values) <= _BOUND[name]))  # NaN is in no range
            if len(wrong):
                needed = f"a finite number is needed, within ±{_BOUND[name]:g}"
                raise self._problem(line[wrong[0]], f"{name} = {values[wrong[0]]:g}: {needed}")
        columns = {"code": self._codes(ids, line).astype(float), **columns}
        self._keep(columns, self._new(columns, line))

    def _problem(self, line: np.int64, text: str) -> ScenarioError:
        return ScenarioError(f"{self._path}: {self._unit} {line}: {text}")

    def _codes(self, ids: pa.Array, line: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return a number (n,) for each id, in the order in which ids first appear."""
        encoded = ids.dictionary_encode()
        index = np.asarray(pc.fill_null(encoded.indices, -1))
        if (index < 0).any():
            raise self._problem(line[np.argmax(index < 0)], "id is missing")
        names = [str(name) for name in encoded.dictionary.to_pylist()]
        for number, name in enumerate(names):
            if not is_segment(node_id(name)):
                text = f"id = {shown(name)}: printable characters are needed, at most 64"
                raise self._problem(line[np.argmax(index == number)], text)
        codes = [self._code.setdefault(name, len(self._code)) for name in names]
        if len(self._code) > MOST_IDS:
            raise ScenarioError(f"{self._path}: more than {MOST_IDS:,} vehicles")
        return np.array(codes, dtype=np.int64)[index] if len(codes) else np.zeros(0, np.int64)

    def _new(self, columns: dict[str, Array], line: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return the mask (n,) of samples that do not repeat the one before. Each vehicle's time must increase.

        The last sample of each vehicle so far is put before the batch, so the check spans batches.
        """
        before = self._last or {name: values[:0] for name, values in columns.items()}
        both = {name: np.concatenate([before[name], values]) for name, values in columns.items()}
        order = np.argsort(both["code"], kind="stable")
        ours, theirs = order[1:], order[:-1]
        same = both["code"][ours] == both["code"][theirs]
        step_s = both["time_s"][ours] - both["time_s"][theirs]
        where = METRES if METRES[0] in columns else DEGREES
        moved = np.any([both[name][ours] != both[name][theirs] for name in where], axis=0)
        wrong = ours[same & ((step_s < 0) | ((step_s == 0) & moved))]
        if len(wrong):
            raise self._out_of_order(int(wrong.min()), len(before["code"]), both, order, line)
        self._last = {
            name: values[np.append(~same, True) if len(order) else []]
            for name, values in _sorted_columns(both, order)
        }
        new = np.ones(len(order), dtype=bool)
        new[ours[same & (step_s == 0)]] = False
        return new[len(before["code"]) :]

    def _out_of_order(
        self, row: int, known: int, both: dict[str, Array], order: NDArray[np.intp], line: NDArray[np.int64]
    ) -> ScenarioError:
        previous = order[np.flatnonzero(order == row)[0] - 1]
        name = list(self._code)[int(both["code"][row])]
        now_s, before_s = both["time_s"][row], both["time_s"][previous]
        if now_s == before_s:
            return self._problem(line[row - known], f"{name} has two positions at time_s = {now_s:.10g}")
        text = f"{name}: time_s = {now_s:.10g} after {before_s:.10g}: a vehicle's times must increase"
        return self._problem(line[row - known], text)

    def _keep(self, columns: dict[str, Array], new: NDArray[np.bool_]) -> None:
        if self._window_s is not None:
            new &= (self._window_s[0] <= columns["time_s"]) & (columns["time_s"] <= self._window_s[1])
        self._count += int(new.sum())
        if self._count > MOST_SAMPLES:
            more = "" if self._window_s else "; set network.start_s to keep only those of the run's time"
            raise ScenarioError(f"{self._path}: more than {MOST_SAMPLES:,} samples{more}")
        if new.any():
            self._kept.append({name: values[new] for name, values in columns.items()})

    def trips(self, origin_deg: tuple[float, float] | None) -> list[Trip]:
        """Return the trips in the order in which vehicles first appear in the file.

        Degrees become metres around `origin_deg`, or around the samples' centre. Raise ScenarioError without
        samples.
        """
        if not self.taken:
            raise ScenarioError(f"{self._path}: no samples; at least one vehicle with two samples is needed")
        if not self._kept:
            raise ScenarioError(
                f"{self._path}: none of its {self.taken:,} samples is in the run's time; set network.start_s"
            )
        columns = {name: np.concatenate([part[name] for part in self._kept]) for name in self._kept[0]}
        self._kept = []
        position_m = self._positions_m(columns, origin_deg)
        order = np.argsort(columns["code"], kind="stable")
        code = columns["code"][order].astype(np.int64)
        names = self._node_ids()
        trips = []
        for rows in np.split(order, np.flatnonzero(np.diff(code)) + 1):
            known = {name: columns[name][rows] for name in OPTIONAL if name in columns}
            name = names[int(columns["code"][rows[0]])]
            trips.append(Trip(name, columns["time_s"][rows], position_m[rows], **known))
        return trips

    def _node_ids(self) -> list[str]:
        """Return the ids of the nodes, in the order of their numbers. Raise ScenarioError if two are the same."""
        by_id: dict[str, str] = {}
        for name in self._code:
            if (other := by_id.setdefault(node_id(name), name)) != name:
                raise ScenarioError(f"{self._path}: ids {shown(other)} and {shown(name)} are both {node_id(name)}")
        renamed = [f"{shown(name)} is {id_}" for id_, name in by_id.items() if id_ != name]
        if renamed:
            some = first_names(renamed, most=3, with_total=True)
            self.notes.append(f"ids with characters that keys of messages cannot hold are escaped: {some}")
        return list(by_id)

    def _positions_m(self, columns: dict[str, Array], origin_deg: tuple[float, float] | None) -> Array:
        if METRES[0] in columns:
            position_m = np.column_stack([columns[name] for name in METRES])
            if len(self._code) > 1 and np.ptp(position_m, axis=0).max() < 1.0:
                raise ScenarioError(f"{self._path}: all of x_m, y_m within a metre: are these degrees?")
            return position_m
        latitude_deg, longitude_deg = columns["lat_deg"], columns["lon_deg"]
        self.origin_deg = origin_deg or middle_deg(latitude_deg, longitude_deg)
        return project(self._path, latitude_deg, longitude_deg, self.origin_deg)[1]


def _sorted_columns(columns: dict[str, Array], order: NDArray[np.intp]) -> list[tuple[str, Array]]:
    return [(name, values[order]) for name, values in columns.items()]
