"""The parting of two runs: the first decision, frame, reception, event and reported value in which they differ."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, takewhile, zip_longest
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from emulator.radio.outcomes import Outcome
from emulator.records.events import SAMPLES, Event
from emulator.records.recorded_run import OpenedRun
from emulator.records.reported import reported_columns
from emulator.records.tape import TAPE_FILE, TapeEntry, described, read_tape
from vnet.transport.wire import Deviation
from vnet.units import NS_PER_S

FRAME = ("sent_ns", "sender", "seq", "size_bytes", "payload_digest")
RECEPTION = ("sent_ns", "sender", "seq", "copy", "receiver", "outcome", "cause", "arrival_ns")
MOST_BEFORE = 8
"""Events and frames that are told of before a parting."""


@dataclass(frozen=True)
class Parting:
    """The first difference of one kind: when, of which node, and what each run has there; "" for nothing."""

    time_ns: int
    kind: str
    node: str
    first: str
    second: str


def partings(first: OpenedRun, second: OpenedRun) -> list[Parting]:
    """Return the first difference of each kind, the earliest first; none if the runs agree.

    At one instant a decision comes before the frames that follow from it, and these before what becomes of them.
    Raises VnetError if a file cannot be read.
    """
    found = [
        _first_entry("decision", _decisions(first), _decisions(second)),
        first_frame(first, second),
        _first_reception(first, second),
        _first_entry("event", _events(first), _events(second)),
        _first_vehicle(first, second),
        _first_value(first.states, second.states),
    ]
    return sorted((each for each in found if each is not None), key=lambda each: each.time_ns)


def before(trace: pa.Table, events: Sequence[Event], node: str, end_ns: int) -> list[str]:
    """Return what happened to a node until then, as lines, the latest last: receptions, own frames, events."""
    lines = [
        (event.time_ns, f"event {event.kind} {event.details.get('name', event.details.get('text', ''))}".rstrip())
        for event in events
        if event.node == node and event.time_ns < end_ns
    ]
    mine = [pc.equal(trace[column].cast(pa.string()), node) for column in ("sender", "receiver")]
    for row in trace.select(RECEPTION).filter(pc.or_(*mine)).to_pylist():
        if row["receiver"] == node and row["arrival_ns"] is not None and row["arrival_ns"] <= end_ns:
            lines.append((row["arrival_ns"], f"heard frame {row['seq']} of {row['sender']}"))
        elif row["sender"] == node and row["sent_ns"] < end_ns:
            lines.append((row["sent_ns"], f"sent frame {row['seq']}"))
    latest = sorted(set(lines))[-MOST_BEFORE:]
    return [f"{time_ns / NS_PER_S:.6f} s  {text}" for time_ns, text in latest]


Entry = tuple[int, str, str]
"""Time in ns, node and text of something that happened."""


def _first_entry(kind: str, first: Sequence[Entry], second: Sequence[Entry]) -> Parting | None:
    """Return the first entry that one run has, beside what the other has of that node and instant in its place.

    An entry that the other run has as well, only later in its list, is not in its place.
    """
    for i, (ours, theirs) in enumerate(zip_longest(first, second)):
        if ours != theirs:
            time_ns, node, _ = min(each for each in (ours, theirs) if each is not None)
            shown = [
                each[2]
                if each is not None and each[:2] == (time_ns, node) and not _is_among(each, other[i:])
                else ""
                for each, other in ((ours, second), (theirs, first))
            ]
            return Parting(time_ns, kind, node, shown[0], shown[1])
    return None


def _is_among(entry: Entry, others: Sequence[Entry]) -> bool:
    """Return whether the entry is one of the others of its instant, which come first."""
    return entry in takewhile(lambda other: other[0] <= entry[0], others)


def _decisions(run: OpenedRun) -> list[Entry]:
    path = run.folder / TAPE_FILE
    return [(entry.time_ns, _node(entry), described(entry)) for entry in (read_tape(path) if path.exists() else ())]


def _node(entry: TapeEntry) -> str:
    return entry.node if isinstance(entry, Deviation) else entry.medium[0]


def _events(run: OpenedRun) -> list[Entry]:
    entries = []
    for event in run.events:
        if event.node is not None and not event.has(SAMPLES):
            details = ", ".join(f"{key} = {value}" for key, value in event.details.items() if key != "where")
            entries.append((event.time_ns, event.node, f"{event.kind} {details}".rstrip() + _line(event.details)))
    return sorted(entries)


def _line(details: dict[str, Any]) -> str:
    """Return the innermost line of the program in the traceback of an event, if it has one."""
    lines = [line.strip(" |") for line in str(details.get("where", "")).splitlines() if 'File "' in line]
    return f" ({lines[-1]})" if lines else ""


Row = dict[str, Any]


def first_frame(first: OpenedRun, second: OpenedRun) -> Parting | None:
    """Return the first frame in which two runs differ.

    A frame that all its receivers heard otherwise than it was sent is compared by receptions alone.
    """
    whole, changed = zip(*(_frames(run.trace) for run in (first, second)), strict=True)
    unknown = set().union(*(of_one - _names(frames) for of_one, frames in zip(changed, whole, strict=True)))
    frames = [
        each
        if not unknown
        else each.filter(pa.array([name not in unknown for name in _name_list(each)], pa.bool_()))
        for each in whole
    ]
    return _first_row("frame", frames, [each["sent_ns"] for each in frames], _frame)


def _frames(trace: pa.Table) -> tuple[pa.Table, set[tuple[str, int]]]:
    """Return the frames as they were sent, and the names of those that somebody heard otherwise, by a fault."""
    by_fault = pc.not_equal(pc.fill_null(trace["cause"].cast(pa.string()), ""), "")
    changed = pc.and_(pc.equal(trace["outcome"].cast(pa.string()), Outcome.delivered.name), by_fault)
    return _distinct(trace.filter(pc.invert(changed)).select(FRAME)), _names(trace.filter(changed))


def _name_list(table: pa.Table) -> list[tuple[str, int]]:
    """Return sender and number of each row's frame."""
    return list(zip(table["sender"].to_pylist(), table["seq"].to_pylist(), strict=True))


