"""What those who watch a run are told: plain messages `scene`, `period` and `end`.

Numbers, text, bytes and tables only, so that any language reads them. Arrays are little-endian float32 bytes, row
by row, in the order of `node_ids`, unless it says otherwise; NaN stands for what a node did not report. For a run
that is on they are made of what the emulator knows, for one that is over of its files, by the same functions.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emulator.radio.connectivity import connectivity_of, distances_m
from emulator.radio.outcomes import Outcome
from emulator.radio.trace import decided_ns
from emulator.records.beliefs import WEIGHT, Beliefs, is_cloud
from emulator.records.metrics import PeriodFigures, collect
from emulator.records.recorded_world import RecordedWorld
from emulator.records.run_folder import Event
from emulator.scenario.scenario import Scenario
from emulator.world.world import Instant, components
from vnet.node import Report
from vnet.types import Array

LATENCY_BIN_NS = 2_000_000
LATENCY_BINS = 50
LONGEST_DETAIL = 200
"""Characters that are told of one detail of an event."""
_OUTCOMES = 16
"""More than there are outcomes, for one number of sender, receiver and outcome."""


def pack(array: ArrayLike) -> bytes:
    """An array as float32 bytes."""
    return np.ascontiguousarray(array, dtype="<f4").tobytes()


def unpack(data: bytes, columns: int = 1) -> NDArray[np.float32]:
    """Restore `pack`, as (n, columns)."""
    return np.frombuffer(data, dtype="<f4").reshape(-1, columns)


def unpack_pairs(message: Mapping[str, Any]) -> NDArray[np.int32]:
    """The `pairs` of a period message, as (k, 4): sender, receiver, number of the `Outcome`, how many."""
    return np.frombuffer(message["pairs"], dtype="<i4").reshape(-1, 4)


def scene_message(world: RecordedWorld, scenario: Scenario, scenario_text: str) -> dict[str, Any]:
    """What does not change during a run, but for the faults in `scenario` that are planned while it is on.

    `node_ids`, lanes (`lane_point_m`, `lane_heading_rad`, `lane_length_m`: infinite for a line that goes both ways
    from its point), `range_m` (None where the scenario gives links or a path loss, and the range says nothing
    about who hears whom), `component` (int16, n) of the network that each vehicle belongs to at first (-1: it is
    not there yet), `area_m` (float32, 2 × 2), the corners of the box in which vehicles are during the run, whether
    they move, and the resolved scenario as TOML, `scenario_text`.
    """
    radio = scenario.radio
    reach = connectivity_of(radio, scenario.run.seed, world.links)
    in_range = reach.in_range(world.position_m, distances_m(world.position_m))
    label = components(world.position_m, radio.range_m, in_range)
    return {
        "name": scenario.run.name,
        "node_ids": list(world.node_ids),
        "lane_point_m": pack(world.lane_point_m),
        "lane_heading_rad": pack(world.lane_heading_rad),
        "lane_length_m": pack(world.lane_length_m),
        "range_m": radio.range_m if radio.links is None and radio.path_loss is None else None,
        "max_peers": scenario.radio.max_peers,
        "component": label.astype("<i2").tobytes(),
        "area_m": pack(world.area_m),
        "moves": scenario.network.moves,
        "period_ns": scenario.period_ns,
        "duration_ns": scenario.duration_ns,
        "scenario": scenario_text,
    }


def beliefs_of(number: Mapping[str, int], reports: Iterable[Report]) -> Beliefs:
    """The last report of each node; `number` gives each node's."""
    last = {report.node: report for report in reports}
    weighed = {WEIGHT + node: place for node, place in number.items()}

    def named(name: str, size: int) -> Array:
        return collect(number, last, lambda report: report.values.get(name), size)

    return Beliefs(
        collect(number, last, lambda report: report.estimate_m, 2),
        collect(number, last, lambda report: report.covariance_m2, 4),
        named("common_error_m", 2),
        named("common_error_covariance_m2", 4),
        {n: c for n, r in last.items() if isinstance(c := r.values.get("cloud_m"), list) and is_cloud(len(c))},
        {n: w for n, r in last.items() if (w := _weights(weighed, r)) is not None},
    )


