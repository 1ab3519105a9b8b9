"""Export of all tables of a run as CSV: points in two columns, matrices in four, other nested values as JSON."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
from numpy.typing import NDArray

from emulator.radio.outcomes import Stage, decided_at
from emulator.records.radio_metrics import radio_metrics, sent_by_programs
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.tables import TABLES
from emulator.world.radio_inputs import COLUMNS, LinkTable
from vnet.errors import VnetError
from vnet.types import IntArray, Mask
from vnet.units import NS_PER_S

AXES = {2: ("x", "y"), 4: ("xx", "xy", "yx", "yy")}
"""Suffixes of the columns of a list by its length."""


def write_csv(recorded: OpenedRun, folder: Path) -> list[str]:
    """Write all tables into a folder; return the files' names. Raise OSError if one cannot be written."""
    events = [
        {"time_ns": e.time_ns, "kind": e.kind, "node": e.node, "details": json.dumps(e.details)}
        for e in recorded.events
    ]
    figures = radio_metrics(recorded)
    tables = {kind.name: table for kind in TABLES if (table := recorded.table(kind)) is not None}
    tables["events"] = pa.Table.from_pylist(events)
    tables |= {"links": figures.links, "vehicles": figures.vehicles, "distances": figures.distances}
    for name, table in tables.items():
        pacsv.write_csv(flat(table), folder / f"{name}.csv")
    return [f"{name}.csv" for name in tables]


def flat(table: pa.Table) -> pa.Table:
    """Return a table whose columns all hold numbers or text."""
    return pa.table(dict(_flat_columns(table)))


def _flat_columns(table: pa.Table) -> Iterator[tuple[str, pa.Array]]:
    for name in table.column_names:
        column = table[name].combine_chunks()
        kind = column.type
        if pa.types.is_dictionary(kind):
            yield name, column.cast(pa.string())
        elif pa.types.is_fixed_size_list(kind) and kind.list_size in AXES:
            for index, axis in enumerate(AXES[kind.list_size]):
                yield f"{name}_{axis}", pc.list_element(column, index)
        elif pa.types.is_large_binary(kind):
            yield f"{name}_hex", pa.array([entry.hex() for entry in column.to_pylist()], pa.string())
        elif pa.types.is_nested(kind):
            plain = dict if pa.types.is_map(kind) else list
            texts = (None if entry is None else json.dumps(plain(entry)) for entry in column.to_pylist())
            yield name, pa.array(texts, pa.string())
        else:
            yield name, column


DIGITS = 9
"""Decimals of times in seconds, so that they are whole nanoseconds again, and of shares."""
AT_SENDER = decided_at(Stage.SENDER)
"""Outcomes of frames that were never on air, which say nothing of a link."""


def write_links(recorded: OpenedRun, file: BinaryIO, every_s: float = 1.0) -> int:
    """Write the links of a run, with their losses in intervals of `every_s`; return the number of rows.

    With 0 each reception is an interval of its own, so that its row says 0 or 1. Raise VnetError without a row.
    """
    table = measured_links(recorded, round(every_s * NS_PER_S))
    if not len(table.time_ns):
        raise VnetError(f"{recorded.folder}: no frame was on air to a vehicle in range: there are no links")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    names = recorded.node_ids
    columns = (column.tolist() for column in (table.time_ns, table.sender, table.receiver, table.loss))
    for time_ns, sender, receiver, loss in zip(*columns, strict=True):
        said = "" if np.isnan(loss) else f"{loss:.{DIGITS}g}"
        writer.writerow([f"{time_ns / NS_PER_S:.{DIGITS}f}", names[sender], names[receiver], said])
    file.write(text.getvalue().encode())
    return len(table.time_ns)


