"""CSMA/CA: channel access of senders that share one medium (EDCA of 802.11p).

**Events inside the engine.** The end of a frame, and the receivers that it reaches, depend on what others transmit
before that. So this module has events of its own, at which no program runs: a frame is ready, a backoff ends, a
frame ends. One heap orders them by time, then by kind, then by the sender's number, and never by the order of
insertion. Three rules make the result depend only on which frames were enqueued at which time:

1. `run(t)` processes the events strictly before t. A program that runs at t may enqueue a frame at t, in whatever
   order programs run; the events at t are processed only after all of them have.
2. A frame enqueued at t causes events at t or later, and no arrival earlier than a microsecond after a frame's end.
   So the arrivals at t are known once all events before t are processed, and a frame enqueued at t cannot change
   them.
3. A frame keeps the state of the network at the time it was enqueued (`TopologySnapshot`, `LinkEffects`), and its
   draws depend on the frame alone. So drivers may move vehicles at any of their calls, as long as it is after the
   frames sent before the move are enqueued, and before those sent after it.

Lockstep asks for the next arrival that wakes a program. `Engine.look_ahead` therefore processes events up to the
earliest time at which a program runs for another reason, but not beyond the first arrival at a node that waits.

**The access rules** are those of 802.11-2020, 10.23.2. A frame that is ready while the medium is idle is
transmitted at the next slot boundary, counted from AIFS after the medium became idle. A frame that finds the medium
busy draws a backoff, and so does every sender after each of its frames. A backoff counts down by one for each slot
that begins idle, and is frozen while the medium is busy. A busy medium is detected after 4 µs: senders that start
within this time collide.

**Frames to one vehicle** (`unicast`) are acknowledged, and transmitted again. Those who can read one keep silent
until its acknowledgement has ended (NAV); those who cannot wait for EIFS. What happens to such a frame is therefore
decided as it ends, and not when somebody asks.

**Congestion control** is the least time between two frames of a sender, as a function of its channel busy ratio.
Two algorithms of ETSI TS 102 687 V1.2.1 act between the frames that programs enqueue and the MAC: the reactive
approach (a table), and the adaptive approach, which is LIMERIC (Bansal, Kenney and Rohrs 2013).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from emulator.radio.dot11p import AIFSN_AND_CW, DETECTION_NS, MAX_WINDOW, SIFS_NS, SLOT_NS, airtime_ns
from emulator.radio.frames import BROADCAST, CopyNumbers, Receptions, Transmission
from emulator.radio.mac import ThrottledMac
from emulator.radio.medium import SLICE_NS, WINDOW_NS, Medium
from emulator.radio.outcomes import Outcome
from emulator.radio.reception import BACKOFF, JITTER, NEXT_BACKOFF, Signals, Threshold, milliwatts, sender_draw
from emulator.radio.topology import Topology
from emulator.radio.trace import Trace
from emulator.radio.unicast import (
    ACK_BYTES,
    ACK_TIMEOUT_NS,
    MOST_ATTEMPTS,
    Deferral,
    Unicasts,
    acknowledgement_of,
    address,
    retry_of,
)
from emulator.scenario.radio import CrLimit, Edca, EtsiReactive, Limeric, Receiver
from emulator.scenario.random_streams import Draws
from emulator.scenario.scenario import Radio, least_latency_ns
from vnet.types import Array
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
    congestion: EtsiReactive | Limeric | CrLimit | None, count: int, seed: int
) -> CongestionControl | None:
    """Return the congestion control that a scenario configures for `count` senders, or None."""
    match congestion:
        case EtsiReactive():
            return ReactiveControl(congestion, BusyRatioMeter(count, seed))
        case Limeric():
            return LimericControl(congestion, BusyRatioMeter(count, seed))
        case _:
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


HEARD, ACK_HEARD, END, ACK_END, ACK_TIMEOUT, READY, SLOWLY_READY, ACCESS, ACK_BEGIN = range(9)
"""Kinds of events, in the order in which those of one time are processed: what has ended is heard at once."""

_Event = tuple[int, int, int, int, Transmission | None]
"""An event: its time in ns, kind, sender, number among the sender's events, and transmission."""


