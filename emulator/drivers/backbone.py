"""The backbone of a run: messages of roadside units to each other, over a wire.

It is no radio: a message reaches its receivers after `backbone.latency_ms`, wherever they stand, and messages
between two units keep their order. Draws are keyed by seed, sender and number of the message, so they depend on
nothing else that happens.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from heapq import heappop, heappush
from itertools import count
from typing import NamedTuple

import pyarrow as pa

from emulator.radio.engine import Engine
from emulator.radio.trace import payload_digest
from emulator.records.tables import BackboneRow, backbone_table
from emulator.scenario.program import Backbone
from emulator.scenario.random_streams import Draws
from emulator.scenario.scenario import Scenario
from vnet.radio import UnitAbilities
from vnet.runtime.arrivals import NewsItem
from vnet.transport.wire import MessageRef, SentMessage, WireMessage, WireSendResult, sent_in_full
from vnet.units import NS_PER_MS


class _Sent(NamedTuple):
    """A message on its way to one unit, in the order of arrivals."""

    arrival_ns: int
    sender: int
    number: int
    receiver: int
    sent_ns: int
    payload: bytes


class BackboneNetwork:
    """The messages of a run. `up` says which nodes are up."""

    def __init__(self, scenario: Scenario, up: Mapping[str, bool]) -> None:
        self._units = scenario.roadside
        self._names = [unit.name for unit in self._units]
        self._section = scenario.backbone or Backbone()
        self._up = up
        self._draws = Draws(scenario.run.seed, "backbone")
        self._next = [0] * len(self._units)
        self._last_ns: dict[tuple[int, int], int] = {}
        """The latest arrival so far, by sender and receiver."""
        self._unseen: list[_Sent] = []
        """Heap of the messages that no process has been shown."""
        self._undecided: list[_Sent] = []
        """Heap of the messages of which it is open whether their receivers are up when they arrive."""
        self._rows: list[BackboneRow] = []
        self._numbers = count()
        """Numbers of arrivals, of which no two are equal: a process knows them by these."""

    def abilities(self, node: str) -> UnitAbilities | None:
        """Return what a unit knows of itself; None for a vehicle."""
        if node not in self._names:
            return None
        unit = self._units[self._names.index(node)]
        peers = [name for name in self._names if name != node]
        return UnitAbilities(unit.position_m, peers, self._section.max_message_bytes)

    def send(self, time_ns: int, messages: Sequence[MessageRef]) -> None:
        """Take what units that are up send at `time_ns`; what claims to be of others is dropped."""
        for message in sent_in_full(messages):
            fits = len(message.payload) <= self._section.max_message_bytes
            if message.node in self._names and fits and self._up[message.node]:
                self._send(time_ns, self._names.index(message.node), message)

    def _send(self, time_ns: int, sender: int, message: SentMessage) -> None:
        number, self._next[sender] = self._next[sender], self._next[sender] + 1
        drawn = self._draws.uniform(sender, number, 2 * len(self._units)).tolist()
        for receiver, name in enumerate(self._names):
            if receiver == sender or message.to not in (None, name):
                continue
            wait_ms = self._section.latency_ms + self._section.jitter_ms * drawn[2 * receiver]
            arrival_ns = time_ns + max(round(wait_ms * NS_PER_MS), 1)
            arrival_ns = max(arrival_ns, self._last_ns.get((sender, receiver), 0))
            sent = _Sent(arrival_ns, sender, number, receiver, time_ns, message.payload)
            if drawn[2 * receiver + 1] < self._section.loss:
                self._rows.append(self._row(sent, "loss"))
                continue
            self._last_ns[sender, receiver] = arrival_ns
            heappush(self._unseen, sent)
            heappush(self._undecided, sent)

    def next_ns(self) -> int | None:
        """Return the next arrival that no process has been shown, or None."""
        return self._unseen[0].arrival_ns if self._unseen else None

    def take(self, time_ns: int) -> list[WireMessage]:
        """Return the arrivals up to `time_ns` that no process has been shown, in order."""
        taken = []
        while self._unseen and self._unseen[0].arrival_ns <= time_ns:
            sent = heappop(self._unseen)
            receiver, sender = self._names[sent.receiver], self._names[sent.sender]
            number = next(self._numbers)
            taken.append(WireMessage(receiver, number, sender, sent.sent_ns, sent.arrival_ns, sent.payload))
        return taken

    def decide(self, time_ns: int) -> None:
        """Record the arrivals up to `time_ns`: who is up now was so when they came."""
        while self._undecided and self._undecided[0].arrival_ns <= time_ns:
            sent = heappop(self._undecided)
            is_up = self._up[self._names[sent.receiver]]
            self._rows.append(self._row(sent, "delivered" if is_up else "receiver_down"))

    def _row(self, sent: _Sent, outcome: str) -> BackboneRow:
        sender, receiver = self._names[sent.sender], self._names[sent.receiver]
        digest = payload_digest(sent.payload)
        arrival_ns = None if outcome == "loss" else sent.arrival_ns
        size = len(sent.payload)
        return BackboneRow(sent.sent_ns, sender, sent.number, receiver, size, digest, arrival_ns, outcome)

    def table(self) -> pa.Table | None:
        """Return a row for each message and receiver, in the order of sending; None without roadside units."""
        if not self._units:
            return None
        under_way = [self._row(sent, "in_flight") for sent in self._undecided]
        return backbone_table([*self._rows, *under_way])


class NewsFeed:
    """Results of frames to single nodes and messages of the backbone that nodes have yet to be granted.

    `up` says which of the nodes, in the engine's order, are up.
    """

    def __init__(self, engine: Engine, backbone: BackboneNetwork, up: Mapping[str, bool]) -> None:
        self._engine, self._backbone, self._up = engine, backbone, up
        self._node_ids = list(up)
        self._waiting: dict[str, list[NewsItem]] = {}

    def next_ns(self) -> int | None:
        """Return the time of the next result or message that has not been shown, or None."""
        times_ns = self._engine.next_result_ns(), self._backbone.next_ns()
        return min((time_ns for time_ns in times_ns if time_ns is not None), default=None)

    def show(self, time_ns: int) -> None:
        """Put what comes up to `time_ns` where its processes will find it."""
        for result in self._engine.take_results(time_ns):
            node = self._node_ids[result.sender]
            shown = WireSendResult(node, result.number, result.time_ns, result.delivered, result.attempts)
            self._waiting.setdefault(node, []).append(shown)
        for message in self._backbone.take(time_ns):
            if self._up[message.node]:
                self._waiting.setdefault(message.node, []).append(message)

    def repeat(self, news: Iterable[NewsItem]) -> None:
        """Put what a process has missed where it will find it again."""
        for item in news:
            self._waiting.setdefault(item.node, []).append(item)

    def firsts(self) -> Iterator[tuple[str, int]]:
        """Yield each node for which something has come, and the time in ns of the first."""
        for node, arrivals in self._waiting.items():
            yield node, min(arrival.time_ns for arrival in arrivals)

    def take(self, nodes: Iterable[str]) -> tuple[list[WireSendResult], list[WireMessage]]:
        """Remove and return the results and the messages of these nodes."""
        if not self._waiting:
            return [], []
        taken = [arrival for node in nodes for arrival in self._waiting.pop(node, ())]
        results = [arrival for arrival in taken if isinstance(arrival, WireSendResult)]
        return results, [arrival for arrival in taken if isinstance(arrival, WireMessage)]
