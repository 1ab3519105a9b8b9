"""Congestion control: how long a sender must pause between its frames, by how busy it finds the channel.

Both are those of ETSI TS 102 687 V1.2.1: the reactive one of its table, and the adaptive one, which is LIMERIC
(Bansal, Kenney and Rohrs 2013). They act between what programs hand over and the access to the medium.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from emulator.channel.frames import NS_PER_MS
from emulator.channel.medium import WINDOW_NS
from vnet.radio import EtsiReactive, Limeric
from vnet.roads.lanes import Array

LEAST_PAUSE_NS, MOST_PAUSE_NS = 25 * NS_PER_MS, 1000 * NS_PER_MS
"""Of the adaptive approach (TS 102 687 V1.2.1, 5.4)."""


class Gate(Protocol):
    """Lets frames of each sender through, or holds them back. `waiting` frames of each may wait, the newest."""

    waiting: int

    def ask_ns(self, node: int, now_ns: int, windows: Sequence[Array]) -> int:
        """`now_ns` if a frame of `node` may go; else when to ask again. `windows` are all busy ratios so far."""

    def sends(self, node: int, now_ns: int, airtime_ns: int) -> None:
        """A frame of `node` goes on air for so long."""


def gate_of(congestion: EtsiReactive | Limeric | None, count: int) -> Gate | None:
    """The gate that a scenario chooses, for `count` senders."""
    match congestion:
        case EtsiReactive():
            return ReactiveGate(congestion, count)
        case Limeric():
            return LimericGate(congestion, count)
        case None:
            return None


def _next_ask_ns(open_ns: int, now_ns: int) -> int:
    """When to ask again if it opens at `open_ns` as things stand: with the next busy ratio they may be better."""
    return now_ns if open_ns <= now_ns else min(open_ns, (now_ns // WINDOW_NS + 1) * WINDOW_NS)


class ReactiveGate:
    """A state for each sender, which goes one up or down with each window; each state has its pause."""

    def __init__(self, congestion: EtsiReactive, count: int) -> None:
        self.waiting = congestion.waiting
        self._busy = np.array(congestion.busy)
        self._pause_ns = [round(pause_ms * NS_PER_MS) for pause_ms in congestion.pause_ms]
        self._state = np.zeros(count, np.int64)
        self._seen = 0
        self._last_ns: dict[int, int] = {}

    def ask_ns(self, node: int, now_ns: int, windows: Sequence[Array]) -> int:
        """See `Gate`."""
        for busy in windows[self._seen :]:
            self._state += np.sign(np.searchsorted(self._busy, busy, side="right") - self._state)
        self._seen = len(windows)
        if node not in self._last_ns:
            return now_ns
        return _next_ask_ns(self._last_ns[node] + self._pause_ns[int(self._state[node])], now_ns)

    def sends(self, node: int, now_ns: int, airtime_ns: int) -> None:
        """See `Gate`."""
        self._last_ns[node] = now_ns


class LimericGate:
    """Each sender's share of the time, which every second window moves towards one that fits the target."""

    def __init__(self, congestion: Limeric, count: int) -> None:
        self.waiting = congestion.waiting
        self._parameters = congestion
        self.share = np.full(count, (congestion.least + congestion.most) / 2)
        """(N,), the part of the time that each may send; at first half of the most."""
        self._busy = np.zeros(count)
        self._seen = 0
        self._last: dict[int, tuple[int, int]] = {}

    def ask_ns(self, node: int, now_ns: int, windows: Sequence[Array]) -> int:
        """See `Gate`."""
        while len(windows) - self._seen >= 2:
            self._adapt(windows[self._seen], windows[self._seen + 1])
            self._seen += 2
        if node not in self._last:
            return now_ns
        began_ns, airtime_ns = self._last[node]
        pause_ns = min(max(round(airtime_ns / self.share[node]), LEAST_PAUSE_NS), MOST_PAUSE_NS)
        return _next_ask_ns(began_ns + pause_ns, now_ns)

    def _adapt(self, first: Array, second: Array) -> None:
        parameters = self._parameters
        self._busy = 0.5 * self._busy + 0.25 * (first + second)
        step = parameters.beta * (parameters.target - self._busy)
        share = (1 - parameters.alpha) * self.share + np.clip(step, -parameters.most_down, parameters.most_up)
        self.share = np.clip(share, parameters.least, parameters.most)

    def sends(self, node: int, now_ns: int, airtime_ns: int) -> None:
        """See `Gate`."""
        self._last[node] = now_ns, airtime_ns
