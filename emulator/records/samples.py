"""The messages of Zenoh programs on the radio: their table, and their fate by key.

A message is as many frames as the radio's payload asks for. At a receiver it has arrived if each of them has, and
is lost by the outcome of the first that has not.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa

from emulator.radio.outcomes import Outcome
from emulator.records.recorded_run import OpenedRun
from emulator.records.tables import SAMPLES
from vnet.gateway.frames import (
    CrossingQuery,
    CrossingReply,
    CrossingSample,
    Message,
    Reassembly,
    decode_fragment,
)
from vnet.gateway.ros2 import parse_token, parse_topic

DELIVERED = Outcome.delivered.name
SENDS: dict[str, str] = {"MP": "put", "SC": "query", "SS": "reply"}
"""Kind of message that an endpoint of ROS 2 sends, by the kind in its token."""


class SampleRecorder:
    """Collects the messages of a run's frames. Nodes have the numbers 0 … N-1 in the order of `node_ids`."""

    def __init__(self, node_ids: Sequence[str]) -> None:
        self._node_ids = node_ids
        self._reassembly = Reassembly()
        self._first: dict[int, tuple[int, int]] = {}
        self._rows: list[tuple[int, str, int, int, str, str, int]] = []

    def add(self, time_ns: int, node: int, seq: int, payload: bytes) -> None:
        """Take a frame as it is sent; programs that have the radio's bytes in hand may send what is no message."""
        sender = self._node_ids[node]
        try:
            fragment = decode_fragment(payload)
            if fragment.index == 0:
                self._first[node] = time_ns, seq
            message = self._reassembly.take(sender, payload)
        except (msgspec.MsgspecError, LookupError):
            return
        if message is not None and node in self._first:
            sent_ns, first = self._first.pop(node)
            self._rows.append((sent_ns, sender, first, seq - first + 1, *described(message)))

    def to_table(self) -> pa.Table:
        """Return the rows of `samples.parquet`."""
        columns = zip(*self._rows, strict=True) if self._rows else [()] * len(SAMPLES.columns)
        return pa.table(list(map(list, columns)), schema=SAMPLES.schema)


def described(message: Message) -> tuple[str, str, int]:
    """Return kind, key and payload's bytes of a message; the key of tokens is all of theirs."""
    match message:
        case CrossingSample():
            return ("delete" if message.is_delete else "put"), message.key, len(message.payload)
        case CrossingQuery():
            return "query", message.selector, len(message.payload or b"")
        case CrossingReply(sample=CrossingSample() as sample):
            return "reply", sample.key, len(sample.payload)
        case CrossingReply():
            return "error", f"to query {message.number} of {message.to}", len((message.error or (b"",))[0])
    return "tokens", " ".join(message.keys), 0


@dataclass
class KeyFigures:
    """The messages under one key, and their fate at the receivers in range."""

    key: str
    """The key; topic and type, or the nodes of tokens, where it is one of ROS 2."""
    kind: str
    nodes: set[str] = field(default_factory=set)
    """Vehicle and name of the nodes of ROS 2 whose tokens say that they are its senders."""
    messages: int = 0
    frames: int = 0
    payload_bytes: int = 0
    arrived: int = 0
    """Messages of which every frame has arrived, each receiver counted."""
    lost: Counter[str] = field(default_factory=Counter)
    """Messages that have not, by the outcome of the first frame that was lost."""


def key_figures(recorded: OpenedRun) -> list[KeyFigures]:
    """Return figures by kind and key, the most messages first; none without Zenoh programs."""
    table = recorded.table(SAMPLES)
    if table is None or not len(table):
        return []
    found: dict[tuple[str, str], KeyFigures] = {}
    rows = table.to_pylist()
    nodes = _senders(rows)
    for row in rows:
        row["key"], topic = _named(row["kind"], row["key"])
        figures = found.setdefault((row["kind"], row["key"]), KeyFigures(row["key"], row["kind"]))
        figures.nodes |= nodes.get((row["sender"], row["kind"], topic), set())
        figures.messages += 1
        figures.frames += row["frames"]
        figures.payload_bytes += row["payload_bytes"]
    for sample, outcome in _outcomes(recorded, rows):
        figures = found[rows[sample]["kind"], rows[sample]["key"]]
        if outcome == DELIVERED:
            figures.arrived += 1
        else:
            figures.lost[outcome] += 1
    return sorted(found.values(), key=lambda each: (-each.messages, each.key, each.kind))


def _named(kind: str, key: str) -> tuple[str, str | None]:
    """Return a key in words, and the topic or service of ROS 2 that it is of."""
    if kind == "tokens":
        tokens = [parse_token(each) for each in key.split()]
        named = sorted({token.node_name for token in tokens if token is not None})
        return (", ".join(named) if named and None not in tokens else key), None
    topic = parse_topic(key.partition("?")[0])
    if topic is None:
        return key, None
    domain = f" in domain {topic.domain}" if topic.domain else ""
    below = ", @adv" if "/@adv/" in key else ""
    return f"{topic.topic} {topic.type}{domain}{below}", topic.topic


def _senders(rows: Sequence[dict[str, Any]]) -> dict[tuple[str, str, str | None], set[str]]:
    """Return the nodes of ROS 2 by vehicle, kind of message and topic, as their tokens tell."""
    found: dict[tuple[str, str, str | None], set[str]] = {}
    for sender, keys in {(row["sender"], row["key"]) for row in rows if row["kind"] == "tokens"}:
        for token in map(parse_token, keys.split()):
            if token is not None and token.endpoint is not None and token.kind in SENDS:
                place = sender, SENDS[token.kind], token.endpoint.topic
                found.setdefault(place, set()).add(f"{sender} {token.node_name}")
    return found


def _outcomes(recorded: OpenedRun, rows: Sequence[dict[str, object]]) -> Iterator[tuple[int, str]]:
    """Yield the number of a message and what became of it, for each receiver in range of its first frame."""
    sample_of = {
        (recorded.number[str(row["sender"])], int(str(row["seq"])) + offset): number
        for number, row in enumerate(rows)
        for offset in range(int(str(row["frames"])))
    }
    # Of a frame to one vehicle any attempt may arrive.
    kept = np.flatnonzero((recorded.copy == 0) | (recorded.attempt > 0))
    by = (recorded.sender, recorded.receiver, recorded.seq)
    kept = kept[np.lexsort([each[kept] for each in (recorded.copy, *reversed(by))])]
    outcomes = recorded.trace["outcome"].cast(pa.string()).take(pa.array(kept)).to_pylist()
    fates: dict[tuple[int, int, int], str] = {}
    for frame, outcome in zip(zip(*(each[kept].tolist() for each in by), strict=True), outcomes, strict=True):
        if frame[::2] in sample_of and fates.get(frame) != DELIVERED:
            fates[frame] = outcome
    worst: dict[tuple[int, int], str] = {}
    for (sender, receiver, seq), outcome in fates.items():
        if worst.get(pair := (sample_of[sender, seq], receiver), DELIVERED) == DELIVERED:
            worst[pair] = outcome
    for (number, _), outcome in worst.items():
        yield number, outcome
