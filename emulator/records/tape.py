"""`tape.jsonl`: where a run's order of events was not FIFO, a line each.

A line is a decision of one node (docs/orders.md), or the order in which frames of one instant came to the medium.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import msgspec

from vnet.errors import VnetError, printable
from vnet.transport.wire import Count, Deviation, TimeNs
from vnet.units import NS_PER_S

TAPE_FILE = "tape.jsonl"


@dataclass(frozen=True)
class MediumOrder:
    """The order in which the frames of these nodes came to the medium at `time_ns`, which is not that of nodes."""

    time_ns: TimeNs
    medium: tuple[str, ...]


@dataclass(frozen=True)
class _Decision:
    """A line of a `Deviation`, which on the wire has no names."""

    node: str
    incarnation: Count
    time_ns: TimeNs
    decision: Count
    label: str
    first: Annotated[str, msgspec.Meta(max_length=10_000)] = ""


TapeEntry = Deviation | MediumOrder


def described(entry: TapeEntry) -> str:
    """Return what an entry says, as a phrase: "v03: timer of main before packet from v01, at 4.2 s"."""
    at = f"at {entry.time_ns / NS_PER_S:g} s"
    if isinstance(entry, MediumOrder):
        return f"frames to the medium in the order {', '.join(entry.medium)}, {at}"
    return f"{entry.node}: {entry.label} before {entry.first}, {at}"


def dump_tape(entries: Iterable[TapeEntry]) -> str:
    """Return the text of a tape."""
    return "".join(line + "\n" for line in tape_lines(entries))


def tape_lines(entries: Iterable[TapeEntry]) -> list[str]:
    """Return the lines of a tape."""
    return [json.dumps(_plain(entry)) for entry in entries]


def _plain(entry: TapeEntry) -> dict[str, object]:
    return asdict(entry) if isinstance(entry, MediumOrder) else msgspec.structs.asdict(entry)


def read_tape(path: Path) -> list[TapeEntry]:
    """Read a tape. Raises VnetError for a file that is none, with the line."""
    try:
        lines = path.read_text().splitlines()
    except (OSError, ValueError) as error:
        raise VnetError(f"{path}: cannot be read: {error}") from None
    return parse_tape(lines, str(path))


def parse_tape(lines: Iterable[str], name: str) -> list[TapeEntry]:
    """Return the entries of the lines of a tape, which messages call `name`. Raises VnetError for a bad line."""
    entries = []
    for number, line in enumerate(lines, start=1):
        try:
            entries.append(_entry(line))
        except msgspec.MsgspecError as error:
            raise VnetError(
                f"{name}: line {number}: {printable(str(error))}: a line of tape.jsonl is needed"
            ) from None
    return entries


def _entry(line: str) -> TapeEntry:
    if '"medium"' in line:
        return msgspec.json.decode(line, type=MediumOrder)
    read = msgspec.json.decode(line, type=_Decision)
    return Deviation(read.node, read.incarnation, read.time_ns, read.decision, read.label, read.first)


def first_left(tape: Sequence[TapeEntry], made: Iterable[TapeEntry]) -> TapeEntry | None:
    """Return the first entry of a tape that a run has not followed: what it has `made` lacks it."""
    done = {_place(entry) for entry in made}
    left = [entry for entry in tape if _place(entry) not in done]
    return min(left, key=lambda entry: entry.time_ns, default=None)


def _place(entry: TapeEntry) -> tuple[object, ...]:
    """Return what names a decision and its outcome."""
    if isinstance(entry, MediumOrder):
        return entry.time_ns, entry.medium
    return entry.time_ns, entry.node, entry.incarnation, entry.decision, entry.label