def _names(table: pa.Table) -> set[tuple[str, int]]:
    return set(_name_list(table))


def _first_reception(first: OpenedRun, second: OpenedRun) -> Parting | None:
    """Return the first reception in which two runs differ."""
    traces = [run.trace.select(RECEPTION) for run in (first, second)]
    known_ns = [pc.coalesce(trace["arrival_ns"], trace["sent_ns"]) for trace in traces]
    parting = _first_row("reception", traces, known_ns, _reception)
    if parting is None:
        return None
    ours, theirs = parting.first, parting.second
    return replace(
        parting,
        first=ours or _elsewhen(traces[0], parting.node, theirs),
        second=theirs or _elsewhen(traces[1], parting.node, ours),
    )


def _elsewhen(trace: pa.Table, node: str, reception: str) -> str:
    """Return what became of a reception in a run that has it at another instant; "" if it has not got it."""
    name = reception.partition(": ")[0]
    rows = trace.filter(pc.equal(trace["receiver"].cast(pa.string()), node)).to_pylist()
    entries = (entry for entry in map(_reception, rows) if entry[2].startswith(f"{name}: "))
    return next((f"{text}, at {time_ns / NS_PER_S:.6f} s" for time_ns, _, text in entries), "")


def _distinct(table: pa.Table) -> pa.Table:
    """Return the rows of a table, each once, in the order of their values."""
    place = table.column_names.index("sender")
    table = table.set_column(place, "sender", table["sender"].cast(pa.string()))
    names = table.column_names
    return table.group_by(names).aggregate([]).select(names).sort_by([(name, "ascending") for name in names])