@dataclass(slots=True, eq=False)
class _Station:
    """A sender: its waiting frames and the state of its backoff.

    `queue` holds the frames that are ready, `coming` counts those that will be; `ready_ns` is when the last of them
    is. `held` is true while congestion control holds them back; it is polled next at `next_poll_ns`. `contends` is
    true while a frame waits for nothing but the medium. `slots` remain of the backoff, which counts from `from_ns`
    while the medium is idle and is frozen while it is `busy` at this sender. `planned` counts the planned events;
    of the planned accesses only the one numbered `access` is valid. `awaiting` is the frame for whose
    acknowledgement it waits, `acking` the one that it acknowledges.
    """

    node: int
    queue: deque[Transmission] = field(default_factory=deque)
    coming: int = 0
    ready_ns: int = 0
    held: bool = False
    next_poll_ns: int = -1
    on_air: bool = False
    contends: bool = False
    slots: int = 0
    from_ns: int = 0
    busy: bool = False
    planned: int = 0
    access: int = 0
    awaiting: Transmission | None = None
    acking: Transmission | None = None

    @property
    def access_ns(self) -> int:
        """Time in ns at which the backoff ends if the medium stays idle."""
        return self.from_ns + self.slots * SLOT_NS


class EdcaParameters(NamedTuple):
    """Parameters of an access category: the interframe space AIFS in ns, and the largest backoff in slots.

    `max_window` is the largest backoff of a frame that is transmitted again.
    """

    aifs_ns: int
    window: int
    max_window: int

    def window_after(self, attempts: int) -> int:
        """Return the largest backoff in slots after so many attempts without an acknowledgement."""
        return min((self.window + 1 << attempts) - 1, self.max_window)


def edca_parameters(mac: Edca) -> EdcaParameters:
    """Return the parameters of the access category that a scenario configures."""
    aifsn, window = AIFSN_AND_CW[mac.access_category]
    return EdcaParameters(SIFS_NS + aifsn * SLOT_NS, window, MAX_WINDOW[mac.access_category])


