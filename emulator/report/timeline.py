"""The timeline of a report: a lane a vehicle, frames as arrows, faults, failures and events of programs.

This module chooses what is shown and packs it; `timeline.js` draws it. Of large runs it keeps whole frames: all
that are near failures, faults and events, and some of the others.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from emulator.radio.outcomes import Outcome, Stage
from emulator.records.events import Event, EventKind, Level
from emulator.records.recorded_run import END_OF_TIME_NS, Emissions, OpenedRun, RecordedRun
from emulator.records.tables import TRACE
from emulator.report.source import Source, acted, maybe
from vnet.errors import printable
from vnet.types import IntArray, Mask

MOST_RECEPTIONS = 20_000
"""Arrows in a page: some 300 kB."""
NEAR_SHARE = 0.7
"""Share of them for frames near what matters; the others are spread over the run."""
MOST_MARKS = 3000
MOST_SPANS = 300
MOST_LANES = 60
"""Lanes at once; of more vehicles those come first that have marks, then those with most frames."""
LONGEST_TEXT = 240
"""Characters of a mark's text."""
LONGEST_PIECE = 10_000
"""Characters of data that a template prints at once; it cuts longer texts."""
NS_PER_US = 1000
FIRST_VIEW_US = 1_000_000
SHORTEST_VIEW_US = 100_000
SHARE_BEFORE = 0.6
"""Share of the first view that is before a failure or the beginning of a fault."""
DELAYS_IN_VIEW = 60
"""Usual delays of frames in the first view: arrows are then some 20 pixels wide."""

FAILURE, WARNING, EVENT, PROCESS = "failure", "warning", "event", "process"
SIGNS = {Level.FAILURE: FAILURE, Level.WARNING: WARNING, Level.CHANGE: PROCESS, Level.TOLD: EVENT}
"""The kind of mark of an event of a level that has one."""
PRIORITY = (FAILURE, PROCESS, WARNING, EVENT)
WEIGHTS = {FAILURE: 1, "fault": 4, PROCESS: 4, WARNING: 16, EVENT: 16}
"""Factors by which frames of large runs must be nearer to one of these than to a failure to be kept."""
LEGEND = {
    FAILURE: ("✖", "rust", "failures of programs"),
    PROCESS: ("▶", "quiet", "starts and ends"),
    WARNING: ("▲", "orange", "warnings"),
    EVENT: ("◆", "blue", "events of programs"),
}
"""Sign, colour and title of each kind of mark."""


@dataclass(frozen=True)
class Mark:
    """Something that happened to a vehicle, or with `node` -1 to the run."""

    time_us: int
    node: int
    kind: str
    text: str


@dataclass(frozen=True)
class Bar:
    """A time in which a fault acted on some nodes."""

    label: str
    start_us: int
    end_us: int
    nodes: tuple[int, ...]


@dataclass(frozen=True)
class Timeline:
    """Contents of the page: the packed data, the legend, and a sentence on what is left out."""

    data: str
    """JSON, without any line break."""
    note: str
    """Share of the run that is shown, in words."""
    outcomes: list[tuple[str, str, str]]
    """Title, colour and count of each outcome."""
    kinds: list[tuple[str, str, str, str, str]]
    """Kind, sign, colour, title and count of each kind of mark."""
    has_marks: bool
    """True if there are marks or faults to go to."""

    @property
    def pieces(self) -> list[str]:
        """The data in pieces that a template shows in full."""
        return [self.data[i : i + LONGEST_PIECE] for i in range(0, len(self.data), LONGEST_PIECE)]


