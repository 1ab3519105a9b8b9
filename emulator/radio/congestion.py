"""Congestion control: the least time between two frames of a sender, as a function of its channel busy ratio (CBR).

Two algorithms of ETSI TS 102 687 V1.2.1: the reactive approach (a table), and the adaptive approach, which is
LIMERIC (Bansal, Kenney and Rohrs 2013). They act between the frames that programs enqueue and the MAC.
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

MIN_PAUSE_NS = 25 * NS_PER_MS
"""Lower bound of the adaptive approach's pause between two frames (TS 102 687 V1.2.1, 5.4)."""
MAX_PAUSE_NS = 1000 * NS_PER_MS
"""Upper bound of the adaptive approach's pause between two frames (TS 102 687 V1.2.1, 5.4)."""
SLICES = WINDOW_NS // SLICE_NS
"""Slices in one measurement window of the channel busy ratio."""


class CongestionControl(Protocol):
    """Gate between program and MAC. Of the frames of a sender that it holds back, it keeps the newest `waiting`."""

    waiting: int

    def observe(self, number: int, busy_ns: NDArray[np.int64]) -> None:
        """Record that the medium was busy for `busy_ns` (N,) in slice `number` of the run."""

    def next_poll_ns(self, node: int, now_ns: int) -> int:
        """Return `now_ns` if a frame of `node` may go now, else the time at which to ask again."""

    def record_transmission(self, node: int, now_ns: int, airtime_ns: int) -> None:
        """Record that `node` starts to transmit a frame of this airtime."""


def congestion_control_of(
    congestion: EtsiReactive | Limeric | None, count: int, seed: int
) -> CongestionControl | None:
    """Return the congestion control that a scenario configures for `count` senders, or None."""
    match congestion:
        case EtsiReactive():
            return ReactiveControl(congestion, BusyRatioMeter(count, seed))
        case Limeric():
            return LimericControl(congestion, BusyRatioMeter(count, seed))
        case None:
            return None


class BusyRatioMeter:
    """Channel busy ratio at each of `count` senders, in windows whose phase is random for each sender.

    Stations measure asynchronously. If all measured and acted at the same instants, all would pause at once and
    resume at once (Rostami, Cheng, Bansal and Kenney 2016).
    """

    def __init__(self, count: int, seed: int) -> None:
        phase_ns = (Draws(seed, "congestion").uniform(0, 0, count) * WINDOW_NS).astype(np.int64)
        self._phase_ns: list[int] = phase_ns.tolist()
        self._phase = phase_ns // SLICE_NS
        self._last: deque[NDArray[np.int64]] = deque(maxlen=SLICES)
        self._sum_ns = np.zeros(count, np.int64)
        self.busy_ratio = np.zeros(count)
        """Channel busy ratio (N,) of each sender's last complete window."""

    def __len__(self) -> int:
        return len(self._phase_ns)

    def observe(self, number: int, busy_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Add a slice; return a mask (N,) of the senders whose window ends with it."""
        if len(self._last) == SLICES:
            self._sum_ns -= self._last[0]
        self._last.append(busy_ns)
        self._sum_ns += busy_ns
        over = (self._phase == number % SLICES) & (number >= SLICES - 1)
        self.busy_ratio[over] = self._sum_ns[over] / WINDOW_NS
        return np.asarray(over)

    def next_poll_ns(self, node: int, open_ns: int, now_ns: int) -> int:
        """Return the next time to poll: `open_ns`, or the end of the node's next window if that is earlier.

        `open_ns` is when the pause ends at the present busy ratio; a lower one in the next window may shorten it.
        """
        if open_ns <= now_ns:
            return now_ns
        offset_ns = self._phase_ns[node] + SLICE_NS  # by then the window's last slice has ended
        return min(open_ns, ((now_ns - offset_ns) // WINDOW_NS + 1) * WINDOW_NS + offset_ns)


class ReactiveControl:
    """Reactive approach: a state for each sender moves at most one step per window; each state has its pause."""

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

    def record_transmission(self, node: int, now_ns: int, airtime_ns: int) -> None:
        """See `CongestionControl`."""
        self._last_ns[node] = now_ns


class LimericControl:
    """Adaptive approach: every second window each sender's duty cycle moves towards the target busy ratio."""

    def __init__(self, congestion: Limeric, meter: BusyRatioMeter) -> None:
        self.waiting = congestion.waiting
        self._meter = meter
        self._parameters = congestion
        self.share = np.full(len(meter), (congestion.least + congestion.most) / 2)
        """Duty cycle δ (N,): the share of time that each sender may transmit; initially the middle of its range."""
        self._previous_ratio = np.zeros(len(meter))
        self._smoothed_ratio = np.zeros(len(meter))
        self._last: dict[int, tuple[int, int]] = {}

    def observe(self, number: int, busy_ns: NDArray[np.int64]) -> None:
        """See `CongestionControl`."""
        over = self._meter.observe(number, busy_ns)
        if number // SLICES % 2:
            self._adapt(over)
        self._previous_ratio[over] = self._meter.busy_ratio[over]

    def _adapt(self, over: NDArray[np.bool_]) -> None:
        """Apply steps 1 to 5 of TS 102 687 V1.2.1, 5.4, to the senders of the mask `over` (N,)."""
        parameters = self._parameters
        both_ratios = self._previous_ratio[over] + self._meter.busy_ratio[over]
        self._smoothed_ratio[over] = 0.5 * self._smoothed_ratio[over] + 0.25 * both_ratios
        step = parameters.beta * (parameters.target - self._smoothed_ratio[over])
        step = np.clip(step, -parameters.most_down, parameters.most_up)
        share = (1 - parameters.alpha) * self.share[over] + step
        self.share[over] = np.clip(share, parameters.least, parameters.most)

    def next_poll_ns(self, node: int, now_ns: int) -> int:
        """See `CongestionControl`."""
        if node not in self._last:
            return now_ns
        began_ns, airtime_ns = self._last[node]
        pause_ns = min(max(round(airtime_ns / self.share[node]), MIN_PAUSE_NS), MAX_PAUSE_NS)
        return self._meter.next_poll_ns(node, began_ns + pause_ns, now_ns)

    def record_transmission(self, node: int, now_ns: int, airtime_ns: int) -> None:
        """See `CongestionControl`."""
        self._last[node] = now_ns, airtime_ns