def _first_row(
    kind: str, tables: Sequence[pa.Table], times: Sequence[pa.ChunkedArray], entry: Callable[[Row], Entry]
) -> Parting | None:
    """Return the first entry in which two tables differ, whose rows are known at these times.

    Tables may have millions of rows, so entries are made an instant at a time, of those that rows from the first
    difference on are of: the rows before it are the same.
    """
    row = first_difference(*tables)
    times_ns = [each.to_numpy() for each in times]
    orders = [np.argsort(each, kind="stable") for each in times_ns]
    for instant in () if row is None else np.unique(np.concatenate([each[row:] for each in times_ns])):
        found = []
        for table, time_ns, order in zip(tables, times_ns, orders, strict=True):
            start, end = (np.searchsorted(time_ns, instant, side, sorter=order) for side in ("left", "right"))
            found.append(sorted(map(entry, table.take(order[start:end]).to_pylist())))
        if (parting := _first_entry(kind, *found)) is not None:
            return parting
    return None


def first_difference(first: pa.Table, second: pa.Table) -> int | None:
    """Return the number of the first row in which two tables of the same columns differ; NaN equals NaN."""
    shared = min(len(first), len(second))
    index = None if len(first) == len(second) else shared
    for name in first.column_names:
        ours, theirs = first[name].slice(0, shared), second[name].slice(0, shared)
        if not ours.equals(theirs):
            differing = _first_differing(ours, theirs)
            index = differing if index is None or (differing is not None and differing < index) else index
    return index


def _first_differing(ours: pa.ChunkedArray, theirs: pa.ChunkedArray) -> int | None:
    """Return the index of the first row in which two columns differ; NaN equals NaN."""
    ours, theirs = (
        each.cast(pa.string()) if pa.types.is_dictionary(each.type) else each for each in (ours, theirs)
    )
    if ours.type == theirs.type and (pa.types.is_integer(ours.type) or pa.types.is_string(ours.type)):
        either_null = pc.xor(pc.is_null(ours), pc.is_null(theirs))
        index = pc.index(pc.or_(pc.fill_null(pc.not_equal(ours, theirs), False), either_null), True).as_py()
        return index if index >= 0 else None
    pairs = zip_longest(ours.to_pylist(), theirs.to_pylist())
    return next((number for number, (a, b) in enumerate(pairs) if a != b and str(a) != str(b)), None)


def _frame(row: Row) -> Entry:
    text = f"frame {row['seq']} of {row['sender']}, {row['size_bytes']} bytes, digest {row['payload_digest']:016x}"
    return row["sent_ns"], row["sender"], text


def _reception(row: Row) -> Entry:
    time_ns = row["sent_ns"] if row["arrival_ns"] is None else row["arrival_ns"]
    cause = f" ({row['cause']})" if row["cause"] else ""
    copy = f".{row['copy']}" if row["copy"] else ""
    text = f"frame {row['seq']}{copy} of {row['sender']} at {row['receiver']}: {row['outcome']}{cause}"
    return time_ns, row["receiver"], text


def _first_vehicle(first: OpenedRun, second: OpenedRun) -> Parting | None:
    """Return the vehicles that one of the runs has not got."""
    lacking = [[node for node in a.node_ids if node not in b.number] for a, b in ((first, second), (second, first))]
    if not any(lacking):
        return None
    shown = [f"{nodes[0]} and {len(nodes) - 1} more" if nodes[1:] else "".join(nodes) for nodes in lacking]
    return Parting(0, "vehicle", min(nodes[0] for nodes in lacking if nodes), shown[0], shown[1])


def _first_value(first: pa.Table, second: pa.Table) -> Parting | None:
    """Return the first value that programs of vehicles of both runs report otherwise, at its period's beginning."""
    columns = list(dict.fromkeys([*reported_columns(first.schema), *reported_columns(second.schema)]))
    both = pc.unique(first["node"].cast(pa.string()))
    both = both.filter(pc.is_in(both, pc.unique(second["node"].cast(pa.string()))))
    for ours, theirs in zip_longest(_values(first, both, columns), _values(second, both, columns)):
        if ours != theirs:
            return _parting_of(ours, theirs, columns)
    return None