def timeline(source: Source, most: int = MOST_RECEPTIONS, at_us: int | None = None) -> Timeline | None:
    """Return the timeline of a run with `most` receptions at most; None if there is no trace, and so no lanes.

    It begins at the first failure, else at `at_us`, else at the first fault.
    """
    if maybe(lambda: source.trace) is None or maybe(lambda: source.node_ids) is None or not source.node_ids:
        return None
    events = maybe(lambda: source.events) or []
    end_us = round(source.end_s * 1e6)
    all_marks = marks_of(events, source.number)
    marks, bars = _first_marks(all_marks), bars_of(events, source.number, end_us)
    sent_us = _on_air_us(source)
    frames, points = source.emissions, points_of(all_marks, bars)
    kept, how = choose(frames, sent_us[frames.first], points, most)
    rows = np.flatnonzero(kept[frames.of_row])
    rows = rows[np.lexsort((source.receiver[rows], source.emission[rows], sent_us[rows]))]
    view = first_view(_first_point(marks, bars, at_us), end_us, _usual_delay_us(source, sent_us))
    data = {
        "end": end_us,
        "view": view,
        "lanes": MOST_LANES,
        "nodes": [printable(node) for node in source.node_ids],
        "first": _first_lanes(source, marks, bars),
        "marks": [[mark.time_us, mark.node, mark.kind, mark.text] for mark in marks],
        "bars": [[bar.label, bar.start_us, bar.end_us, list(bar.nodes)] for bar in bars],
        "down": _down(source, end_us),
        **_packed(source, rows, sent_us),
    }
    note = _note(len(rows), len(source.trace), how, points)
    if len(marks) < len(all_marks):
        note += f" {len(marks):,} of {len(all_marks):,} marks are shown, failures first."
    counts = Counter(source.trace["outcome"].cast(pa.string()).to_pylist())
    of_kind = Counter(mark.kind for mark in marks)
    return Timeline(
        data=json.dumps(data, separators=(",", ":")),
        note=note,
        outcomes=[
            (title, colour, f"{count:,}") for name, count in counts.items() for title, colour, _ in [_outcome(name)]
        ],
        kinds=[(kind, *LEGEND[kind], f"{of_kind[kind]:,}") for kind in PRIORITY if of_kind[kind]],
        has_marks=bool(marks or bars),
    )


# What happened, as marks and bars.