class Csma(ThrottledMac):
    """MAC of `count` vehicles that share one medium; see the module's docstring.

    It asks the `topology` who is up, notes acknowledgements in the `trace`, numbers retries among `copies`, and
    tells `unicasts` what became of frames to single vehicles.
    """

    shares_medium = True
    acknowledges = True

    def __init__(
        self,
        radio: Radio,
        signals: Signals,
        topology: Topology,
        trace: Trace,
        copies: CopyNumbers,
        unicasts: Unicasts,
        seed: int,
    ) -> None:
        super().__init__()
        mac = radio.mac
        assert isinstance(mac, Edca)
        self._edca = edca_parameters(mac)
        self._aifs_ns = self._edca.aifs_ns
        self._has_eifs = mac.eifs  # after broadcasts, too
        self._count = signals.count
        self._deferral = Deferral(self._count) if mac.eifs else None
        self._unicasts = unicasts
        self._signals = signals
        self._topology = topology
        self._trace = trace
        self._copies = copies
        self._jitter_ns = radio.access_jitter_ms * NS_PER_MS
        self._limit = radio.queue_frames
        threshold = Threshold(radio.receiver or Receiver())
        remembered_ns = 2 * least_latency_ns(radio) + 2 * WINDOW_NS  # what programs may ask for, and more
        self._congestion = congestion_control_of(radio.congestion, self._count, seed)
        listener = self._congestion.observe if self._congestion is not None else None
        carrier_sense_mw = milliwatts(mac.carrier_sense_dbm)
        self._medium = Medium(self._count, carrier_sense_mw, threshold, remembered_ns, listener)
        self._events: list[_Event] = []
        self._stations: dict[int, _Station] = {}
        self._counting: dict[int, _Station] = {}
        """Stations that count down or hold a backoff."""
        self._now_ns = 0
        self._ended_ack: Transmission | None = None

    def _take(self, sent: Transmission) -> None:
        frame = sent.frame
        station = self._station(frame.sender)
        if sent.attempt and self._deferral is None:
            self._deferral = Deferral(self._count)
        sent.signal = self._signals.of(frame)
        ready_ns = frame.sent_ns
        if self._jitter_ns:
            ready_ns += int(self._jitter_ns * sender_draw(sent, JITTER))
        if self._slows(frame.sender):
            slow_ns = self._put_slowly(frame, ready_ns, self._limit)
            if slow_ns is None:
                self._leave(sent, Outcome.queue_full, frame.sent_ns)
            else:
                self._plan(slow_ns, SLOWLY_READY, station, sent)
        elif self._is_full(station):
            self._leave(sent, Outcome.queue_full, frame.sent_ns)
        else:
            station.ready_ns = max(ready_ns, station.ready_ns)
            if station.ready_ns == frame.sent_ns and self._is_quiet(frame.sent_ns):
                self._ready(station, sent, frame.sent_ns)
            else:
                station.coming += 1
                self._plan(station.ready_ns, READY, station, sent)

    def _station(self, node: int) -> _Station:
        station = self._stations.get(node)
        if station is None:
            station = self._stations[node] = _Station(node)
        return station

    def _is_full(self, station: _Station) -> bool:
        return station.coming + len(station.queue) >= self._limit

    def _is_quiet(self, time_ns: int) -> bool:
        """Return true if no event has to be processed before a frame that is ready at `time_ns`.

        No frame goes on air at the time at which it is ready, so frames that are ready at one time do not interact.
        """
        return self._now_ns <= time_ns and (not self._events or self._events[0][:2] > (time_ns, READY))

    def _leave(self, sent: Transmission, sender_outcome: Outcome, time_ns: int) -> None:
        sent.sender_outcome, sent.end_ns = sender_outcome, time_ns
        self.sent.append(sent)

    def _plan(self, time_ns: int, kind: int, station: _Station, sent: Transmission | None = None) -> None:
        station.planned += 1
        if kind == ACCESS:
            station.access = station.planned
        if time_ns < self._now_ns:  # in real time a frame may reach the emulator a little after its time
            time_ns = self._now_ns
        heappush(self._events, (time_ns, kind, station.node, station.planned, sent))

    def next_ns(self) -> int | None:
        """Return the time of the next event, or None."""
        return self._events[0][0] if self._events else None

    def run(self, time_ns: int | None) -> Transmission | None:
        """Process all events before `time_ns`, or all if it is None; stop after one that `judge` must hear of."""
        events = self._events
        while events and (time_ns is None or events[0][0] < time_ns):
            if (ended := self.step()) is not None:
                return ended
        if time_ns is not None and time_ns > self._now_ns:
            self._now_ns = time_ns
        return None

    def step(self) -> Transmission | None:
        """Process the next event; return the transmission that it ends, if the events after it depend on it."""
        now_ns, kind, node, plan, sent = heappop(self._events)
        self._now_ns = now_ns
        station = self._stations[node]
        if kind == ACCESS:
            if station.access == plan:
                self._begin(station, now_ns)
        elif kind == READY:
            station.coming -= sent is not None
            self._ready(station, sent, now_ns)
        else:
            assert sent is not None
            if kind == END:
                return self._end(station, sent, now_ns)
            if kind == ACK_END:
                return self._end_ack(station, sent, now_ns)
            self._process(kind, station, sent, now_ns)
        return None

    def _process(self, kind: int, station: _Station, sent: Transmission, now_ns: int) -> None:
        if kind == HEARD:
            self._hear(sent, now_ns)
            self._after(station, sent, now_ns)
        elif kind == ACK_HEARD:
            self._hear_ack(sent, now_ns)
        elif kind == ACK_BEGIN:
            if self._topology.is_up(station.node) and not station.on_air and station.acking is None:
                self._begin_ack(station, sent, now_ns)
        elif kind == ACK_TIMEOUT:
            if station.awaiting is sent and not self._is_hearing_ack(station, sent):
                self._conclude(station, sent, now_ns)
        elif self._is_full(station):  # a throttled sender's frame
            self._leave(sent, Outcome.queue_full, now_ns)
        else:
            self._ready(station, sent, now_ns)

    def _ready(self, station: _Station, sent: Transmission | None, now_ns: int) -> None:
        """Process a frame that is ready, or (None) poll the sender's congestion control again."""
        if sent is not None:
            station.queue.append(sent)
        if station.queue and not station.contends and not station.on_air and station.awaiting is None:
            self._contend(station, now_ns)

    def _passes_congestion_control(self, station: _Station, congestion: CongestionControl, now_ns: int) -> bool:
        """Return true if congestion control lets a station's next frame go; drop the frames beyond `waiting`.

        A frame that was held back waits for its access jitter before it reaches the MAC, like any other. Otherwise
        frames that collided once would be ready, after equal pauses, at the same time again.
        """
        self._medium.count(now_ns)
        next_poll_ns = congestion.next_poll_ns(station.node, now_ns)
        if next_poll_ns <= now_ns:
            held, station.held = station.held, False
            jitter_ns = int(self._jitter_ns * sender_draw(station.queue[0], JITTER))
            if held and jitter_ns:
                self._plan(now_ns + jitter_ns, READY, station)
                return False
            return True
        if next_poll_ns != station.next_poll_ns:
            station.next_poll_ns = next_poll_ns
            self._plan(next_poll_ns, READY, station)
        station.held = True
        while len(station.queue) > congestion.waiting:
            self._leave(station.queue.popleft(), Outcome.held_back, now_ns)
        return False

    def _contend(self, station: _Station, now_ns: int) -> None:
        """Plan the transmission of a station's first frame as early as the access rules allow."""
        congestion = self._congestion
        is_retry = station.queue[0].attempt > 1
        if not (congestion is None or is_retry or self._passes_congestion_control(station, congestion, now_ns)):
            return
        station.contends = True
        node = station.node
        if node in self._counting and (station.busy or station.access_ns > now_ns):
            if not station.busy:
                self._plan(station.access_ns, ACCESS, station)
            return
        self._counting[node] = station
        station.slots = 0
        station.busy = self._medium.is_sensed(node)
        noticed_ns = self._medium.busy_ns(node) + DETECTION_NS
        if station.busy and noticed_ns <= now_ns:
            station.slots = self._draw(station.queue[0], BACKOFF)
            return
        free_ns = self._free_ns(node, int(self._medium.idle_ns[node]))
        if self._deferral is not None and not station.busy and self._deferral.reserved_ns(node) > now_ns:
            station.slots, station.from_ns = self._draw(station.queue[0], BACKOFF), free_ns
            self._plan(station.access_ns, ACCESS, station)
            return
        station.from_ns = free_ns + SLOT_NS * max(0, (now_ns - free_ns) // SLOT_NS + 1)
        if not station.busy or station.from_ns < noticed_ns:
            self._plan(station.from_ns, ACCESS, station)

    def _draw(self, sent: Transmission, which: int, attempts: int = 0) -> int:
        return int(sender_draw(sent, which) * (self._edca.window_after(attempts) + 1))

    def _free_ns(self, node: int, idle_ns: int) -> int:
        """Return when AIFS is over at a vehicle whose medium is idle since `idle_ns`."""
        return (idle_ns if self._deferral is None else self._deferral.until_ns(node, idle_ns)) + self._aifs_ns

    def _begin(self, station: _Station, now_ns: int) -> None:
        """Start to transmit a station's first frame."""
        if station.acking is not None:  # which it does not sense: its own transmission ends before it counts on
            station.slots, station.busy, station.access = 0, True, 0
            return
        sent = station.queue.popleft()
        station.contends, station.on_air = False, True
        self._counting.pop(station.node, None)
        sent.on_air_ns = now_ns
        airtime = airtime_ns(sent.frame.size_bytes, sent.frame.bitrate_mbps)
        if self._congestion is not None:
            self._congestion.record_transmission(station.node, now_ns, airtime)
        self._medium.begin(sent, now_ns)
        self._plan(now_ns + airtime, END, station, sent)
        self._update_backoffs(now_ns)

    def _end(self, station: _Station, sent: Transmission, now_ns: int) -> Transmission | None:
        """End a transmission; return it if who could read it decides what comes next."""
        station.on_air = False
        self._medium.end(sent, now_ns)
        self._leave(sent, Outcome.pending, now_ns)
        if sent.attempt or self._has_eifs:
            self._plan(now_ns, HEARD, station, sent)
            return sent
        self._after(station, sent, now_ns)
        return None

    def _after(self, station: _Station, sent: Transmission, now_ns: int) -> None:
        """Have a sender draw a backoff before its next frame, or wait for an acknowledgement."""
        if not sent.attempt:
            self._back_off(station, sent, now_ns)
            return
        station.awaiting = sent
        if sent.decoded is not None and sent.decoded[sent.frame.to]:
            self._plan(now_ns + SIFS_NS, ACK_BEGIN, self._station(sent.frame.to), sent)
        self._plan(now_ns + ACK_TIMEOUT_NS, ACK_TIMEOUT, station, sent)
        self._update_backoffs(now_ns)

    def judge(self, transmissions: Sequence[Transmission], receptions: Receptions) -> None:
        """Note who could read frames where others act on it, and what becomes of those to single vehicles."""
        for index, sent in enumerate(transmissions):
            frame, is_sent = sent.frame, sent.sender_outcome == Outcome.pending
            if frame.ticket and not (sent.attempt and is_sent):
                self._unicasts.leave(sent)  # it is over, or an older one was broadcast in its place
            if not (sent.attempt or self._has_eifs or sent is self._ended_ack):
                continue
            outcome = receptions.outcome[index]
            if is_sent:
                is_up = frame.to == BROADCAST or self._topology.is_up(frame.to)
                address(sent, outcome, self._medium.locked(sent), receptions.cause[index], is_up)
            elif sent.attempt:
                outcome[:] = Outcome.out_of_range.value
                outcome[frame.to] = (
                    sent.sender_outcome.value
                )  # also if its addressee is out of range: it was not sent

    def _hear(self, sent: Transmission, now_ns: int) -> None:
        """Decide how long those who could read a transmission that ends, or could not, keep silent."""
        assert self._deferral is not None
        self._deferral.hear(sent, now_ns)
        if not sent.attempt:
            return
        for node, station in self._counting.items():  # who has read it without sensing it counts, and stops
            reserved = self._deferral.reserved_ns(node) > now_ns
            if reserved and not station.busy and station.access_ns > now_ns:
                station.slots -= max(0, (now_ns - station.from_ns) // SLOT_NS + 1)
                station.from_ns = self._free_ns(node, int(self._medium.idle_ns[node]))
                if station.contends:
                    self._plan(station.access_ns, ACCESS, station)

    def _back_off(self, station: _Station, sent: Transmission, now_ns: int, attempts: int = 0) -> None:
        """Draw a backoff after a frame, which had so many attempts without an acknowledgement."""
        station.slots = self._draw(sent, NEXT_BACKOFF, attempts)
        station.busy, station.from_ns = self._medium.is_sensed(station.node), self._free_ns(station.node, now_ns)
        self._counting[station.node] = station
        self._update_backoffs(now_ns)
        if station.queue:
            self._contend(station, now_ns)

    # Acknowledgements.

    def _begin_ack(self, station: _Station, sent: Transmission, now_ns: int) -> None:
        station.acking, sent.ack = sent, acknowledgement_of(sent)
        ack = sent.ack
        ack.signal = self._signals.of(ack.frame)
        ack.on_air_ns = now_ns
        self._trace.acknowledge(sent.row, now_ns, False)
        self._medium.begin(ack, now_ns)
        self._plan(now_ns + airtime_ns(ACK_BYTES, ack.frame.bitrate_mbps), ACK_END, station, sent)
        self._update_backoffs(now_ns)

    def _is_hearing_ack(self, station: _Station, sent: Transmission) -> bool:
        """Return true if the sender of a frame receives its acknowledgement, which decides when it ends."""
        return sent.ack is not None and bool(self._medium.locked(sent.ack)[station.node])

    def _end_ack(self, station: _Station, sent: Transmission, now_ns: int) -> Transmission:
        """End the acknowledgement of a transmission, and return it."""
        assert sent.ack is not None
        station.acking, sent.ack.end_ns = None, now_ns
        self._ended_ack = sent.ack
        self._medium.end(sent.ack, now_ns)
        self._plan(now_ns, ACK_HEARD, station, sent)
        return sent.ack

    def _hear_ack(self, sent: Transmission, now_ns: int) -> None:
        """Have the sender of a transmission act on its acknowledgement, if it could read it."""
        ack, sender = sent.ack, self._stations[sent.frame.sender]
        assert ack is not None and ack.decoded is not None
        self._hear(ack, now_ns)
        if sender.awaiting is not sent:
            self._update_backoffs(now_ns)
            return
        sent.acked = bool(ack.decoded[sender.node])
        self._trace.acknowledge(sent.row, ack.on_air_ns, sent.acked)
        self._conclude(sender, sent, now_ns)

    def _conclude(self, station: _Station, sent: Transmission, now_ns: int) -> None:
        """End an attempt: tell its result, or transmit the frame again after a longer backoff."""
        station.awaiting = None
        attempts = 0
        if sent.acked or sent.attempt >= MOST_ATTEMPTS:
            self._unicasts.finish(sent, now_ns)
        else:
            attempts = sent.attempt
            retry = retry_of(sent, self._copies.next(sent.frame.sender, sent.frame.seq))
            retry.signal = self._signals.of(retry.frame)
            station.queue.appendleft(retry)
        self._back_off(station, sent, now_ns, attempts)

    # How busy the medium is.

    def busy_ratios(self, time_ns: int) -> list[Array]:
        """See `Mac`."""
        self._medium.count(time_ns)
        return self._medium.windows[: time_ns // WINDOW_NS]

    def busy_ratios_at(self, time_ns: int) -> Array:
        """See `Mac`; the time is no more than two lookaheads and a window back."""
        return self._medium.busy_ratios_at(time_ns)

    # Backoffs.

    def _update_backoffs(self, now_ns: int) -> None:
        """Update every backoff after the medium changed: freeze, resume or end it."""
        over = []
        sensed = self._medium.sensed
        for station in self._counting.values():
            busy = sensed is not None and bool(sensed[station.node])
            if busy == station.busy:
                if not busy and not station.contends and station.from_ns + station.slots * SLOT_NS <= now_ns:
                    over.append(station.node)
                continue
            station.busy = busy
            if not busy:
                station.from_ns = self._free_ns(station.node, now_ns)
                if station.contends:
                    self._plan(station.access_ns, ACCESS, station)
                continue
            noticed_ns = now_ns + DETECTION_NS
            if station.access_ns >= noticed_ns:
                # A slot that began idle counts, even if the medium became busy within it.
                begun = max(0, (noticed_ns - station.from_ns) // SLOT_NS + 1)
                station.slots -= min(begun, station.slots)
                station.access = 0
            elif not station.contends:
                over.append(station.node)
        for node in over:
            del self._counting[node]
