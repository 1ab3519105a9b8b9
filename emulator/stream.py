"""Messages to observers of a run: `scene`, `period` and `end`, while it is on, or made of its files.

They contain numbers, text, bytes and maps only, which every language reads. Arrays are little-endian float32 bytes
in row-major order, a row for each node in the order of `node_ids`, unless stated otherwise; NaN stands for a value
that a node did not report. The same functions build them for a live run, from the emulator's state, and for a
finished run, from its files alone: what those who watched it were told.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import ArrayLike, NDArray

from emulator.radio.outcomes import Outcome
from emulator.radio.topology import component_links
from emulator.radio.trace import ROW, decided_ns
from emulator.records.events import Event
from emulator.records.metrics import rows_of
from emulator.records.period_figures import NO_VIEWS, VECTORS, ProgramFigures, Views
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.recorded_world import RecordedWorld
from emulator.records.reported import MOST_DOTTED, figures_among, is_text, named_numbers, numbers_of
from emulator.records.run_folder import WORLD_FILE, check_is_run
from emulator.records.tables import (
    BACKGROUND,
    BUSY,
    METRICS,
    STATES,
    busy_windows,
    mean_busy,
    positions_by_time,
)
from emulator.scenario.scenario import Scenario
from emulator.world.world import Instant, components
from vnet.errors import VnetError, printable
from vnet.reports import Report
from vnet.types import Array

LATENCY_BIN_NS = 2_000_000
"""Width of a bin of the latency histogram."""
LATENCY_BINS = 50
"""Bins of the latency histogram."""
LONGEST_DETAIL = 200
"""Characters of a detail of an event."""

ROWS_AT_ONCE = 1 << 14
"""Rows of the states that are made to messages at once."""
_TRUTH = {"position_m": 2, "fix_m": 2, "common_error_m": 2}
Message = tuple[str, dict[str, Any]]


def pack(array: ArrayLike) -> bytes:
    """Return an array as float32 bytes."""
    with np.errstate(over="ignore"):  # 1e300 becomes infinite, which is not drawn
        return np.ascontiguousarray(array, dtype="<f4").tobytes()


def unpack(data: bytes, columns: int = 1) -> NDArray[np.float32]:
    """Restore `pack`, as (n, columns)."""
    return np.frombuffer(data, dtype="<f4").reshape(-1, columns)


def unpack_pairs(message: Mapping[str, Any]) -> NDArray[np.int32]:
    """Return the `pairs` of a period message (k, 4): sender, receiver, number of the `Outcome`, and count."""
    return np.frombuffer(message["pairs"], dtype="<i4").reshape(-1, 4)


def scene_message(
    world: RecordedWorld, scenario: Scenario, scenario_text: str, views: Views = NO_VIEWS
) -> dict[str, Any]:
    """Return the message of a run's constants; only faults may be added to its `scenario` during the run.

    `node_ids`; lanes (`lane_point_m`, `lane_heading_rad`, `lane_length_m`, which is infinite for a line in both
    directions from its point); `building_edge_m` (k × 2 × 2), the ends of the edges of buildings; `range_m` (None
    if links or path loss decide connectivity); `component` (int16, n), the connected component of each vehicle at
    the start (-1: absent), or by all links of the run where they are given over time and vehicles stand; `area_m`
    (float32, 2 × 2), the corners of the bounding box of all positions during the run; `moves`, true if vehicles
    drive; `scenario_text`, the resolved scenario as TOML; `views` that its program
    declares.
    """
    radio = scenario.radio
    links = component_links(scenario, world.radio_inputs, world.position_m)
    label = components(world.position_m, links)
    return {
        "name": scenario.run.name,
        "node_ids": list(world.node_ids),
        "lane_point_m": pack(world.lane_point_m),
        "lane_heading_rad": pack(world.lane_heading_rad),
        "lane_length_m": pack(world.lane_length_m),
        "building_edge_m": pack([] if world.buildings is None else world.buildings.edges_m()),
        "range_m": radio.range_m if radio.links is None and radio.path_loss is None else None,
        "max_peers": scenario.radio.max_peers,
        "component": label.astype("<i2").tobytes(),
        "area_m": pack(world.area_m),
        "moves": scenario.network.moves,
        "period_ns": scenario.period_ns,
        "duration_ns": scenario.duration_ns,
        "scenario": scenario_text,
        "views": asdict(views),
    }


@dataclass(frozen=True)
class Beliefs:
    """Reports of one period: arrays (n, size) of the states' columns by name, NaN where a node reported nothing.

    By column and node, the numbers of `lists` of any length. By name and node, the values (n,) that it has for its
    `peers`. By name, the figures (n,) of programs' own, true as 1, and texts (n), "" where a node reported none.
    """

    columns: Mapping[str, Array]
    lists: Mapping[str, Mapping[str, ArrayLike]]
    peers: Mapping[str, Mapping[str, Array]]
    values: Mapping[str, Array]
    texts: Mapping[str, list[str]]


def beliefs_of(number: Mapping[str, int], reports: Iterable[Report], declared: ProgramFigures) -> Beliefs:
    """Return the last report of each node; `number` is the index of each node."""
    last = {report.node: report for report in reports}
    columns = {
        name: _collect(number, {node: getattr(report, name) for node, report in last.items()}, size)
        for name, size in VECTORS.items()
    }
    lists: dict[str, dict[str, ArrayLike]] = {}
    for reported, column in declared.columns.items():
        values = {node: report.values.get(reported) for node, report in last.items()}
        if column.size is None:
            lists[column.name] = {node: value for node, value in values.items() if isinstance(value, list)}
        else:
            columns[column.name] = _collect(number, values, column.size)
    return Beliefs(
        columns,
        lists,
        {name: _of_peers(name, number, last) for name in declared.views.peers},
        values=_values(number, last, declared),
        texts=_texts(number, last, declared),
    )


def _collect(number: Mapping[str, int], values: Mapping[str, Any], size: int) -> Array:
    """(N, size) of the values of nodes; NaN where there is nothing of that size."""
    array = np.full((len(number), size), np.nan)
    fitting = {n: value for n, value in values.items() if isinstance(value, (list, tuple)) and len(value) == size}
    if fitting:
        array[[number[node] for node in fitting]] = [*fitting.values()]
    return array


def _values(number: Mapping[str, int], last: Mapping[str, Report], declared: ProgramFigures) -> dict[str, Array]:
    """Return the numbers and booleans that programs report by names of their own, by name, as arrays (n,)."""
    values: dict[str, Array] = {}
    dotted = 0
    for node, report in last.items():
        for name, value in figures_among(report.values, declared).items():
            if name not in values and "." in name and dotted == MOST_DOTTED:
                continue
            if not isinstance(value, str):
                dotted += name not in values and "." in name
                values.setdefault(name, np.full(len(number), np.nan))[number[node]] = value
    return {name: each for name, each in values.items() if np.isfinite(each).any()}


def _texts(number: Mapping[str, int], last: Mapping[str, Report], declared: ProgramFigures) -> dict[str, list[str]]:
    """Return the texts that programs report by names of their own, by name, one for each node."""
    texts: dict[str, list[str]] = {}
    for node, report in last.items():
        for name, value in figures_among(report.values, declared).items():
            if isinstance(value, str):
                texts.setdefault(name, [""] * len(number))[number[node]] = value
    return {name: each for name, each in texts.items() if any(each)}


def _of_peers(name: str, number: Mapping[str, int], last: Mapping[str, Report]) -> dict[str, Array]:
    """Return the values (n,) that each node reported for others, 0 for missing ones; none where it has none."""
    index = {f"{name}.{node}": place for node, place in number.items()}
    found: dict[str, Array] = {}
    for node, report in last.items():
        for key in report.values.keys() & index.keys():
            value = report.values[key]
            one = value if isinstance(value, list) else [value]
            if len(one) == 1 and not isinstance(one[0], str):
                found.setdefault(node, np.zeros(len(number)))[index[key]] = one[0]
    return found


def period_message(
    node_ids: Sequence[str],
    instant: Instant,
    end_ns: int,
    beliefs: Beliefs,
    figures: Any,
    rows: NDArray[np.void],
    up: ArrayLike,
    faults: Sequence[str],
    events: Iterable[Event],
    busy_ratio: Array,
    background_m: ArrayLike = (),
) -> dict[str, Any]:
    """Return the message of the period [instant.time_ns, end_ns).

    Truth, fixes, reports, `figures`, labels of the `faults` that act in it, `events` since the last message, `up`
    (uint8, n) at its end, `busy_ratio` (n), the channel busy ratios (NaN without `[radio.mac]`), and the outcomes
    of frames. `rows` of the trace must include all that were sent or decided in the period, and may include others.
    `background_m` (k, 2) are positions of vehicles without programs.
    """
    return {
        "period": instant.period,
        "time_ns": instant.time_ns,
        "position_m": pack(instant.position_m),
        "heading_rad": pack(instant.heading_rad),
        "fix_m": pack(instant.fix_m),
        "common_error_m": pack(instant.common_error_m),
        **{name: pack(beliefs.columns[name]) for name in VECTORS},
        "columns": {name: pack(column) for name, column in beliefs.columns.items() if name not in VECTORS},
        "lists": _packed(beliefs.lists),
        "peers": _packed(beliefs.peers),
        "values": {name: pack(values) for name, values in beliefs.values.items()},
        "texts": {name: list(texts) for name, texts in beliefs.texts.items()},
        "figures": dict(vars(figures)),
        "up": np.asarray(up, dtype=np.uint8).tobytes(),
        "faults": list(faults),
        "events": list(map(event_message, events)),
        "busy_ratio": pack(busy_ratio),
        **_frames(rows, instant.time_ns, end_ns, len(node_ids)),
        "background_m": pack(background_m),
    }


def _packed(found: Mapping[str, Mapping[str, ArrayLike]]) -> dict[str, dict[str, bytes]]:
    return {name: {node: pack(numbers) for node, numbers in each.items()} for name, each in found.items() if each}


def _frames(rows: NDArray[np.void], start_ns: int, end_ns: int, count: int) -> dict[str, Any]:
    """Return the part of a period's message about receptions decided in [start_ns, end_ns).

    `pairs`: int32 (k, 4), sender, receiver, outcome, and the number of receptions; `pairs_age_ms` (k): time from
    the newest of their frames to the end; `outcomes`: number of receptions by outcome; `latency_counts`: int32
    (LATENCY_BINS,), deliveries by latency in bins of LATENCY_BIN_NS, the last open; `sent_bytes`, `received_bytes`
    (n): bytes of frames sent (with copies made by faults; without frames that had no node in range, which are not
    in the trace) and delivered.
    """
    time_ns = decided_ns(rows)
    decided = rows[(rows["outcome"] != Outcome.pending) & (start_ns <= time_ns) & (time_ns < end_ns)]
    sender, receiver = decided["sender"].astype(np.int64), decided["receiver"]
    key, inverse, number = np.unique(
        (sender * count + receiver) * len(Outcome) + decided["outcome"], return_inverse=True, return_counts=True
    )
    link = key // len(Outcome)
    newest_ns = np.zeros(len(key), np.int64)
    np.maximum.at(newest_ns, inverse, decided["sent_ns"])
    pairs = np.column_stack([link // count, link % count, key % len(Outcome), number])
    outcomes = np.bincount(decided["outcome"]).tolist()
    delivered = decided[decided["outcome"] == Outcome.delivered]
    bins = np.minimum((delivered["arrival_ns"] - delivered["sent_ns"]) // LATENCY_BIN_NS, LATENCY_BINS - 1)
    sent = _one_each(rows[(start_ns <= rows["left_ns"]) & (rows["left_ns"] < end_ns)])
    return {
        "pairs": pairs.astype("<i4").tobytes(),
        "pairs_age_ms": pack((end_ns - newest_ns) / 1e6),
        "outcomes": {Outcome(kind).name: number for kind, number in enumerate(outcomes) if number},
        "latency_counts": np.bincount(bins, minlength=LATENCY_BINS).astype("<i4").tobytes(),
        "sent_bytes": pack(np.bincount(sent["sender"], sent["size_bytes"], count)),
        "received_bytes": pack(np.bincount(delivered["receiver"], delivered["size_bytes"], count)),
    }


def _one_each(rows: NDArray[np.void]) -> NDArray[np.void]:
    """Return one row of each frame."""
    if not len(rows):
        return rows
    seq = rows["seq"] - rows["seq"].min()
    copy = rows["copy"].astype(np.int64)
    frame = (rows["sender"] * (copy.max() + 1) + copy) * (seq.max() + 1) + seq
    return rows[np.unique(frame, return_index=True)[1]]


def event_message(event: Event) -> dict[str, Any]:
    """Return an event as a map, with its words, and long details truncated."""
    return {
        "time_ns": event.time_ns,
        "kind": event.kind,
        "node": event.node,
        "text": printable(event.text, LONGEST_DETAIL),
        "details": {key: _short(value) for key, value in event.details.items()},
    }


def _short(value: object) -> object:
    if value is None or isinstance(value, (bool, int, float)):
        return value
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= LONGEST_DETAIL else text[: LONGEST_DETAIL - 1] + "…"


def messages(folder: Path) -> Iterator[Message]:
    """(stream, message) of a run that is over: its scene, its periods in order, and its end.

    Raises VnetError if the folder is not a finished run's, and if its tables do not fit together.
    """
    check_is_run(folder)
    run = RecordedRun.open(folder)
    figures = rows_of(run.metrics)
    if [row.period for row in figures] != list(range(len(figures))):
        raise VnetError(f"{folder / METRICS.file}: its rows are not those of one period after the other")
    if figures:
        _check_states(run, len(figures))
    return _messages(run, figures)


def _check_states(run: OpenedRun, periods: int) -> None:
    """Raise VnetError unless the states have a row for each vehicle of each period in turn."""
    path = run.folder / STATES.file
    if run.node_ids != list(run.world.node_ids):
        raise VnetError(f"{path}: its first period is not of the vehicles of {WORLD_FILE}")
    period, node = run.place
    count = len(run.node_ids)
    in_turn = np.array_equal(period, np.arange(len(period)) // count)
    if not in_turn or not np.array_equal(node, np.arange(len(node)) % count) or len(node) % count:
        raise VnetError(f"{path}: its rows are not those of one period after the other")
    if run.periods != periods:
        how = "fewer" if run.periods < periods else "more"
        raise VnetError(f"{path}: is of {how} periods than the {periods} of {METRICS.file}")


def _messages(run: OpenedRun, figures: Sequence[Any]) -> Iterator[Message]:
    yield "scene", scene_message(run.world, run.scenario, run.scenario_text, run.views)
    events = _by_period(run.events, run.scenario.period_ns, len(figures))
    if figures:
        yield from _periods(run, figures, events)
    yield "end", {"events": list(map(event_message, events[-1]))}


def _periods(run: OpenedRun, figures: Sequence[Any], events: Sequence[Sequence[Event]]) -> Iterator[Message]:
    period_ns, table = run.scenario.period_ns, run.table(BUSY)
    busy, background = busy_windows(table, run.node_ids), positions_by_time(run.table(BACKGROUND))
    trace = _Trace(run)
    for now, happened, (instant, beliefs) in zip(figures, events, _states(run), strict=False):
        start_ns, end_ns = now.time_ns, now.time_ns + period_ns
        faults = [planned.label for planned in run.plan if planned.acts_between(start_ns, end_ns)]
        busy_ratio = mean_busy(busy, len(run.node_ids), start_ns, end_ns)
        frames = trace.until(end_ns), ~run.down_at(end_ns - 1), faults, happened, busy_ratio
        beyond = background.get(start_ns, ())
        yield "period", period_message(run.node_ids, instant, end_ns, beliefs, now, *frames, beyond)


class _Trace:
    """The trace of a run, forward in time."""

    def __init__(self, run: RecordedRun) -> None:
        self._rows = np.zeros(len(run.trace), ROW)
        for name in ("sent_ns", "seq", "size_bytes", "copy", "arrival_ns"):
            self._rows[name] = run.column(name)
        self._rows["left_ns"] = run.column("left_ns" if "left_ns" in run.trace.column_names else "sent_ns")
        for name, values in {"sender": run.sender, "receiver": run.receiver, "outcome": run.outcome}.items():
            self._rows[name] = values
        if (np.diff(self._rows["sent_ns"]) < 0).any():
            raise VnetError("trace: its rows are not in the order in which frames were sent")
        self._next = 0
        self._undecided = self._rows[:0]

    def until(self, end_ns: int) -> NDArray[np.void]:
        """Return what was sent before `end_ns` and not decided by the last time, as records of type `ROW`.

        Digests and causes are left out.
        """
        first, self._next = self._next, int(np.searchsorted(self._rows["sent_ns"], end_ns))
        rows = np.concatenate([self._undecided, self._rows[first : self._next]])
        self._undecided = rows[decided_ns(rows) >= end_ns]
        return rows


def _states(run: OpenedRun) -> Iterator[tuple[Instant, Beliefs]]:
    """Yield the truth and the fixes of each period, and what nodes reported in it. Headings of fixes are NaN."""
    rows = max(1, ROWS_AT_ONCE // len(run.node_ids)) * len(run.node_ids)
    for first in range(0, len(run.states), rows):
        yield from _split(run, run.states.slice(first, rows))


def _split(run: OpenedRun, table: pa.Table) -> Iterator[tuple[Instant, Beliefs]]:
    count, node_ids = len(run.node_ids), run.node_ids
    kinds = {name: table.schema.field(name).type for name in run.reported_names}
    sizes = {name: kind.list_size for name, kind in kinds.items() if pa.types.is_fixed_size_list(kind)}
    heading = np.asarray(table["heading_rad"].to_numpy(), dtype=float).reshape(-1, count)
    vectors = {
        name: _vectors(table[name].combine_chunks(), size).reshape(-1, count, size)
        for name, size in (_TRUTH | sizes).items()
    }
    lists = {name: _by_row(table[name].combine_chunks()) for name, kind in kinds.items() if pa.types.is_list(kind)}
    values_of = table["values"].combine_chunks()
    peers = {name: _recorded_of_peers(values_of, f"{name}.", run.number) for name in run.views.peers}
    values, texts = _recorded_values(run, table)
    first = table["period"][0].as_py()
    for place in range(len(heading)):
        here = {name: array[place] for name, array in vectors.items()}
        row_of = dict(zip(node_ids, range(place * count, (place + 1) * count), strict=True))
        in_rows = partial(_of_nodes, row_of)
        instant = Instant(
            first + place,
            (first + place) * run.scenario.period_ns,
            here["position_m"],
            heading[place],
            here["common_error_m"][0],
            here["fix_m"],
            np.full(count, np.nan),
        )
        yield (
            instant,
            Beliefs(
                {name: here[name] for name in sizes},
                {name: in_rows(each) for name, each in lists.items()},
                {name: in_rows(each) for name, each in peers.items()},
                {name: each[place] for name, each in values.items() if np.isfinite(each[place]).any()},
                {name: each[place] for name, each in texts.items() if any(each[place])},
            ),
        )


def _recorded_values(run: RecordedRun, table: pa.Table) -> tuple[dict[str, Array], dict[str, list[list[str]]]]:
    """The figures (periods, n) of programs' own by name, and their texts, period by period."""
    count = len(run.number)
    values: dict[str, Array] = {}
    texts: dict[str, list[list[str]]] = {}
    for name in run.value_names:
        if is_text(table[name].type):
            flat = [text or "" for text in table[name].to_pylist()]
            texts[name] = [flat[first : first + count] for first in range(0, len(flat), count)]
        else:
            values[name] = numbers_of(table[name]).reshape(-1, count)
    return values, texts