def marks_of(events: Iterable[Event], number: dict[str, int]) -> list[Mark]:
    """Return the marks of a run's events, in the order of time; log lines only from warnings on."""
    marks = []
    for event in events:
        kind = SIGNS.get(event.level)
        if kind is None or (event.kind == EventKind.log and kind == EVENT):
            continue
        node = -1 if event.node is None else number.get(event.node, -1)
        marks.append(Mark(event.time_ns // NS_PER_US, node, kind, printable(event.what, LONGEST_TEXT)))
    return sorted(marks, key=lambda mark: mark.time_us)


def _first_marks(marks: Sequence[Mark]) -> list[Mark]:
    """Return at most MOST_MARKS, failures first, in the order of time."""
    kept = sorted(marks, key=lambda mark: PRIORITY.index(mark.kind))[:MOST_MARKS]
    return sorted(kept, key=lambda mark: mark.time_us)


def bars_of(events: Iterable[Event], number: dict[str, int], end_us: int) -> list[Bar]:
    """Return the times in which faults acted, as the events say, with the nodes that they acted on."""
    bars = []
    for event, end_ns in acted(events):
        nodes = event.details.get("nodes")
        known = [number[node] for node in nodes if node in number] if isinstance(nodes, list) else []
        label = printable(str(event.details.get("fault")), LONGEST_TEXT)
        start_us = event.time_ns // NS_PER_US
        until_us = max(end_us, start_us) if end_ns is None else end_ns // NS_PER_US
        bars.append(Bar(label, start_us, until_us, tuple(known)))
    return sorted(bars, key=lambda bar: bar.start_us)[:MOST_SPANS]


def _down(recorded: OpenedRun, end_us: int) -> list[list[int]]:
    """Return when nodes were down: node, start, end."""
    spans = maybe(lambda: recorded.down) or []
    ends = [end_us if span.end_ns == END_OF_TIME_NS else span.end_ns // NS_PER_US for span in spans]
    down = [[span.node, span.start_ns // NS_PER_US, end] for span, end in zip(spans, ends, strict=True)]
    return down[:MOST_MARKS]


# Which frames.


def points_of(marks: Sequence[Mark], bars: Sequence[Bar]) -> dict[int, IntArray]:
    """Return the instants in µs of what matters in a run, by their weight."""
    points: dict[int, list[int]] = {}
    for mark in marks:
        points.setdefault(WEIGHTS[mark.kind], []).append(mark.time_us)
    for bar in bars:
        points.setdefault(WEIGHTS["fault"], []).extend((bar.start_us, bar.end_us))
    return {weight: np.unique(found) for weight, found in points.items()}


def choose(
    frames: Emissions, sent_us: IntArray, points: dict[int, IntArray], most: int
) -> tuple[Mask, tuple[int, int]]:
    """Return a mask of the frames that are shown, with `most` receptions at most, and how they were chosen.

    That is all within so many µs of a point of weight 1 (of the beginning, if there are no points), and of the
    others one in so many; (0, 1) if all are shown.
    """
    total = int(frames.receptions.sum())
    kept = np.ones(len(sent_us), dtype=bool)
    if total <= most:
        return kept, (0, 1)
    given = points or {1: np.zeros(1, dtype=np.int64)}
    far_us = np.min([weight * (1 + _distance_us(sent_us, at_us)) for weight, at_us in given.items()], axis=0)
    order = np.argsort(far_us, kind="stable")
    within = np.searchsorted(np.cumsum(frames.receptions[order]), NEAR_SHARE * most)
    radius_us = int(far_us[order[within]])  # frames of one instant are all shown or none
    kept = far_us < radius_us
    others = np.flatnonzero(~kept)
    others = others[np.argsort(sent_us[others], kind="stable")]
    left, step = most - int(frames.receptions[kept].sum()), 1
    while int(frames.receptions[others[::step]].sum()) > left and step < len(others):
        step = -(-step * 9 // 8)
    kept[others[::step]] = int(frames.receptions[others[::step]].sum()) <= left
    return kept, (max(0, radius_us - max(given)), step)


def _distance_us(time_us: IntArray, points_us: IntArray) -> IntArray:
    """Return how far each instant is from the nearest of the points, which are sorted."""
    after = np.clip(np.searchsorted(points_us, time_us), 0, len(points_us) - 1)
    before = np.maximum(after - 1, 0)
    return np.asarray(np.minimum(np.abs(points_us[after] - time_us), np.abs(points_us[before] - time_us)))


def _on_air_us(source: Source) -> IntArray:
    """Return when each row's frame was sent: with a MAC when it was on the air, if it ever was."""
    sent_ns = source.sent_ns
    if source.scenario.radio.mac is not None:
        on_air_ns = RecordedRun.open(source.folder, {TRACE: ("on_air_ns",)}).on_air_ns
        sent_ns = np.where(on_air_ns >= 0, on_air_ns, sent_ns)
    return np.asarray(sent_ns // NS_PER_US)


def _packed(recorded: OpenedRun, rows: NDArray[np.intp], sent_us: IntArray) -> dict[str, Any]:
    """Return frames and their receptions column by column; receptions are in the order of the frames."""
    emission = recorded.emission[rows]
    starts = np.flatnonzero(np.diff(emission, prepend=-1)) if len(rows) else np.zeros(0, dtype=np.intp)
    first = rows[starts]
    trace = recorded.trace.select(["outcome", "cause"]).take(pa.array(rows))
    outcome, cause = (
        trace[name].cast(pa.string()).combine_chunks().dictionary_encode() for name in trace.column_names
    )
    arrival_us = recorded.arrival_ns[rows] // NS_PER_US
    delay_us = np.where(recorded.arrival_ns[rows] >= 0, np.maximum(arrival_us - sent_us[rows], 0), -1)
    names, causes = outcome.dictionary.to_pylist(), [printable(each) for each in cause.dictionary.to_pylist()]
    return {
        "outcomes": [_outcome(name) for name in names],
        "causes": causes,
        "time": np.diff(sent_us[first], prepend=0).tolist(),
        "wait": (sent_us[first] - recorded.sent_ns[first] // NS_PER_US).tolist(),
        "sender": recorded.sender[first].tolist(),
        "seq": recorded.seq[first].tolist(),
        "copy": recorded.copy[first].tolist(),
        "bytes": recorded.column("size_bytes")[first].tolist(),
        "heard": np.diff(np.append(starts, len(rows))).tolist(),
        "receiver": recorded.receiver[rows].tolist(),
        "outcome": outcome.indices.to_numpy().tolist(),
        "cause": cause.indices.to_numpy().tolist(),
        "delay": delay_us.tolist(),
    }


def _outcome(name: str) -> tuple[str, str, bool]:
    """Return an outcome's title, colour, and whether its frames never leave the sender."""
    if name not in Outcome.__members__:
        return printable(name), "ink", False
    outcome = Outcome[name]
    return outcome.title, outcome.colour or "ink", outcome.stage is Stage.SENDER


# Which lanes and which time come first.


def _first_lanes(recorded: OpenedRun, marks: Sequence[Mark], bars: Sequence[Bar]) -> list[int]:
    """Return the lanes that are shown first: vehicles with failures, with other marks, with faults, the busiest."""
    count = len(recorded.node_ids)
    frames = np.bincount(recorded.sender, minlength=count) + np.bincount(recorded.receiver, minlength=count)
    failed, marked, faulty = (np.zeros(count, dtype=bool) for _ in range(3))
    for mark in marks:
        if mark.node >= 0:
            (failed if mark.kind == FAILURE else marked)[mark.node] = True
    for bar in bars:
        faulty[list(bar.nodes)] = True
    order = np.lexsort((np.arange(count), -frames, ~faulty, ~marked, ~failed))
    return [int(node) for node in np.sort(order[:MOST_LANES])]


def _usual_delay_us(recorded: OpenedRun, sent_us: IntArray) -> int:
    """Return the median time from the sending of a frame to its arrival; 0 if none arrived."""
    arrived = recorded.arrival_ns >= 0
    delay_us = recorded.arrival_ns[arrived] // NS_PER_US - sent_us[arrived]
    return int(np.median(delay_us)) if len(delay_us) else 0


def _first_point(marks: Sequence[Mark], bars: Sequence[Bar], at_us: int | None) -> int | None:
    """Return the instant of the first failure, else `at_us`, else that of the first fault, else None."""
    failure = next((mark.time_us for mark in marks if mark.kind == FAILURE), at_us)
    return min((bar.start_us for bar in bars), default=None) if failure is None else failure


def first_view(at_us: int | None, end_us: int, delay_us: int) -> list[int]:
    """Return the time that is shown first: around an instant, else the first second.

    Around an instant it is so short that the slope of arrows shows, which take `delay_us`.
    """
    width_us = min(FIRST_VIEW_US, max(end_us, 1))
    if at_us is None:
        return [0, width_us]
    if delay_us:
        width_us = min(width_us, max(SHORTEST_VIEW_US, DELAYS_IN_VIEW * delay_us))
    start_us = max(0, min(round(at_us - SHARE_BEFORE * width_us), end_us - width_us))
    return [start_us, start_us + width_us]


def _note(shown: int, total: int, how: tuple[int, int], points: Collection[int]) -> str:
    """Return in words how many receptions are shown, with the weights of the points near which all are."""
    if not total:
        return "No frame was sent to anybody in range."
    if shown == total:
        return f"All {total:,} attempted receptions are shown."
    radius_us, step = how
    near = [
        f"{radius_us / weight / 1e6:.3g} s of {what}"
        for weight, what in {
            1: "a failure",
            4: "a change of faults or vehicles",
            16: "a warning or an event",
        }.items()
        if weight in points
    ]
    within = " or ".join(near) if points else f"{radius_us / 1e6:.3g} s of the beginning"
    rest = f"one in {step:,}" if step > 1 else "some"
    return (
        f"{shown:,} of {total:,} attempted receptions are shown: those of all frames within {within}, and of "
        f"{rest} of the others."
    )
