"""The check that a run replays: two runs of one scenario, compared row by row."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from emulator.records.events import Event, EventKind
from emulator.records.parting import first_difference, first_frame
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.run_folder import AGAIN
from emulator.records.verdicts import CheckResult, Finding, NotExercised, Verdict, invalid, named, valid
from vnet.errors import printable
from vnet.units import NS_PER_S

ONCE = NotExercised("replay", "it ran once; --check-determinism runs it twice")
CALLS = "logs/calls"
"""Folder of the calls of each node, with the lines of the program that made them; with `--check-determinism`."""
LONGEST_LINE = 1000
LONGEST = 100
"""Characters that are shown of a call."""
TABLES = ("trace", "states", "metrics", "events")
"""The tables that are compared; events are those that programs tell by `node.event`."""
EVENTS = pa.schema({"time_ns": pa.int64(), "node": pa.string(), "name": pa.string(), "values": pa.string()})
ABOUT = ("sent_ns", "sender", "seq", "receiver", "copy", "time_ns", "node", "name", "outcome", "arrival_ns")
"""The columns that are shown of a differing row, beside those that differ."""


def check_replay(folder: Path) -> Finding:
    """Compare a run with the second one in its folder; of one that ran once, what was said then is said again.

    Raises VnetError if a table cannot be read.
    """
    first, second = RecordedRun.open(folder), RecordedRun.open(folder / AGAIN)
    if second.has_record:
        return compare_runs(first, second)
    said = first.record.not_exercised if first.has_record else []
    return next((each for each in said if each.name == ONCE.name), ONCE)


def compare_runs(ours: OpenedRun, theirs: OpenedRun) -> CheckResult:
    """Compare two finished runs, and name the first frame and line of the program in which they differ.

    Raises VnetError if a table cannot be read.
    """
    found = compare_tables(_tables(ours), _tables(theirs))
    if found.verdict is Verdict.VALID:
        return found
    told, figures = _first_frame(ours, theirs)
    call, node = first_call(ours.folder, theirs.folder)
    if call:
        told, figures = f"{told}; {call}", {**figures, "call": call, "vehicle": node}
    return CheckResult(found.name, found.verdict, f"{found.text}; {told}", {**found.figures, **figures})


def _first_frame(ours: OpenedRun, theirs: OpenedRun) -> tuple[str, dict[str, Any]]:
    """Return the first frame in which two runs differ, as a phrase and as figures."""
    parting = first_frame(ours, theirs)
    if parting is None:
        return "no frame differs", {}
    frame = (parting.first or parting.second).partition(",")[0]
    seconds = f"{parting.time_ns / NS_PER_S:.6f}"
    return f"first {frame} at {seconds} s", {"frame": frame, "time_s": float(seconds), "vehicle": parting.node}


def first_call(ours: Path, theirs: Path) -> tuple[str, str]:
    """Return the first call in which the programs of two runs differ, with its line, and its vehicle; or "", ""."""
    first, second = ours / CALLS, theirs / CALLS
    differing = []
    for node in sorted({each.name for folder in (first, second) if folder.is_dir() for each in folder.iterdir()}):
        pairs = zip_longest(_calls(first / node), _calls(second / node))
        if (pair := next((pair for pair in pairs if pair[0] != pair[1]), None)) is not None:
            differing.append((min(time_ns for time_ns, *_ in filter(None, pair)), node, pair))
    if not differing:
        return "", ""
    time_ns, node, calls = min(differing, key=lambda each: each[:2])
    one, other = (_told(call, time_ns) for call in calls)
    told = f"{one} in both" if one == other else f"{one} and {other}"
    return f"{node}'s program parts at {time_ns / NS_PER_S:.6f} s: {told}", node


Call = tuple[int, str, str, str]
"""Time in ns, kind, digest, and file and line of the program."""


def _calls(path: Path) -> Iterator[Call]:
    """Yield the calls of a node in their order; what is no such file ends them."""
    if not path.is_file():
        return
    with path.open(errors="replace") as lines:
        for line in iter(lambda: lines.readline(LONGEST_LINE), ""):
            parts = line.rstrip("\n").split("\t")
            if len(parts) != 4 or not parts[0].isdecimal():
                return
            yield int(parts[0]), parts[1], parts[2], parts[3]


def _told(call: Call | None, time_ns: int) -> str:
    """Return a call of that instant in words; "nothing" for a later one."""
    if call is None or call[0] != time_ns:
        return "nothing"
    return printable(f"{call[1]} from {call[3]}", LONGEST)


def _tables(run: OpenedRun) -> tuple[pa.Table, ...]:
    """The tables of a run, as `TABLES` calls them."""
    return run.trace, run.states, run.metrics, events_table(run.events)


def events_table(events: Sequence[Event]) -> pa.Table:
    """Return what programs told by `node.event`, in the order of time and node."""
    own = (event for event in events if event.kind == EventKind.event)
    rows = sorted((event.time_ns, event.node or "", event.name, str(event.values)) for event in own)
    return pa.table([list(column) for column in zip(*rows, strict=True)] or [[]] * len(EVENTS), schema=EVENTS)


def _with_columns(ours: pa.Table, theirs: pa.Table) -> tuple[pa.Table, pa.Table]:
    """Two tables with the columns of both, null in the one that has none; those that are empty are left out."""
    tables = [ours, theirs]
    for here, there in ((0, 1), (1, 0)):
        for name in set(tables[there].column_names) - set(tables[here].column_names):
            column = tables[there][name]
            values = pc.list_flatten(column) if pa.types.is_list(column.type) else column
            if values.null_count == len(values):
                tables[there] = tables[there].drop_columns([name])
            else:
                tables[here] = tables[here].append_column(name, pa.nulls(len(tables[here]), column.type))
    return tables[0], tables[1]


def compare_tables(ours: Sequence[pa.Table], theirs: Sequence[pa.Table]) -> CheckResult:
    """Compare the tables of two runs, as `TABLES` calls them; a column that one lacks is empty there."""
    pairs = zip(TABLES, ours, theirs, strict=True)
    return compare([(name, *_with_columns(mine, other)) for name, mine, other in pairs])


def compare(tables: list[tuple[str, pa.Table, pa.Table]]) -> CheckResult:
    """Compare tables (name, first, second) of two runs; the first difference is shown."""
    for name, first, second in tables:
        index = first_difference(first, second)
        if index is not None:
            return _difference(name, first, second, index)
    text = f"two runs agree: {len(tables[0][1]):,} rows of the trace, all states, metrics and events of programs"
    return named("replay", valid(text, rows_each=len(tables[0][1])))


def _difference(name: str, first: pa.Table, second: pa.Table, index: int) -> CheckResult:
    ours, theirs = _row(first, index), _row(second, index)
    differing = [key for key in first.column_names if str(ours.get(key)) != str(theirs.get(key))]
    how = ", ".join(differing) if ours and theirs else "one has no such row"
    shown = [
        {"run": run, "row": index, **{key: _shown(row[key]) for key in row if key in ABOUT or key in differing}}
        for run, row in (("first", ours), ("again", theirs))
    ]
    text = f"two runs differ, first in row {index} of the {name}: {how}"
    return named("replay", invalid(text, table=name, row=index, differing=differing, rows=shown))


def _row(table: pa.Table, index: int) -> dict[str, Any]:
    return dict(table.slice(index, 1).to_pylist()[0]) if index < len(table) else {}


def _shown(value: Any) -> Any:
    return value if isinstance(value, (str, int)) else str(value)
