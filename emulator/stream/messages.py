"""Messages to observers of a run: `scene`, `period` and `end`.

They contain numbers, text, bytes and maps only, which every language reads. Arrays are little-endian float32 bytes
in row-major order, a row for each node in the order of `node_ids`, unless stated otherwise; NaN stands for a value
that a node did not report. The same functions build them for a live run, from the emulator's state, and for a
finished run, from its files.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emulator.radio.outcomes import Outcome
from emulator.radio.topology import component_links
from emulator.radio.trace import decided_ns
from emulator.records.events import Event
from emulator.records.period_figures import NO_VIEWS, VECTORS, ProgramFigures, Views
from emulator.records.recorded_world import RecordedWorld
from emulator.records.reported import MOST_DOTTED, figures_among
from emulator.scenario.scenario import Scenario
from emulator.world.world import Instant, components
from vnet.errors import printable
from vnet.reports import Report
from vnet.types import Array

LATENCY_BIN_NS = 2_000_000
"""Width of a bin of the latency histogram."""
LATENCY_BINS = 50
"""Bins of the latency histogram."""
LONGEST_DETAIL = 200
"""Characters of a detail of an event."""


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
    label = components(world.position_m, radio.range_m, links)
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
