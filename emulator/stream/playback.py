"""The messages of a run that is over, from its files alone: what those who watched it were told."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from emulator.radio.trace import ROW, decided_ns
from emulator.records.events import Event
from emulator.records.metrics import rows_of
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.reported import is_text, numbers_of
from emulator.records.run_folder import WORLD_FILE, check_is_run
from emulator.records.tables import (
    BACKGROUND,
    BUSY,
    METRICS,
    STATES,
    VALUES_AS_LIST,
    busy_windows,
    mean_busy,
    positions_by_time,
)
from emulator.stream.messages import Beliefs, event_message, period_message, scene_message
from emulator.world.world import Instant
from vnet.errors import VnetError
from vnet.types import Array

ROWS_AT_ONCE = 1 << 14
"""Rows of the states that are made to messages at once."""
_TRUTH = {"position_m": 2, "fix_m": 2, "common_error_m": 2}
Message = tuple[str, dict[str, Any]]


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
    down, trace = _Down(run), _Trace(run)
    for now, happened, (instant, beliefs) in zip(figures, events, _states(run), strict=False):
        start_ns, end_ns = now.time_ns, now.time_ns + period_ns
        faults = [planned.label for planned in run.plan if planned.acts_between(start_ns, end_ns)]
        busy_ratio = mean_busy(busy, len(run.node_ids), start_ns, end_ns)
        frames = trace.until(end_ns), ~down.at(end_ns - 1), faults, happened, busy_ratio
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
    peers = {name: _of_peers(values_of, f"{name}.", run.number) for name in run.views.peers}
    values, texts = _values(run, table)
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


def _values(run: RecordedRun, table: pa.Table) -> tuple[dict[str, Array], dict[str, list[list[str]]]]:
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


def _of_peers(column: pa.Array, prefix: str, number: Mapping[str, int]) -> dict[int, Array]:
    """The values (n,) that each node has for others, by row; 0 where none, and no entry where none at all."""
    lists = column.cast(VALUES_AS_LIST)
    entries = lists.flatten()
    name, value = pc.struct_field(entries, "key"), pc.struct_field(entries, "value")
    one = pc.and_(pc.starts_with(name, prefix), pc.equal(pc.list_value_length(value), 1))
    row = pc.list_parent_indices(lists).filter(one).to_numpy()
    amount = np.asarray(value.filter(one).flatten(), dtype=float)
    found: dict[int, Array] = {}
    for place, key, one_value in zip(row.tolist(), name.filter(one).to_pylist(), amount.tolist(), strict=True):
        other = number.get(key.removeprefix(prefix))
        if other is not None:
            found.setdefault(place, np.zeros(len(number)))[other] = one_value
    return found


class _Down:
    """Spans in which vehicles were down."""

    def __init__(self, recorded: RecordedRun) -> None:
        self._count = len(recorded.node_ids)
        self._node = np.array([span.node for span in recorded.down], dtype=np.intp)
        self._start_ns = np.array([span.start_ns for span in recorded.down], dtype=np.int64)
        self._end_ns = np.array([span.end_ns for span in recorded.down], dtype=np.int64)

    def at(self, time_ns: int) -> NDArray[np.bool_]:
        """Mask (n,) of the vehicles that were down at an instant."""
        down = np.zeros(self._count, dtype=bool)
        down[self._node[(self._start_ns <= time_ns) & (time_ns < self._end_ns)]] = True
        return down


def _by_period(events: Iterable[Event], period_ns: int, periods: int) -> list[list[Event]]:
    """The events of each period, and at the end those that came after the last."""
    told: list[list[Event]] = [[] for _ in range(periods + 1)]
    for event in events:
        told[min(event.time_ns // period_ns, periods)].append(event)
    return told