def measured_links(recorded: RecordedRun, every_ns: int) -> LinkTable:
    """Return the links of a run, with the shares of frames that did not arrive in intervals of `every_ns`.

    A link begins with its first frame in range and ends when the receiver goes out of range. Losses by faults, the
    peer cap, fading and collisions count; frames that never were on air, and copies by faults, do not. Each attempt
    of a frame to one vehicle counts, and its acknowledgement as a frame of the opposite link.
    """
    count = len(recorded.node_ids)
    starts_ns = recorded.places.starts_ns
    entered, left = _spans(recorded)
    pair, sent_ns, came = _transmissions(recorded)
    epoch = np.searchsorted(starts_ns, sent_ns, side="right") - 1
    since_ns = starts_ns[_last_up_to(entered, pair, epoch, len(starts_ns))]
    start_ns = np.maximum(sent_ns // every_ns * every_ns if every_ns else sent_ns, since_ns)
    groups, group = np.unique(np.stack([start_ns, pair]), axis=1, return_inverse=True)
    attempts = np.bincount(group.ravel(), minlength=groups.shape[1])
    share = np.bincount(group.ravel(), ~came, groups.shape[1]) / attempts
    time_ns = np.append(groups[0], starts_ns[left[0]])
    pairs = np.append(groups[1], left[1])
    loss = np.append(share, np.full(left.shape[1], np.nan))
    order = np.lexsort((pairs, time_ns))
    order = order[_changes(pairs[order], loss[order])]
    return LinkTable(time_ns[order], pairs[order] // count, pairs[order] % count, loss[order])


def _transmissions(recorded: RecordedRun) -> tuple[IntArray, IntArray, Mask]:
    """Return what was transmitted on links in range: pair (n,), when its frame was sent, and whether it came.

    All attempts and acknowledgements have the positions of the time at which the program sent the frame.
    """
    count = len(recorded.node_ids)
    used = sent_by_programs(recorded) & ~recorded.outcome_is(*AT_SENDER, "out_of_range") & recorded.placed
    data, answered = np.flatnonzero(used), np.flatnonzero(used & (recorded.ack_on_air_ns >= 0))
    sender, receiver, sent_ns = recorded.sender, recorded.receiver, recorded.sent_ns
    in_range = recorded.places.pairs_in_range(receiver[answered], sender[answered], sent_ns[answered])
    answered = answered[in_range]
    pair = sender[data] * count + receiver[data], receiver[answered] * count + sender[answered]
    came = (recorded.arrived | recorded.outcome_is("duplicate"))[data], recorded.acked[answered]
    return np.concatenate(pair), sent_ns[np.append(data, answered)], np.concatenate(came)


def _spans(recorded: RecordedRun) -> tuple[IntArray, IntArray]:
    """Return when pairs come into range, and when they leave it: epochs and pairs (2, n), sorted by epoch."""
    count = len(recorded.node_ids)
    before = np.zeros(0, np.int64)
    entered, left = [np.zeros((2, 0), np.int64)], [np.zeros((2, 0), np.int64)]
    for epoch, start_ns in enumerate(recorded.places.starts_ns.tolist()):
        links = recorded.places.links(start_ns)
        now = (links.sender * count + links.receiver).astype(np.int64)
        for found, some in ((entered, np.setdiff1d(now, before)), (left, np.setdiff1d(before, now))):
            found.append(np.stack([np.full(len(some), epoch), some]))
        before = now
    return np.concatenate(entered, axis=1), np.concatenate(left, axis=1)


def _last_up_to(events: IntArray, pair: IntArray, epoch: IntArray, epochs: int) -> IntArray:
    """Return the epoch (n,) of the last of a pair's events (2, e), epochs and pairs, up to an epoch."""
    known = np.sort(events[1] * epochs + events[0])
    index = np.searchsorted(known, pair * epochs + epoch, side="right") - 1
    return known[index] % epochs


def _changes(pair: IntArray, loss: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the rows, sorted by time, whose loss is another than that of their pair's row before."""
    order = np.argsort(pair, kind="stable")
    same = (np.diff(pair[order]) == 0) & (
        (np.diff(loss[order]) == 0) | (np.isnan(loss[order][1:]) & np.isnan(loss[order][:-1]))
    )
    first = np.append(True, ~same)[: len(order)]
    # A pair that has been in range without a frame leaves without a row.
    began = np.append(True, np.diff(pair[order]) != 0)[: len(order)]
    return np.sort(order[first & ~(began & np.isnan(loss[order]))])
