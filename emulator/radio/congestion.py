"""Congestion control: how long a sender must pause between its frames, by how busy it finds the channel.

Both are those of ETSI TS 102 687 V1.2.1: the reactive one of its table, and the adaptive one, which is LIMERIC
(Bansal, Kenney and Rohrs 2013). They act between what programs hand over and the access to the medium.
"""

from __future__ import annotations

from collections import deque
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from emulator.radio.medium import SLICE_NS, WINDOW_NS
from emulator.scenario.radio import EtsiReactive, Limeric
from emulator.scenario.random_streams import Draws
from vnet.units import NS_PER_MS

LEAST_PAUSE_NS, MOST_PAUSE_NS = 25 * NS_PER_MS, 1000 * NS_PER_MS
"""Of the adaptive approach (TS 102 687 V1.2.1, 5.4)."""


SLICES = WINDOW_NS // SLICE_NS


class CongestionControl(Protocol):
    """Lets frames of each sender through, or holds them back. `waiting` frames of each may wait, the newest."""

    waiting: int

    def observe(self, number: int, busy_ns: NDArray[np.int64]) -> None:
        """The medium was busy for so long (N,) in slice `number` of the time."""

    def next_poll_ns(self, node: int, now_ns: int) -> int:
        """`now_ns` if a frame of `node` may go; else when to ask again."""

    def sends(self, node: int, now_ns: int, airtime_ns: int) -> None:
        """A frame of `node` goes on air for so long."""


def congestion_control_of(
    congestion: EtsiReactive | Limeric | None, count: int, seed: int
) -> CongestionControl | None:
    """The gate that a scenario chooses, for `count` senders."""
    match congestion:
        case EtsiReactive():
            return ReactiveControl(congestion, BusyRatioMeter(count, seed))
        case Limeric():
            return LimericControl(congestion, BusyRatioMeter(count, seed))
        case None:
            return None


class BusyRatioMeter:
    """How busy each of `count` senders finds the medium, in windows that begin at an instant of its own.

    Stations measure each on its own clock. If all measured and acted at once, all would hold back at once, and
    come again at once (Rostami, Cheng, Bansal and Kenney 2016).
    """

    def __init__(self, count: int, seed: int) -> None:
        phase_ns = (Draws(seed, "congestion").uniform(0, 0, count) * WINDOW_NS).astype(np.int64)
        self._phase_ns: list[int] = phase_ns.tolist()
        self._phase = phase_ns // SLICE_NS
        self._last: deque[NDArray[np.int64]] = deque(maxlen=SLICES)
        self._sum_ns = np.zeros(count, np.int64)
        self.busy_ratio = np.zeros(count)
        """(N,) of the last window of each."""

    def __len__(self) -> int:
        return len(self._phase_ns)

    def observe(self, number: int, busy_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Take one more slice; returns whose window is over with it."""
        if len(self._last) == SLICES:
            self._sum_ns -= self._last[0]
        self._last.append(busy_ns)
        self._sum_ns += busy_ns
        over = (self._phase == number % SLICES) & (number >= SLICES - 1)
        self.busy_ratio[over] = self._sum_ns[over] / WINDOW_NS
        return np.asarray(over)

    def next_poll_ns(self, node: int, open_ns: int, now_ns: int) -> int:
        """When to ask if the gate opens at `open_ns` as things stand: after the next window they may be better."""
        if open_ns <= now_ns:
            return now_ns
        look_ns = self._phase_ns[node] + SLICE_NS  # the slice is over for sure
        return min(open_ns, ((now_ns - look_ns) // WINDOW_NS + 1) * WINDOW_NS + look_ns)


class ReactiveControl:
    """A state for each sender, which goes one up or down with each window; each state has its pause."""

    def __init__(self, congestion: EtsiReactive, meter: BusyRatioMeter) -> None:
        self.waiting = congestion.waiting
        self._meter = meter
        self._busy = np.array(congestion.busy)
        self._pause_ns = [round(pause_ms * NS_PER_MS) for pause_ms in congestion.pause_ms]
        self._state = np.zeros(len(meter), np.int64)
        self._last_ns: dict[int, int] = {}

    def observe(self, number: int, busy_ns: NDArray[np.int64]) -> None:
        """See `CongestionControl`."""
        over = self._meter.observe(number, busy_ns)
        wanted = np.searchsorted(self._busy, self._meter.busy_ratio[over], side="right")
        self._state[over] += np.sign(wanted - self._state[over])

    def next_poll_ns(self, node: int, now_ns: int) -> int:
        """See `CongestionControl`."""
        if node not in self._last_ns:
            return now_ns
        open_ns = self._last_ns[node] + self._pause_ns[int(self._state[node])]
        return self._meter.next_poll_ns(node, open_ns, now_ns)

    def sends(self, node: int, now_ns: int, airtime_ns: int) -> None:
        """See `CongestionControl`."""
        self._last_ns[node] = now_ns


class LimericControl:
    """Each sender's share of the time, which every second window moves towards one that fits the target."""

    def __init__(self, congestion: Limeric, meter: BusyRatioMeter) -> None:
        self.waiting = congestion.waiting
        self._meter = meter
        self._parameters = congestion
        self.share = np.full(len(meter), (congestion.least + congestion.most) / 2)
        """(N,), the part of the time that each may send; at first half of the most."""
        self._before = np.zeros(len(meter))
        self._smooth = np.zeros(len(meter))
        self._last: dict[int, tuple[int, int]] = {}

    def observe(self, number: int, busy_ns: NDArray[np.int64]) -> None:
        """See `CongestionControl`."""
        over = self._meter.observe(number, busy_ns)
        if number // SLICES % 2:
            self._adapt(over)
        self._before[over] = self._meter.busy_ratio[over]

    def _adapt(self, over: NDArray[np.bool_]) -> None:
        """Steps 1 to 5 of TS 102 687 V1.2.1, 5.4, for some of the senders."""
        parameters = self._parameters
        self._smooth[over] = 0.5 * self._smooth[over] + 0.25 * (self._before[over] + self._meter.busy_ratio[over])
        step = parameters.beta * (parameters.target - self._smooth[over])
        step = np.clip(step, -parameters.most_down, parameters.most_up)
        share = (1 - parameters.alpha) * self.share[over] + step
        self.share[over] = np.clip(share, parameters.least, parameters.most)

    def next_poll_ns(self, node: int, now_ns: int) -> int:
        """See `CongestionControl`."""
        if node not in self._last:
            return now_ns
        began_ns, airtime_ns = self._last[node]
        pause_ns = min(max(round(airtime_ns / self.share[node]), LEAST_PAUSE_NS), MOST_PAUSE_NS)
        return self._meter.next_poll_ns(node, began_ns + pause_ns, now_ns)

    def sends(self, node: int, now_ns: int, airtime_ns: int) -> None:
        """See `CongestionControl`."""
        self._last[node] = now_ns, airtime_ns
