"""Motion of vehicles: samples of trips, checked, cleaned and interpolated, and lateral offsets in lanes.

Samples are taken from a file in batches: checked, bounded, and sorted by vehicle. A file is refused, with the row
or line, for an invalid id or number, for a vehicle whose time goes backwards, and for a vehicle with two positions
at one time. Repeated samples count once.

Held positions: a repeated position means a standing vehicle, unless it then moves faster than a vehicle can from a
standstill. Then its receiver held the position (as files do that repeat samples to reach a rate), and repetitions
for up to `longest_gap_s` are dropped. Jumps: if two samples are further apart than `fastest_mps`, or the speed
around them, allows, the largest set of samples without a jump is kept. Gaps: across a gap of up to `longest_gap_s`
the vehicle moves linearly from sample to sample; after a longer one it has left, and enters again. docs/motion.md
has examples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from emulator.scenario.network import node_id
from emulator.scenario.sections import FAR_S
from emulator.world.networks import HEADINGS_NOTE, MAX_COORDINATE_M, MOST_TURNED_RAD
from emulator.world.projection import middle_deg, project
from vnet.errors import ScenarioError, counted, first_names, shown
from vnet.transport.keys import is_segment
from vnet.types import Array
from vnet.units import NS_PER_S

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
MAX_ACCELERATION_MPS2 = 10.0
"""Greatest acceleration of a vehicle from a standstill."""
MAX_JUMP_SHARE = 0.05
"""Greatest share of jumps in a trip: with more, its units, projection or ids are wrong."""
ALWAYS_ALLOWED_JUMPS = 10
"""Jumps that are allowed in every trip, however short."""
MAX_SKIPPED_RUNS = 20
"""Most runs of samples that a chain skips."""
MAX_SKIPPED_SAMPLES = 5
"""Most samples before a jump that a chain skips: a filter in the receiver spreads a jump over a few."""
SPEED_WINDOW_S = 10.0
"""Time around a step whose median speed is that of the vehicle: longer than what a jump is spread over."""
FEWEST_IN_WINDOW = 11
"""Fewest steps in this time; with fewer samples a second a single step may differ from all around it."""
MOST_IN_WINDOW = 101
"""Most steps in this time, for speed."""
FASTER_THAN_AROUND = 1.5
FASTER_THAN_AROUND_MPS = 5.0
"""A vehicle is at most so many times, and so much, faster than it drives at the time. Hard braking and full
acceleration stay far below."""
SMALL_JUMP_M = 3.0
"""Shorter steps are no jumps by the speed around them: rounding and noise of standing receivers."""
_CHUNK = 10_000
"""Steps whose windows are in memory at once."""
Rows = NDArray[np.intp]
STANDING_MPS = 0.5
"""Speed below which a vehicle stands and keeps its heading."""
ACCELERATION_S = 0.5
"""Time before and after an instant over which speeds are taken for an acceleration: recordings have noise."""
CHORD_S = 0.5
"""Half of the time over which a heading is computed from positions."""
SHORTEST_STAY_S = 1.0
"""Shortest presence of a vehicle that takes part."""
MOST_LEFT_OUT = 0.5
"""Largest share of vehicles that are left out; if more are impossible, the file's units or ids are wrong."""
MOST_STATES = 50_000_000
"""Most vehicles times periods, so that the truth fits into memory."""


