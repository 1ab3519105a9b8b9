"""Samples of trips as they come from a file, batch by batch: checked, bounded, and sorted by vehicle.

A file is refused whole, with its row or line, where an id cannot be one, a number is none, a vehicle's time goes
backwards, or a vehicle is in two places at a time. The same sample twice counts once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from emulator.scenario.scenario import FAR_S
from emulator.world.networks import FARTHEST_M
from emulator.world.projection import middle_deg, project
from vnet.errors import ScenarioError, shown
from vnet.transport.keys import is_segment
from vnet.types import Array

MOST_SAMPLES = 10_000_000
"""How many samples are kept in memory."""
MOST_IDS = 100_000
"""How many vehicles a file may name; far fewer can take part."""
METRES = ("x_m", "y_m")
DEGREES = ("lat_deg", "lon_deg")
OPTIONAL = ("heading_rad", "speed_mps")
_LIMIT = {
    "time_s": FAR_S,
    "x_m": FARTHEST_M,
    "y_m": FARTHEST_M,
    "lat_deg": 84.0,
    "lon_deg": 180.0,
    "heading_rad": 1e6,
    "speed_mps": 1e6,
}


@dataclass(frozen=True)
class Trip:
    """What a file says of one vehicle: `time_s` (n,) rising, `position_m` (n, 2), and where it says so, its
    `heading_rad` and `speed_mps` (n,).
    """

    node_id: str
    time_s: Array
    position_m: Array
    heading_rad: Array | None = None
    speed_mps: Array | None = None


class Samples:
    """Takes a file's samples in its order.

    `unit` is what messages count (row, line); only samples within `window_s`, if it is given, are kept.
    `origin_deg` (latitude, longitude) is where metres start, once there are trips that were in degrees.
    """

    def __init__(self, path: Path, unit: str, window_s: tuple[float, float] | None = None) -> None:
        self._path = path
        self._unit = unit
        self.origin_deg: tuple[float, float] | None = None
        self._window_s = window_s
        self._code: dict[str, int] = {}
        self._last: dict[str, Array] = {}
        self._kept: list[dict[str, Array]] = []
        self._count = 0
        self.taken = 0

    def add(self, ids: pa.Array, place: NDArray[np.int64], columns: dict[str, Array]) -> None:
        """Take a batch: ids (n,) as text, which row or line each is, and `columns` (n,), always the same ones.

        Raises ScenarioError for the first sample that cannot be.
        """
        self.taken += len(place)
        for name, values in columns.items():
            wrong = np.flatnonzero(~(np.abs(values) <= _LIMIT[name]))  # NaN is in no range
            if len(wrong):
                limit = f"a finite number is needed, within ±{_LIMIT[name]:g}"
                raise self._problem(place[wrong[0]], f"{name} = {values[wrong[0]]:g}: {limit}")
        columns = {"code": self._codes(ids, place).astype(float), **columns}
        self._keep(columns, self._new(columns, place))

    def _problem(self, place: np.int64, text: str) -> ScenarioError:
        return ScenarioError(f"{self._path}: {self._unit} {place}: {text}")

    def _codes(self, ids: pa.Array, place: NDArray[np.int64]) -> NDArray[np.int64]:
        """A number for each id, in the order in which they first appear."""
        encoded = ids.dictionary_encode()
        index = np.asarray(pc.fill_null(encoded.indices, -1))
        if (index < 0).any():
            raise self._problem(place[np.argmax(index < 0)], "id is missing")
        names = [str(name) for name in encoded.dictionary.to_pylist()]
        for number, name in enumerate(names):
            if not is_segment(name):
                text = f"id = {shown(name)}: letters, digits, '_', '.', '-', at most 64"
                raise self._problem(place[np.argmax(index == number)], text)
        codes = [self._code.setdefault(name, len(self._code)) for name in names]
        if len(self._code) > MOST_IDS:
            raise ScenarioError(f"{self._path}: more than {MOST_IDS:,} vehicles")
        return np.array(codes, dtype=np.int64)[index] if len(codes) else np.zeros(0, np.int64)

    def _new(self, columns: dict[str, Array], place: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which samples are not those of before once more. Each vehicle's time must rise.

        The last sample of each vehicle so far is put before the batch, so that a batch's edge hides nothing.
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
            raise self._out_of_order(int(wrong.min()), len(before["code"]), both, order, place)
        self._last = {
            name: values[np.append(~same, True) if len(order) else []] for name, values in _by(both, order)
        }
        new = np.ones(len(order), dtype=bool)
        new[ours[same & (step_s == 0)]] = False
        return new[len(before["code"]) :]

    def _out_of_order(
        self, row: int, known: int, both: dict[str, Array], order: NDArray[np.intp], place: NDArray[np.int64]
    ) -> ScenarioError:
        previous = order[np.flatnonzero(order == row)[0] - 1]
        name = list(self._code)[int(both["code"][row])]
        now_s, before_s = both["time_s"][row], both["time_s"][previous]
        if now_s == before_s:
            return self._problem(place[row - known], f"{name} is in two places at time_s = {now_s:.10g}")
        text = f"{name}: time_s = {now_s:.10g} after {before_s:.10g}: a vehicle's times must rise"
        return self._problem(place[row - known], text)

    def _keep(self, columns: dict[str, Array], new: NDArray[np.bool_]) -> None:
        if self._window_s is not None:
            new &= (self._window_s[0] <= columns["time_s"]) & (columns["time_s"] <= self._window_s[1])
        self._count += int(new.sum())
        if self._count > MOST_SAMPLES:
            more = "" if self._window_s else "; with network.start_s only those of the run's time are kept"
            raise ScenarioError(f"{self._path}: more than {MOST_SAMPLES:,} samples{more}")
        if new.any():
            self._kept.append({name: values[new] for name, values in columns.items()})

    def trips(self, origin_deg: tuple[float, float] | None) -> list[Trip]:
        """The trips, in the order in which vehicles first appear in the file; metres by `origin_deg` if need be."""
        if not self.taken:
            raise ScenarioError(f"{self._path}: no samples; at least one vehicle with two is needed")
        if not self._kept:
            raise ScenarioError(
                f"{self._path}: none of its {self.taken:,} samples is in the run's time; set start_s"
            )
        columns = {name: np.concatenate([part[name] for part in self._kept]) for name in self._kept[0]}
        self._kept = []
        position_m = self._positions_m(columns, origin_deg)
        order = np.argsort(columns["code"], kind="stable")
        code = columns["code"][order].astype(np.int64)
        names = list(self._code)
        trips = []
        for rows in np.split(order, np.flatnonzero(np.diff(code)) + 1):
            known = {name: columns[name][rows] for name in OPTIONAL if name in columns}
            name = names[int(columns["code"][rows[0]])]
            trips.append(Trip(name, columns["time_s"][rows], position_m[rows], **known))
        return trips

    def _positions_m(self, columns: dict[str, Array], origin_deg: tuple[float, float] | None) -> Array:
        if METRES[0] in columns:
            position_m = np.column_stack([columns[name] for name in METRES])
            if len(self._code) > 1 and np.ptp(position_m, axis=0).max() < 1.0:
                raise ScenarioError(f"{self._path}: all of x_m, y_m within a metre: are these degrees?")
            return position_m
        latitude_deg, longitude_deg = columns["lat_deg"], columns["lon_deg"]
        self.origin_deg = origin_deg or middle_deg(latitude_deg, longitude_deg)
        return project(self._path, latitude_deg, longitude_deg, self.origin_deg)[1]


def _by(columns: dict[str, Array], order: NDArray[np.intp]) -> list[tuple[str, Array]]:
    return [(name, values[order]) for name, values in columns.items()]