def _weights(place: Mapping[str, int], report: Report) -> Array | None:
    """The weights (n,) that a node reported, 0 where none; None if it reported none at all. `place` is by name."""
    weights = None
    for name in report.values.keys() & place.keys():
        value = report.values[name]
        one = value if isinstance(value, list) else [value]
        if len(one) == 1:
            weights = np.zeros(len(place)) if weights is None else weights
            weights[place[name]] = one[0]
    return weights


def period_message(
    node_ids: Sequence[str],
    instant: Instant,
    end_ns: int,
    beliefs: Beliefs,
    figures: PeriodFigures,
    rows: NDArray[np.void],
    up: ArrayLike,
    faults: Sequence[str],
    events: Iterable[Event],
    busy_ratio: Array,
) -> dict[str, Any]:
    """One period, [instant.time_ns, end_ns).

    Truth, fixes, what was reported, `figures`, `faults` acting in it (labels), `events` since the last message,
    `up` (uint8, n) at its end, how busy the medium was (n), NaN where senders share none, and what became of
    frames, from `rows` of the trace: all that were sent or decided in the period, and any others.
    """
    return {
        "period": instant.period,
        "time_ns": instant.time_ns,
        "position_m": pack(instant.position_m),
        "heading_rad": pack(instant.heading_rad),
        "fix_m": pack(instant.fix_m),
        "common_error_m": pack(instant.common_error_m),
        "estimate_m": pack(beliefs.estimate_m),
        "covariance_m2": pack(beliefs.covariance_m2),
        "common_error_estimate_m": pack(beliefs.common_error_m),
        "common_error_covariance_m2": pack(beliefs.common_error_covariance_m2),
        "clouds": {node: pack(cloud) for node, cloud in beliefs.clouds.items()},
        "weights": {node: pack(weights) for node, weights in beliefs.weights.items()},
        "figures": dict(vars(figures)),
        "up": np.asarray(up, dtype=np.uint8).tobytes(),
        "faults": list(faults),
        "events": list(map(event_message, events)),
        "busy_ratio": pack(busy_ratio),
        **_frames(rows, instant.time_ns, end_ns, len(node_ids)),
    }


def _frames(rows: NDArray[np.void], start_ns: int, end_ns: int, count: int) -> dict[str, Any]:
    """What became of frames in [start, end).

    `pairs`: int32 (k, 4), sender, receiver, outcome and how many rows of the trace were so decided; `pairs_age_ms`
    (k): how long before the end the newest of their frames was sent; `outcomes`: how many by name;
    `latency_counts`: int32 (LATENCY_BINS,), deliveries by time on the way in bins of LATENCY_BIN_NS, the last for
    all that took longer; `sent_bytes`, `received_bytes` (n): of the frames that were sent (with the copies that
    faults make, and without those that nobody was in range of: no trace is kept of them) and delivered.
    """
    time_ns = decided_ns(rows)
    decided = rows[(rows["outcome"] != Outcome.pending) & (start_ns <= time_ns) & (time_ns < end_ns)]
    sender, receiver = decided["sender"].astype(np.int64), decided["receiver"]
    key, which, number = np.unique(
        (sender * count + receiver) * _OUTCOMES + decided["outcome"], return_inverse=True, return_counts=True
    )
    place = key // _OUTCOMES
    newest_ns = np.zeros(len(key), np.int64)
    np.maximum.at(newest_ns, which, decided["sent_ns"])
    pairs = np.column_stack([place // count, place % count, key % _OUTCOMES, number])
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
    """One row of each frame that was sent."""
    if not len(rows):
        return rows
    seq = rows["seq"] - rows["seq"].min()
    copy = rows["copy"].astype(np.int64)
    frame = (rows["sender"] * (copy.max() + 1) + copy) * (seq.max() + 1) + seq
    return rows[np.unique(frame, return_index=True)[1]]


def event_message(event: Event) -> dict[str, Any]:
    """An event, with no more of its details than one can read at a glance."""
    return {
        "time_ns": event.time_ns,
        "kind": event.kind,
        "node": event.node,
        "details": {key: _short(value) for key, value in event.details.items()},
    }


def _short(value: object) -> object:
    if value is None or isinstance(value, (bool, int, float)):
        return value
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= LONGEST_DETAIL else text[: LONGEST_DETAIL - 1] + "…"