@dataclass(frozen=True)
class Trip:
    """One vehicle's samples: `time_s` (n,) increasing, `position_m` (n, 2), and optionally `heading_rad` and
    `speed_mps` (n,), of which those that are NaN are interpolated.
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
            is_wrong = ~(np.abs(values) <= _BOUND[name])  # NaN is in no range
            wrong = np.flatnonzero(is_wrong & ~np.isnan(values) if name in OPTIONAL else is_wrong)
            if len(wrong):
                at = "" if name == "time_s" else f" at {columns['time_s'][wrong[0]]:.10g} s"
                needed = f"a finite number is needed, within ±{_BOUND[name]:g}"
                raise self._problem(line[wrong[0]], f"{name} = {values[wrong[0]]:g}{at}: {needed}")
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
        last = order[np.append(~same, True)] if len(order) else order
        self._last = {name: values[last] for name, values in both.items()}
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
        if (np.abs(columns.get("heading_rad", 0.0)) > MOST_TURNED_RAD).any():
            self.notes.append(HEADINGS_NOTE)
        order = np.argsort(columns["code"], kind="stable")
        code = columns["code"][order].astype(np.int64)
        names = self._node_ids()
        trips = []
        for rows in np.split(order, np.flatnonzero(np.diff(code)) + 1):
            optional = {name: columns[name][rows] for name in OPTIONAL if name in columns}
            known = {name: values for name, values in optional.items() if not np.isnan(values).all()}
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


def lateral_offsets_m(normal: Array, sigma_m: float, correlation: float, half_width_m: float) -> Array:
    """Return offsets (K, …) in metres from standard normal draws (K, …), a step at a time.

    `correlation` is that of successive offsets; at ± `half_width_m` they are reflected.
    """
    offset = np.empty_like(normal)
    offset[0] = _reflect(sigma_m * normal[0], half_width_m)
    for k in range(1, len(normal)):
        step = correlation * offset[k - 1] + sigma_m * math.sqrt(1 - correlation**2) * normal[k]
        offset[k] = _reflect(step, half_width_m)
    return offset


def _reflect(offset_m: Array, half_width_m: float) -> Array:
    """Reflect offsets into ± `half_width_m`."""
    folded = np.mod(offset_m + half_width_m, 4 * half_width_m)
    return np.asarray(np.where(folded > 2 * half_width_m, 4 * half_width_m - folded, folded) - half_width_m)


class ImpossibleTripError(ScenarioError):
    """A trip most of whose positions may be wrong: too many steps are faster than any vehicle."""

    def __init__(self, node_id: str, steps: int, of: int, fastest_mps: float) -> None:
        self.reason = f"{node_id}: {steps} of {of} steps are faster than {fastest_mps:g} m/s"
        super().__init__(f"{self.reason}: check units, degrees or metres, and that each id is one vehicle")


@dataclass(frozen=True)
class Rules:
    """Greatest speed of a vehicle, longest gap between its samples, whether impossible trips are left out, and the
    greatest acceleration that is driven, if there is one.
    """

    fastest_mps: float
    longest_gap_s: float
    leaves_out: bool = True
    hardest_mps2: float | None = None


def clean(trip: Trip, rules: Rules) -> list[Rows]:
    """Return the row numbers of the samples that are kept, one array for each part without a long gap.

    Parts have at least two samples. Raise ImpossibleTripError if too many steps are jumps.
    """
    kept = _fresh(trip, rules)
    kept = kept[_without_jumps(trip, kept, rules)]
    parts = np.split(kept, np.flatnonzero(np.diff(trip.time_s[kept]) > rules.longest_gap_s) + 1)
    return [part for part in parts if len(part) > 1]


def _fresh(trip: Trip, rules: Rules) -> Rows:
    """Return the row numbers of all samples but those in which a moving receiver held its position."""
    time_s, position_m = trip.time_s, trip.position_m
    step_m = np.hypot(*np.diff(position_m, axis=0).T)
    moves = np.flatnonzero(step_m > 0)  # row m and row m + 1 differ
    first = np.concatenate([[0], moves[:-1] + 1]) if len(moves) else np.zeros(0, np.intp)
    step_s = time_s[moves + 1] - time_s[moves]
    too_hard = step_m[moves] > MAX_ACCELERATION_MPS2 * step_s**2
    bridged = time_s[moves + 1] - time_s[first] <= rules.longest_gap_s
    held = np.zeros(len(time_s), dtype=bool)
    for begin, end in zip(first[too_hard & bridged].tolist(), moves[too_hard & bridged].tolist(), strict=True):
        held[begin + 1 : end + 1] = True
    return np.flatnonzero(~held)


def _without_jumps(trip: Trip, rows: Rows, rules: Rules) -> NDArray[np.bool_]:
    """Return the mask of the rows that belong to the largest set in which no step is a jump.

    Raise ImpossibleTripError if too many are, or no step is left.

    Between two jumps there is a run of samples. A chain leaves a run at its end, or a few samples before, and
    continues in a later run, at its first sample that can be reached or lies after a long gap. The chain with the
    most samples is kept.
    """
    time_s, position_m = trip.time_s[rows], trip.position_m[rows]
    step_m, step_s = np.hypot(*np.diff(position_m, axis=0).T), np.diff(time_s)
    most = max(ALWAYS_ALLOWED_JUMPS, MAX_JUMP_SHARE * len(rows))
    too_fast = int(np.count_nonzero(step_m > rules.fastest_mps * step_s))
    if too_fast > most:
        raise ImpossibleTripError(trip.node_id, too_fast, len(rows) - 1, rules.fastest_mps)
    limits = _Limits(_allowed_mps(step_m, step_s, rules), rules)
    jumps = np.flatnonzero(step_m > limits.reach_m(np.arange(len(step_m)), np.arange(1, len(rows)), step_s))
    if len(jumps) > most:  # noise: the speed around says nothing
        limits = _Limits(np.full(len(rows), rules.fastest_mps), rules)
        jumps = np.flatnonzero(step_m > rules.fastest_mps * step_s)
    runs = [_Run(start, end) for start, end in zip([0, *(jumps + 1)], [*(jumps + 1), len(rows)], strict=True)]
    for number, run in enumerate(runs):
        for earlier in runs[max(0, number - MAX_SKIPPED_RUNS) : number]:
            for last in range(earlier.end - 1, max(earlier.entry, earlier.end - 1 - MAX_SKIPPED_SAMPLES) - 1, -1):
                run.follow(earlier, last, time_s, position_m, limits)
    kept = np.zeros(len(rows), dtype=bool)
    best = max(runs, key=lambda run: run.length)
    kept[best.entry : best.end] = True
    while best.before is not None:
        kept[best.before.entry : best.left + 1] = True
        best = best.before
    if too_fast and kept.sum() == 1:
        raise ImpossibleTripError(trip.node_id, too_fast, len(rows) - 1, rules.fastest_mps)
    return kept


def _allowed_mps(step_m: Array, step_s: Array, rules: Rules) -> Array:
    """Return the greatest speed (n,) at each sample, by the median of the speeds around it and by the rules."""
    window = int(np.clip(SPEED_WINDOW_S / np.median(step_s), 1, MOST_IN_WINDOW)) if len(step_s) else 0
    if window < FEWEST_IN_WINDOW or len(step_s) < window:
        return np.full(len(step_s) + 1, rules.fastest_mps)
    half = window // 2
    speed_mps = np.pad(step_m / step_s, half, mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(speed_mps, 2 * half + 1)
    parts = [np.median(around[first : first + _CHUNK], axis=1) for first in range(0, len(around), _CHUNK)]
    allowed_mps = np.minimum(FASTER_THAN_AROUND * np.concatenate(parts) + FASTER_THAN_AROUND_MPS, rules.fastest_mps)
    return np.asarray(np.maximum(np.append(allowed_mps, 0.0), np.append(0.0, allowed_mps)))


@dataclass(frozen=True)
class _Limits:
    """Greatest speed `allowed_mps` (n,) at each sample."""

    allowed_mps: Array
    rules: Rules

    def reach_m(self, first: Rows | np.intp, last: Rows, time_s: Array) -> Array:
        """Return how far the vehicle comes from samples `first` to `last` in `time_s`."""
        around_m = np.maximum(self.allowed_mps[first], self.allowed_mps[last]) * time_s
        return np.asarray(np.minimum(np.maximum(around_m, SMALL_JUMP_M), self.rules.fastest_mps * time_s))


@dataclass(eq=False)
class _Run:
    """Samples [start, end) without a jump, and the best chain so far that continues to their end.

    The chain has `length` samples. It enters this run at `entry`, after it left the run `before` at sample `left`.
    """

    start: int
    end: int
    length: int = 0
    entry: int = 0
    before: _Run | None = None
    left: int = 0

    def __post_init__(self) -> None:
        self.length, self.entry = self.end - self.start, self.start

    def follow(self, earlier: _Run, last: int, time_s: Array, position_m: Array, limits: _Limits) -> None:
        """Enter from sample `last` of an earlier run if that makes the chain longer."""
        rows = np.arange(self.start, self.end)
        later_s = time_s[rows] - time_s[last]
        away_m = np.hypot(*(position_m[rows] - position_m[last]).T)
        is_reached = away_m <= limits.reach_m(np.intp(last), rows, later_s)
        reached = np.flatnonzero(is_reached | (later_s > limits.rules.longest_gap_s))
        if not len(reached):
            return
        length = earlier.length - (earlier.end - 1 - last) + self.end - self.start - int(reached[0])
        if length > self.length:
            self.length, self.entry = length, self.start + int(reached[0])
            self.before, self.left = earlier, last


@dataclass(frozen=True)
class Motion:
    """Positions `position_m` (K, N, 2) and headings `heading_rad` (K, N) at the start of each period.

    An absent vehicle's entries are NaN. The heading of a vehicle that is present is NaN only if it never moves and
    its trip has no headings. `origin_deg` (latitude, longitude) is the origin of the metres, if it is known.
    `notes` are lines for the user about the input.
    """

    node_ids: tuple[str, ...]
    position_m: Array
    heading_rad: Array
    origin_deg: tuple[float, float] | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Selection:
    """The part of the trips that a run takes: `periods` of `period_ns` from `start_s`, within the `disc` (x, y,
    radius in metres), at most `most` vehicles.
    """

    start_s: float
    periods: int
    period_ns: int
    disc: tuple[float, float, float] | None = None
    most: int | None = None


def motion_of(trips: list[Trip], selection: Selection, rules: Rules) -> Motion:
    """Resample trips to a run's periods; vehicles are in the order in which they enter, then in that of the file.

    Raise ScenarioError if no vehicle is present during the run, if the truth does not fit into memory, or for an
    impossible trip that is not to be left out.
    """
    driven: list[tuple[str, Array | None]] = []
    cuts: list[int] = []
    impossible: list[ImpossibleTripError] = []
    for trip in trips:
        try:
            states, cut = _drive(trip, selection, rules)
            driven.append((trip.node_id, states))
            cuts += [cut] if cut else []
        except ImpossibleTripError as error:
            impossible.append(error)
            if not rules.leaves_out or len(impossible) > MOST_LEFT_OUT * len(trips):
                raise
    present = [(int(np.flatnonzero(np.isfinite(d[:, 0]))[0]), name, d) for name, d in driven if d is not None]
    present.sort(key=lambda entry: entry[0])
    present = present[: selection.most]
    if not present:
        seconds = (selection.periods - 1) * selection.period_ns / NS_PER_S
        where = " within the disc" if selection.disc else ""
        raise ScenarioError(
            f"no vehicle is present{where} for {SHORTEST_STAY_S:g} s "
            f"of the {seconds:g} s from {selection.start_s:.10g} s"
        )
    if len(present) * selection.periods > MOST_STATES:
        raise ScenarioError(
            f"{len(present)} vehicles for {selection.periods} periods: at most {MOST_STATES:,} states; "
            "set max_vehicles, or a disc, or a shorter run"
        )
    states = np.stack([driven for _, _, driven in present], axis=1)
    names = tuple(name for _, name, _ in present)
    return Motion(
        names,
        states[..., :2],
        states[..., 2],
        notes=(*_left_out(impossible, len(trips)), *_cut(cuts, len(trips), rules)),
    )


def _left_out(impossible: Sequence[ImpossibleTripError], of: int) -> tuple[str, ...]:
    """Return the line that says which vehicles are omitted, with the reason."""
    if not impossible:
        return ()
    reasons = first_names([error.reason for error in impossible], most=3, with_total=True)
    return (f"{len(impossible)} of {of} vehicles left out as impossible: {reasons}",)


def _cut(cuts: Sequence[int], of: int, rules: Rules) -> tuple[str, ...]:
    """Return the line that says how many vehicles were cut, and how often."""
    if not cuts:
        return ()
    places = counted(sum(cuts), "place")
    return (f"{len(cuts)} of {of} vehicles cut at {places} where they would need over {rules.hardest_mps2:g} m/s²",)


def _drive(trip: Trip, selection: Selection, rules: Rules) -> tuple[Array | None, int]:
    """Return a vehicle's position and heading (K, 3) at the start of each period, and at how many places it is cut.

    None if it is never present.
    """
    driven = np.full((selection.periods, 3), np.nan)
    for rows in clean(trip, rules):
        _resample(driven, trip, rows, selection)
    impossible = _too_hard(driven[:, :2], selection.period_ns, rules)
    driven[impossible] = np.nan
    present = np.isfinite(driven[:, 0])
    if selection.disc is not None:
        x, y, radius_m = selection.disc
        inside = np.hypot(driven[:, 0] - x, driven[:, 1] - y) <= radius_m
        longest = math.ceil(rules.longest_gap_s * NS_PER_S / selection.period_ns)
        present = _without_excursions(inside, present, longest)
    shortest = min(math.ceil(SHORTEST_STAY_S * NS_PER_S / selection.period_ns), selection.periods)
    for begin, end in _runs_of_true(present):
        present[begin:end] = end - begin >= shortest
    driven[~present] = np.nan
    is_there = bool(present[: selection.periods - 1].any())
    return (driven, len(_runs_of_true(impossible))) if is_there else (None, 0)


def _too_hard(position_m: Array, period_ns: int, rules: Rules) -> NDArray[np.bool_]:
    """Return the mask (K,) of the periods between positions (K, 2) that no possible acceleration connects."""
    hard = np.zeros(len(position_m), dtype=bool)
    step = max(1, round(ACCELERATION_S * NS_PER_S / period_ns))
    if rules.hardest_mps2 is None or len(position_m) <= 2 * step:
        return hard
    speed_mps = (position_m[step:] - position_m[:-step]) / (step * period_ns / NS_PER_S)
    change_mps2 = np.hypot(*(speed_mps[step:] - speed_mps[:-step]).T) / (step * period_ns / NS_PER_S)
    for middle in (np.flatnonzero(change_mps2 > rules.hardest_mps2) + step).tolist():
        hard[middle - step + 1 : middle + step] = True
    return hard


def _without_excursions(inside: NDArray[np.bool_], present: NDArray[np.bool_], longest: int) -> NDArray[np.bool_]:
    """Return the mask (K,) `inside`, with absences from the disc of up to `longest` periods filled in.

    A vehicle that leaves the disc and returns counts as inside meanwhile, if its trip has no gap.
    """
    stays = inside.copy()
    for begin, end in _runs_of_true(present & ~inside):
        back = begin > 0 and end < len(inside) and inside[begin - 1] and inside[end]
        stays[begin:end] = back and end - begin <= longest
    return stays


def _runs_of_true(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the runs of true entries of a mask (K,) as [begin, end)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _resample(driven: Array, trip: Trip, rows: NDArray[np.intp], selection: Selection) -> None:
    """Set `driven` (K, 3) between the first and the last of the samples `rows`."""
    period_s = selection.period_ns / NS_PER_S
    time_s = trip.time_s[rows] - selection.start_s
    first = max(0, math.ceil(round(time_s[0] / period_s, 6)))
    last = min(selection.periods - 1, math.floor(round(time_s[-1] / period_s, 6)))
    if first > last:
        return
    at_s = np.arange(first, last + 1) * period_s

    def at(values: Array, query_s: Array) -> Array:
        return np.asarray(np.interp(query_s, time_s, values[rows]))

    periods = slice(first, last + 1)
    driven[periods, 0], driven[periods, 1] = (at(axis_m, at_s) for axis_m in trip.position_m.T)
    if trip.heading_rad is not None and (told := ~np.isnan(trip.heading_rad[rows])).any():
        unwound = np.unwrap(trip.heading_rad[rows][told])
        driven[periods, 2] = np.mod(np.interp(at_s, time_s[told], unwound), 2 * np.pi)
        return
    early_s, late_s = np.maximum(at_s - CHORD_S, time_s[0]), np.minimum(at_s + CHORD_S, time_s[-1])
    chord_m = np.array([at(axis_m, late_s) - at(axis_m, early_s) for axis_m in trip.position_m.T])
    if trip.speed_mps is not None and (told := ~np.isnan(trip.speed_mps[rows])).any():
        speed_mps = np.interp(at_s, time_s[told], trip.speed_mps[rows][told])
    else:
        speed_mps = np.hypot(*chord_m) / np.maximum(late_s - early_s, 1e-9)
    moving = (speed_mps >= STANDING_MPS) & chord_m.any(axis=0)
    driven[periods, 2] = _kept(np.mod(np.arctan2(chord_m[1], chord_m[0]), 2 * np.pi), moving)


def _kept(heading_rad: Array, moving: NDArray[np.bool_]) -> Array:
    """Return headings (k,) of which a standing vehicle keeps its last, or, before it first moves, has its first."""
    if not moving.any():
        return np.full(len(heading_rad), np.nan)
    last = np.maximum.accumulate(np.where(moving, np.arange(len(moving)), -1))
    return heading_rad[np.where(last < 0, int(np.argmax(moving)), last)]