def _vectors(column: pa.Array, size: int) -> Array:
    """A column of points or matrices as (rows, size); NaN where there is none."""
    array = np.full((len(column), size), np.nan)
    there = np.asarray(column.is_valid())
    array[there] = np.asarray(column.drop_null().flatten(), dtype=float).reshape(-1, size)
    return array


def _of_nodes(row_of: Mapping[str, int], found: Mapping[int, Array]) -> dict[str, Array]:
    """Find by node the entries of the rows of a period."""
    return {node: found[row] for node, row in row_of.items() if row in found}


def _by_row(column: pa.Array) -> dict[int, Array]:
    """The numbers of each list, by row."""
    rows = np.flatnonzero(np.asarray(column.is_valid()))
    lists = column.drop_null()
    ends = np.cumsum(np.asarray(pc.list_value_length(lists), dtype=np.intp))
    numbers = np.split(np.asarray(lists.flatten(), dtype=float), ends[:-1]) if len(rows) else []
    return dict(zip(rows.tolist(), numbers, strict=True))


def _recorded_of_peers(column: pa.Array, prefix: str, number: Mapping[str, int]) -> dict[int, Array]:
    """The values (n,) that each node has for others, by row; 0 where none, and no entry where none at all."""
    row, name, amount = named_numbers(column, prefix)
    found: dict[int, Array] = {}
    for place, key, one_value in zip(row.tolist(), name.to_pylist(), amount.tolist(), strict=True):
        other = number.get(key.removeprefix(prefix))
        if other is not None:
            found.setdefault(place, np.zeros(len(number)))[other] = one_value
    return found


def _by_period(events: Iterable[Event], period_ns: int, periods: int) -> list[list[Event]]:
    """The events of each period, and at the end those that came after the last."""
    told: list[list[Event]] = [[] for _ in range(periods + 1)]
    for event in events:
        told[min(event.time_ns // period_ns, periods)].append(event)
    return told