def _parting_of(ours: Row | None, theirs: Row | None, columns: Sequence[str]) -> Parting:
    """Return the parting of two rows that differ; of different vehicles or times, one run has not got the first."""
    places = [(row["time_ns"], row["node"]) for row in (ours, theirs) if row is not None]
    time_ns, node = min(places)
    rows = [
        row if row is not None and (row["time_ns"], row["node"]) == (time_ns, node) else {}
        for row in (ours, theirs)
    ]
    name = next((name for name in columns if rows[0].get(name) != rows[1].get(name)), "report")
    shown = [f"{name} = {row.get(name)}" if row else "" for row in rows]
    return Parting(time_ns, "value", node, shown[0], shown[1])


def _values(states: pa.Table, nodes: pa.Array, columns: Sequence[str]) -> Iterator[Row]:
    """Yield the rows of these nodes, by time and then by name."""
    there = [name for name in columns if name in states.column_names]
    table = states.select(["time_ns", "node", *there])
    table = table.set_column(1, "node", table["node"].cast(pa.string()))
    table = table.filter(pc.is_in(table["node"], nodes))
    order = pc.sort_indices(table.select(["time_ns", "node"]), [("time_ns", "ascending"), ("node", "ascending")])
    for row in table.take(order).to_pylist():
        shown = {name: str(row.get(name)) for name in columns}
        yield {"time_ns": row["time_ns"], "node": row["node"], **shown}


@dataclass(frozen=True)
class FrameEntry:
    """A frame: its sender, its payload if the run has kept it, and its receivers by outcome."""

    sent_ns: int
    sender: str
    seq: int
    copy: int
    size_bytes: int
    digest: int
    payload: bytes | None
    outcomes: dict[str, list[str]]


def frame_log(recorded: OpenedRun, node: str | None, start_ns: int, end_ns: int | None) -> Iterator[FrameEntry]:
    """Yield the frames that were sent in [start, end) in the order of time.

    With `node` only those that it sent, with all receivers, and those that it could hear, with it alone. A frame
    that arrived altered at some receivers is listed with its first receiver's digest.
    """
    chosen = recorded.sent_ns >= start_ns
    if end_ns is not None:
        chosen &= recorded.sent_ns < end_ns
    if node is not None:
        number = recorded.number[node]
        chosen &= (recorded.sender == number) | (recorded.receiver == number)
    rows = np.flatnonzero(chosen)
    rows = rows[np.lexsort((recorded.receiver[rows], recorded.emission[rows], recorded.sent_ns[rows]))]
    outcome = recorded.trace["outcome"].cast(pa.string()).take(pa.array(rows)).to_pylist()
    edges = np.flatnonzero(np.diff(recorded.emission[rows])) + 1
    sizes, names, kept = recorded.column("size_bytes"), recorded.node_ids, recorded.payloads
    bounds = [0, *edges.tolist(), len(rows)] if len(rows) else []
    for first, end in pairwise(bounds):
        row = int(rows[first])
        outcomes: dict[str, list[str]] = {}
        for index in range(first, end):
            outcomes.setdefault(outcome[index], []).append(names[int(recorded.receiver[rows[index]])])
        sender, seq, digest = names[int(recorded.sender[row])], int(recorded.seq[row]), int(recorded.digest[row])
        yield FrameEntry(
            sent_ns=int(recorded.sent_ns[row]),
            sender=sender,
            seq=seq,
            copy=int(recorded.copy[row]),
            size_bytes=int(sizes[row]),
            digest=digest,
            payload=None if kept is None else kept.of(sender, seq, recorded.digest[rows[first:end]].tolist()),
            outcomes=outcomes,
        )
