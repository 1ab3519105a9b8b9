"""Sidelink: the MAC of LTE-V2X mode 4 and NR-V2X mode 2, and the reception of its frames.

**Slots.** Time is divided into slots and the channel into subchannels. A frame that is ready in slot n is
transmitted in slot n + `t1_slots` or later, on one resource; so all that is on air in slot n + `t1_slots` is known
as slot n ends. Its receptions are decided then, ahead of their time, which is what lets processes run alone for
`t1_slots` longer than `latency_ms`. That is this MAC's only event beside frames that become ready (and, with
re-evaluation, the checks of resources), ordered by time, kind and sender as in `csma`. A selection in slot n knows
of the slots before n alone, whatever has been decided.

**Grants.** The frames of a sender that tell the same period are a flow. One without a reservation selects a
resource when a frame is ready (`grid`), and holds it for as many frames as its reselection counter says, one in
each reservation interval. As the counter ends it keeps the resource with a probability, and selects another
otherwise. A frame waits for the next use of its flow's grant. If another frame has that, or if it is beyond the
selection window, the frame gets a resource of its own, once; so does each frame with dynamic scheduling. If the
sender's other flows leave no slot, it is dropped.

**Draws** are those of the frame for which something is drawn: they depend on the seed, its sender and its number.
"""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import pairwise
from statistics import fmean

import numpy as np

from emulator.radio.frames import Frame, InSlot, Receptions, Signal, Transmission
from emulator.radio.grid import BusyMeter, Candidates, Heard, Places, SensedGrid, Wanted
from emulator.radio.mac import ThrottledMac
from emulator.radio.medium import SLICE_NS, WINDOW_NS
from emulator.radio.outcomes import PENDING, Outcome
from emulator.radio.reception import JITTER, Signals, milliwatts, reception_draws, sender_draw
from emulator.scenario.radio import CrLimit, LteMode4, NrMode2, Receiver
from emulator.scenario.random_streams import Draws
from emulator.scenario.scenario import Radio, least_transit_ns
from vnet.types import Array, IntArray, Mask
from vnet.units import NS_PER_MS, NS_PER_S

REPEAT_SLOTS = 15
"""Most slots from a transmission to its blind retransmission (TS 36.321)."""
UNUSED = 3
"""Reservations in succession that a sender may leave unused before it gives them up (sl-ReselectAfter)."""
INTERVALS = 8
"""Intervals between frames from whose mean a period is learned, without one that is longer than all others."""
INSTANT_NS = NS_PER_MS
"""Time within which frames of a sender are of one instant, as programs in real time send them."""
MOST_FLOWS = {LteMode4: 2, NrMode2: 16}
"""Most reservations of one period for frames of one instant: sidelink processes (TS 36.321, 5.14.1; TS 38.321)."""
ONE_SHOT = 2, 6
"""Least and largest number of frames from one that is sent on a resource of its own to the next (J3161/1)."""
OCCUPANCY_MS = 1000
"""Time over which the channel occupancy ratio is measured (TS 36.214, 5.1.31)."""
SCI_SNR_DB = 0.0
"""Least ratio of signal to noise and interference at which a reservation is decoded."""
MOST_UNSENSED = 50
"""Most slots between two that are sensed at once."""
CHANNEL_KHZ = 9000
"""Width of the 50 resource blocks of 10 MHz, over which `radio.receiver.noise_dbm` is given."""
_CHOICE, _COUNTER, _KEEP, _REPEAT, _SHOT, _AGAIN, _TIES = range(7)
"""Indices of a frame's draws."""
_SECOND = np.uint64(0x9E3779B97F4A7C15)
"""Odd factor that makes the draws of a second transmission out of those of the first."""
_SECOND_FADING = np.uint64(0xD1B54A32D192ED03)
"""Odd factor that makes those of its fading: the highest 16 bits of the product, to which all bits contribute."""
_HIGHEST = np.uint64(48)

DECISION, READY, SLOWLY_READY, CHECK = range(4)
"""Kinds of events, in the order in which those of one time are processed."""


@dataclass(slots=True, eq=False)
class _Grant:
    """A reservation: `length` subchannels every `period` slots, next in `slot`, for `counter` more frames.

    `repeat` is the resource of the second transmission: slots after the first, and subchannel. `unused` are the
    reservations in succession that no frame has used.
    """

    slot: int
    subchannel: int
    length: int
    period: int
    counter: int
    repeat: tuple[int, int] | None
    unused: int = 0


@dataclass(slots=True, eq=False)
class _Station:
    """A sender: its flows, and the slots that it has booked.

    A flow has the frames that tell one period (0 for none). Of those that come at one instant, again and again,
    each has its own: their numbers, and 0 for all others, are the second part of the key. `frames` counts those
    that wait, or will be ready; `ready_ns` is when the last of them is. Those in a throttle's queue do not count.
    `used` are the last slots and lengths of its transmissions.
    """

    node: int
    flows: dict[tuple[float, int], _Flow] = field(default_factory=dict)
    bursts: dict[float, _Burst] = field(default_factory=dict)
    flow_of: dict[Transmission, _Flow] = field(default_factory=dict)
    """The flows of the frames that are not ready yet."""
    frames: int = 0
    ready_ns: int = 0
    booked: set[int] = field(default_factory=set)
    used: deque[tuple[int, int]] = field(default_factory=deque)

    def flow(self, frame: Frame, most: int) -> _Flow:
        """Return the flow of a frame that comes, one of `most` for the frames of an instant."""
        key = frame.period_ms, self.bursts.setdefault(frame.period_ms, _Burst()).number(frame.sent_ns, most)
        if key not in self.flows:
            self.flows[key] = _Flow(self)
        return self.flows[key]


@dataclass(slots=True, eq=False)
class _Burst:
    """Frames of one period that a sender enqueues at one instant: how many now, and how many the time before."""

    time_ns: int = -NS_PER_S
    count: int = 0
    before: int = 0

    def number(self, sent_ns: int, most: int) -> int:
        """Return the number of a frame in its instant, or 0 where the instant before had no such frame."""
        if sent_ns >= self.time_ns + INSTANT_NS:
            self.time_ns, self.before, self.count = sent_ns, self.count, 0
        self.count += 1
        return self.count - 1 if self.count <= min(self.before, most) else 0


@dataclass(slots=True, eq=False)
class _Flow:
    """Frames of one period of a sender: those that wait with the slots in which they became ready, and their grant.

    One that is sent elsewhere is in the queue, too, and marked: it uses up a reservation. `sent_ns` are the last
    times at which frames came.
    """

    station: _Station
    queue: deque[tuple[int, Transmission, bool]] = field(default_factory=deque)
    grant: _Grant | None = None
    sent_ns: deque[int] = field(default_factory=lambda: deque(maxlen=INTERVALS + 1))
    until_shot: int = 0


@dataclass(slots=True, eq=False)
class _Booking:
    """One use of a resource: by a frame, or (None) by the next frame that waits for a grant.

    `period` is the interval in slots with which its sender reserves it again, 0 for never; `last` is the last slot
    that was allowed. `is_repeat` marks a second transmission.
    """

    flow: _Flow
    slot: int
    subchannel: int
    length: int
    sent: Transmission | None = None
    grant: _Grant | None = None
    repeat: tuple[int, int] | None = None
    period: int = 0
    last: int = 0
    is_repeat: bool = False

    @property
    def station(self) -> _Station:
        """The sender."""
        return self.flow.station

    @property
    def slots(self) -> set[int]:
        """The slots that it takes; the second one of a grant is known by the grant."""
        if self.sent is None or self.repeat is None:
            return {self.slot}
        return {self.slot, self.slot + self.repeat[0]}


_Event = tuple[int, int, int, int, Transmission | _Booking | None]
"""An event: its time in ns, kind, sender, number of the event, and what it is about."""


class Sidelink(ThrottledMac):
    """MAC of vehicles that share a resource grid; see the module's docstring."""

    shares_medium = True

    def __init__(self, radio: Radio, signals: Signals, seed: int) -> None:
        super().__init__()
        mac = radio.sidelink
        assert mac is not None
        self._mac = mac
        self._slot_ns = mac.slot_ns
        self._t2_slots = mac.t2_ms * NS_PER_MS // mac.slot_ns
        self._signals = signals
        self._draws = Draws(seed, "sidelink")
        self._jitter_ns = radio.access_jitter_ms * NS_PER_MS
        self._limit = radio.queue_frames
        self._congestion = radio.congestion if isinstance(radio.congestion, CrLimit) else None
        self._link = Link(radio)
        self._grid = SensedGrid(mac, signals.count)
        self._meter = BusyMeter(mac, signals.count, 2 * least_transit_ns(radio) + 2 * WINDOW_NS)
        self._is_dynamic = isinstance(mac, NrMode2) and mac.scheduling == "dynamic"
        self._checks_again = isinstance(mac, NrMode2) and mac.re_evaluation
        self._most_flows = MOST_FLOWS[type(mac)]
        self._one_shot = isinstance(mac, LteMode4) and mac.one_shot
        self._stations: dict[int, _Station] = {}
        self._booked: dict[int, list[_Booking]] = {}
        self._on_air: list[tuple[int, list[_Booking]]] = []
        """Slots with what is transmitted in them, which nobody has needed to sense yet."""
        self._events: list[_Event] = []
        self._planned = 0
        self._now_ns = 0

    # Frames that are enqueued, and events.

    def _take(self, sent: Transmission) -> None:
        frame = sent.frame
        station = self._stations.get(frame.sender)
        if station is None:
            station = self._stations[frame.sender] = _Station(frame.sender)
        flow = station.flow(frame, self._most_flows)
        sent.signal = self._signals.of(frame)
        ready_ns = frame.sent_ns
        if self._jitter_ns:
            ready_ns += int(self._jitter_ns * sender_draw(sent, JITTER))
        if self._slows(frame.sender):
            flow.sent_ns.append(frame.sent_ns)  # later ones may be ready before it
            slow_ns = self._put_slowly(frame, max(ready_ns, station.ready_ns), self._limit)
            if slow_ns is None:
                self._leave(sent, Outcome.queue_full, frame.sent_ns)
            else:
                station.flow_of[sent] = flow
                self._plan(slow_ns, SLOWLY_READY, frame.sender, sent)
        elif station.frames >= self._limit:
            self._leave(sent, Outcome.queue_full, frame.sent_ns)
        else:
            station.frames += 1
            station.flow_of[sent] = flow
            station.ready_ns = max(ready_ns, station.ready_ns)
            self._plan(station.ready_ns, READY, frame.sender, sent)

    def take_sent(self) -> list[Transmission]:
        """See `Mac`."""
        self._sense()
        return super().take_sent()

    def _leave(self, sent: Transmission, sender_outcome: Outcome, time_ns: int) -> None:
        sent.sender_outcome, sent.end_ns = sender_outcome, time_ns
        self.sent.append(sent)

    def _plan(self, time_ns: int, kind: int, node: int, about: Transmission | _Booking | None = None) -> None:
        self._planned += 1  # in real time a frame may reach the emulator a little after its time
        heappush(self._events, (max(time_ns, self._now_ns), kind, node, self._planned, about))

    def next_ns(self) -> int | None:
        """Return the time of the next event, or None."""
        return self._events[0][0] if self._events else None

    def run(self, time_ns: int | None) -> None:
        """Process all events before `time_ns`, or all if it is None."""
        while self._events and (time_ns is None or self._events[0][0] < time_ns):
            self.step()
        self._now_ns = max(self._now_ns, time_ns or 0)

    def step(self) -> None:
        """Process the next event."""
        self._now_ns, kind, node, _, about = heappop(self._events)
        if kind == DECISION:
            self._decide(node)
        elif isinstance(about, _Booking):
            self._check_again(about)
        else:
            assert about is not None
            station = self._stations[node]
            flow = station.flow_of.pop(about)
            if kind == READY:
                flow.sent_ns.append(about.frame.sent_ns)
            elif station.frames < self._limit:
                station.frames += 1
            else:
                self._leave(about, Outcome.queue_full, self._now_ns)
                return
            self._ready(flow, about)

    def _draw(self, frame: Frame, index: int) -> float:
        return float(self._draws.uniform(frame.sender, frame.seq, _TIES, frame.draw)[index])

    # Selecting resources.

    def _ready(self, flow: _Flow, sent: Transmission) -> None:
        """Give a frame a place in its flow's grant, or a resource of its own."""
        frame, slot = sent.frame, self._now_ns // self._slot_ns
        length = self._link.length(frame.size_bytes)
        grant = flow.grant
        if grant is not None and grant.length < length:
            flow.station.booked.discard(grant.slot)
            flow.grant = grant = None
        if self._is_dynamic:
            self._send_alone(flow, sent, slot)
            return
        is_alone = self._is_one_shot(flow, frame)
        if grant is not None:
            turn = max(0, -(-(slot + self._mac.t1_slots - grant.slot) // grant.period))
            if len(flow.queue) > turn or grant.slot + grant.period * turn > slot + self._t2_slots:
                is_alone = True
            else:
                flow.queue.append((slot, sent, is_alone))
        else:
            if not is_alone:
                flow.queue.append((slot, sent, False))
            self._reserve(flow)
        if is_alone:
            self._send_alone(flow, sent, slot)

    def _is_one_shot(self, flow: _Flow, frame: Frame) -> bool:
        """Return true if it is time to send one frame elsewhere, which a persistent collision cannot reach."""
        if not self._one_shot:
            return False
        flow.until_shot -= 1
        if flow.until_shot > 0:
            return False
        least, most = ONE_SHOT
        is_first = flow.until_shot < 0
        flow.until_shot = least + int(self._draw(frame, _SHOT) * (most - least + 1))
        return not is_first

    def _period(self, flow: _Flow, frame: Frame) -> int:
        """Return the reservation interval in slots: what a program says, or what its frames' intervals are."""
        period_ms = frame.period_ms or self._mac.reservation_ms
        times_ns = flow.sent_ns
        intervals_ns = [later - ns for ns, later in pairwise(times_ns) if later >= ns + INSTANT_NS]
        if intervals_ns and not frame.period_ms:
            *others, longest = sorted(intervals_ns)
            is_silence = len(others) > 1 and longest > sum(others)
            mean_ms = fmean(others if is_silence else intervals_ns) / NS_PER_MS
            period_ms = min(self._mac.periods_ms, key=lambda each: (abs(each - mean_ms), each))
        return period_ms * NS_PER_MS // self._slot_ns

    def _reserve(self, flow: _Flow) -> None:
        """Select a resource for the frames that wait, and for those to come."""
        waiting = [(ready, sent) for ready, sent, is_alone in flow.queue if not is_alone]
        flow.queue.clear()
        if not waiting:
            return
        slot, (ready, first_sent) = self._now_ns // self._slot_ns, waiting[0]
        frame = first_sent.frame
        length = self._link.length(max(sent.frame.size_bytes for _, sent in waiting))
        period = self._period(flow, frame)
        counter = self._counter(frame, period)
        last = max(slot + self._mac.t1_slots, min(ready + self._t2_slots, slot + period))
        wanted = Wanted(flow.station.node, slot + self._mac.t1_slots, last, length, period, 10 * counter)
        found = self._candidates(flow.station, frame, wanted)
        if not found.mask.any():
            flow.station.frames -= len(waiting)
            for _, sent in waiting:
                self._leave(sent, Outcome.no_grant, self._now_ns)
            return
        first, subchannel, repeat = self._choose(found, frame, _CHOICE)
        flow.grant = _Grant(first, subchannel, length, period, counter, repeat)
        flow.queue.append((*waiting[0], False))
        self._book(self._use_of(flow, last), checks=True)
        for ready, sent in waiting[1:]:
            self._send_alone(flow, sent, ready)

    def _counter(self, frame: Frame, period: int) -> int:
        least, most = self._mac.counters(period * self._slot_ns // NS_PER_MS)
        return least + int(self._draw(frame, _COUNTER) * (most - least + 1))

    def _use_of(self, flow: _Flow, last: int = 0) -> _Booking:
        """Return the next use of a flow's grant."""
        grant = flow.grant
        assert grant is not None
        return _Booking(
            flow=flow,
            slot=grant.slot,
            subchannel=grant.subchannel,
            length=grant.length,
            grant=grant,
            repeat=grant.repeat,
            period=grant.period,
            last=last,
        )

    def _send_alone(self, flow: _Flow, sent: Transmission, ready: int) -> None:
        """Select a resource for one frame that was ready in a slot."""
        length = self._link.length(sent.frame.size_bytes)
        first = self._now_ns // self._slot_ns + self._mac.t1_slots
        last = max(first, ready + self._t2_slots)
        wanted = Wanted(flow.station.node, first, last, length, 0, 1)
        found = self._candidates(flow.station, sent.frame, wanted)
        if not found.mask.any():
            flow.station.frames -= 1
            self._leave(sent, Outcome.no_grant, self._now_ns)
            return
        first, subchannel, repeat = self._choose(found, sent.frame, _CHOICE)
        self._book(_Booking(flow, first, subchannel, length, sent, repeat=repeat, last=last), checks=True)

    def _choose(
        self, found: Candidates, frame: Frame, which: int, kept: tuple[int, int] | None = None
    ) -> tuple[int, int, tuple[int, int] | None]:
        """Return the slot and the subchannel of a candidate, and (slots later, subchannel) of a second one.

        The earlier one of the two is used first. The second one may be there already, and `kept`.
        """
        first = found.chosen(self._draw(frame, which))
        near = found.around(first[0], REPEAT_SLOTS)
        if not self._mac.retransmit or not (kept or near.mask.any()):
            return *first, None
        first, second = sorted([first, kept or near.chosen(self._draw(frame, _REPEAT))])
        return *first, (second[0] - first[0], second[1])

    def _candidates(self, station: _Station, frame: Frame, wanted: Wanted) -> Candidates:
        """Return the candidates of a station: none if it transmits in each slot of the window itself.

        Its grants keep the slots of their later uses, which no use of the new resource may meet, unless nothing is
        left then.
        """
        grants: set[int] = set()
        counter = wanted.times // 10  # with which the resource is used, until it is kept or left
        horizon = wanted.last + wanted.period * (counter - 1) if wanted.period else wanted.last
        for grant in [flow.grant for flow in station.flows.values() if flow.grant is not None]:
            uses = {*range(grant.slot, horizon + 1, grant.period)}
            uses |= {slot + grant.repeat[0] for slot in uses} if grant.repeat else set()
            if wanted.period:
                uses = {wanted.first + (slot - wanted.first) % wanted.period for slot in uses}
            grants |= uses
        now = self._now_ns // self._slot_ns
        self._sense(now)
        for booked in (grants | station.booked, station.booked):
            found = self._grid.candidates(now, wanted._replace(booked=frozenset(booked)))
            if found.mask.any():
                break
        if self._mac.ranks_power:
            ties = self._draws.uniform(frame.sender, frame.seq, _TIES + found.mask.size, frame.draw)[_TIES:]
            found = found.quietest(self._mac.candidate_share, ties)
        return found

    def _book(self, booking: _Booking, checks: bool = False) -> None:
        """Plan the use of a resource; one that is new is checked again before it is used."""
        if booking.slot not in self._booked:
            self._booked[booking.slot] = []
            known = booking.slot - self._mac.t1_slots + 1
            self._plan(known * self._slot_ns, DECISION, booking.slot)
        self._booked[booking.slot].append(booking)
        booking.station.booked |= booking.slots
        check_ns = (booking.slot - self._mac.t1_slots) * self._slot_ns
        if checks and self._checks_again and check_ns > self._now_ns:
            self._plan(check_ns, CHECK, booking.station.node, booking)

    def _check_again(self, booking: _Booking) -> None:
        """Replace those of the selected resources that have been reserved meanwhile (re-evaluation)."""
        flow, station, grant = booking.flow, booking.station, booking.grant
        if grant is not None and (flow.grant is not grant or not flow.queue):
            return
        sent = booking.sent or flow.queue[0][1]  # the first use of a grant is that of the frame it was selected for
        times = 10 * grant.counter if grant is not None else 1
        chosen = [(booking.slot, booking.subchannel)]
        if booking.repeat is not None:
            chosen.append((booking.slot + booking.repeat[0], booking.repeat[1]))
        checks = tuple(slot for slot, _ in chosen)
        wanted = Wanted(
            station.node, booking.slot, booking.last, booking.length, booking.period, times, checks=checks
        )
        station.booked -= booking.slots
        if grant is not None:
            flow.grant = None  # whose own slots are free to it
        found = self._candidates(station, sent.frame, wanted)
        if grant is not None:
            flow.grant = grant
        kept = [each for each in chosen if found.has(*each)]
        if len(kept) == 1 and (near := found.around(kept[0][0], REPEAT_SLOTS)).mask.any():
            found = near
        elif len(kept) == 1:  # the other one has to be near: both are selected anew
            kept = []
        if len(kept) == len(chosen) or not found.mask.any():
            station.booked |= booking.slots
            return
        self._booked[booking.slot].remove(booking)
        booking.slot, booking.subchannel, booking.repeat = self._choose(found, sent.frame, _AGAIN, *kept)
        if grant is not None:
            grant.slot, grant.subchannel, grant.repeat = booking.slot, booking.subchannel, booking.repeat
        self._book(booking)

    # Slots.

    def _decide(self, slot: int) -> None:
        """Transmit in a slot what was booked for it: from now on nothing can be."""
        on_air: list[_Booking] = []
        bookings = sorted(self._booked.pop(slot), key=lambda each: (each.station.node, each.grant is not None))
        for booking in bookings:
            booking.station.booked.discard(slot)
            is_free = all(other.station is not booking.station for other in on_air)
            if booking.grant is not None:
                self._use_grant(booking, is_free)
            elif not booking.is_repeat:
                booking.station.frames -= 1
                if not (is_free and self._may_send(booking)):
                    self._give_up(booking)
            if booking.sent is not None:
                on_air.append(booking)
        if on_air:
            self._transmit(slot, on_air)
        for booking in on_air:
            self._follow(booking)

    def _use_grant(self, booking: _Booking, is_free: bool) -> None:
        """Take the frame that is sent on a grant's next resource, if any waits, and book the one after it."""
        flow, grant = booking.flow, booking.grant
        if grant is None or flow.grant is not grant or grant.slot != booking.slot:
            return
        is_due = bool(flow.queue) and flow.queue[0][0] <= booking.slot - self._mac.t1_slots
        if is_due and (is_free or flow.queue[0][2]):
            _, sent, is_elsewhere = flow.queue.popleft()
            grant.unused = 0
            grant.counter -= 1
            if grant.counter <= 0 and self._draw(sent.frame, _KEEP) < self._mac.keep_probability:
                grant.counter = self._counter(sent.frame, grant.period)
            if not is_elsewhere:
                booking.sent = sent
                flow.station.frames -= 1
                if not self._may_send(booking):
                    self._give_up(booking)
        else:
            grant.unused += 1
            if is_due and grant.slot + grant.period > flow.queue[0][0] + self._t2_slots:
                ready, sent, _ = flow.queue.popleft()
                self._send_alone(flow, sent, ready)
        grant.slot += grant.period
        if grant.counter > 0 and grant.unused < UNUSED:
            self._book(self._use_of(flow))
            return
        flow.grant, booking.period = None, 0
        self._reserve(flow)

    def _give_up(self, booking: _Booking) -> None:
        """Drop a frame that may not be sent."""
        booking.station.booked -= booking.slots
        if booking.sent is not None:
            self._leave(booking.sent, Outcome.no_grant, self._now_ns)
        booking.sent = None

    def _may_send(self, booking: _Booking) -> bool:
        """Return true if congestion control allows its station this transmission."""
        if self._congestion is None:
            return True
        station, slots = booking.station, OCCUPANCY_MS * NS_PER_MS // self._slot_ns
        while station.used and station.used[0][0] <= booking.slot - slots:
            station.used.popleft()
        self._sense()
        ratio = self._meter.at(self._now_ns // SLICE_NS * SLICE_NS)[station.node]
        limits = [
            most for busy, most in zip(self._congestion.busy, self._congestion.most, strict=True) if ratio >= busy
        ]
        occupied = booking.length + sum(length for _, length in station.used)
        return not limits or occupied <= limits[-1] * slots * self._mac.subchannels

    def _count_use(self, booking: _Booking, slot: int) -> None:
        """Note for congestion control that a station occupies a slot."""
        if self._congestion is not None:
            insort(booking.station.used, (slot, booking.length))  # second ones are noted ahead

    def _transmit(self, slot: int, on_air: list[_Booking]) -> None:
        """Put frames on air in a slot."""
        for booking in on_air:
            sent = booking.sent
            assert sent is not None
            if not booking.is_repeat:
                self._count_use(booking, slot)
                sent.on_air_ns = slot * self._slot_ns
            sent.end_ns = (slot + 1) * self._slot_ns
        if self._on_air and slot - self._on_air[0][0] >= MOST_UNSENSED:
            self._sense()
        self._on_air.append((slot, on_air))

    def _sense(self, before: int | None = None) -> None:
        """Decide what everybody receives and senses in the slots that are left, or in those before one of them.

        Many slots at once take little more time than one.
        """
        count = len(self._on_air) if before is None else sum(slot < before for slot, _ in self._on_air)
        if not count:
            return
        slots, bookings = zip(*self._on_air[:count], strict=True)
        del self._on_air[:count]
        on_air = [booking for some in bookings for booking in some]
        nodes = [booking.station.node for booking in on_air]
        power_mw = np.array([self._power_mw(booking) for booking in on_air])
        places = Places(
            slot=np.repeat(np.arange(count), [len(some) for some in bookings]),
            first=np.array([booking.subchannel for booking in on_air]),
            length=np.array([booking.length for booking in on_air]),
        )
        deaf = np.zeros((count, self._signals.count), bool)
        deaf[places.slot, nodes] = True
        sensed_mw = self._link.sensed_mw(power_mw, places)
        others_mw = sensed_mw[places.slot, places.first]
        for nth in range(1, int(places.length.max())):
            longer = np.flatnonzero(places.length > nth)
            others_mw[longer] += sensed_mw[places.slot[longer], places.first[longer] + nth]
        others_mw -= power_mw
        np.maximum(others_mw, 0.0, out=others_mw)
        decoded = self._link.decodes_reservation(power_mw, others_mw, places.length) & ~deaf[places.slot]
        is_busy = (sensed_mw >= self._link.busy_mw).view(np.uint8)
        busy = np.add.reduce(is_busy, axis=1, dtype=np.uint8).astype(np.int64)
        busy[places.slot, nodes] = places.length
        for booking, own_mw, each_mw, index in zip(on_air, power_mw, others_mw, places.slot.tolist(), strict=True):
            _signal(booking.sent).slots.append(InSlot(own_mw, each_mw, deaf[index], booking.length))
        told = [[booking.period for booking in on_air]]
        if self._mac.retransmit:
            told.append([self._resources_until_repeat(booking) for booking in on_air])
        self._grid.sense(slots, sensed_mw, deaf, Heard(power_mw, decoded, places, np.array(told)))
        for slot, each in zip(slots, busy, strict=True):
            self._meter.add(slot, each)

    def _resources_until_repeat(self, booking: _Booking) -> int:
        """Return how many resources later a frame is transmitted again, or 0: its first transmission tells it."""
        gap, subchannel = booking.repeat or (0, booking.subchannel)
        return gap * self._mac.subchannels + subchannel - booking.subchannel

    def _power_mw(self, booking: _Booking) -> Array:
        """Return the powers (N,) of a transmission: a second one has fading of its own."""
        signal = _signal(booking.sent)
        if booking.sent is not None and booking.is_repeat:
            return self._signals.power_mw(booking.sent.frame, signal.random_draws * _SECOND_FADING >> _HIGHEST)
        return signal.power_mw

    def _follow(self, booking: _Booking) -> None:
        """Book the second transmission of a frame, or leave it to be judged.

        Congestion control decides about it now: later, the frame would have arrived already without it.
        """
        assert booking.sent is not None
        station, (gap, subchannel) = booking.station, booking.repeat or (0, 0)
        slot = booking.slot + gap
        is_taken = booking.grant is not None and slot in station.booked
        if not gap or is_taken or not self._may_send(booking):
            if booking.grant is None:
                station.booked.discard(slot)
            self._leave(booking.sent, Outcome.pending, booking.sent.end_ns)
            return
        self._count_use(booking, slot)
        self._book(
            _Booking(
                flow=booking.flow,
                slot=slot,
                subchannel=subchannel,
                length=booking.length,
                sent=booking.sent,
                period=booking.period,
                is_repeat=True,
            )
        )

    # How busy the channel is.

    def busy_ratios(self, time_ns: int) -> list[Array]:
        """See `Mac`."""
        self._sense()
        self._meter.count(time_ns)
        return self._meter.windows[: time_ns // WINDOW_NS]

    def busy_ratios_at(self, time_ns: int) -> Array:
        """See `Mac`; the time is no more than two lookaheads and a window back."""
        self._sense()
        return self._meter.at(time_ns)


class Link:
    """Detection and decoding at a receiver: noise, thresholds, and block error rates."""

    def __init__(self, radio: Radio) -> None:
        mac = radio.sidelink
        assert mac is not None
        receiver = radio.receiver or Receiver()
        self._subchannels = mac.subchannels
        share = mac.data_blocks * mac.block_khz / CHANNEL_KHZ
        self._noise_mw = milliwatts(receiver.noise_dbm + receiver.noise_figure_db) * share
        self.sensing_mw = milliwatts(mac.sensing_dbm)
        """Least power at which a frame is detected."""
        self.busy_mw = milliwatts(mac.busy_dbm)
        """Least power at which a subchannel is busy."""
        self._leak = milliwatts(-mac.in_band_emission_db)
        self._sci = milliwatts(SCI_SNR_DB)
        self._table = np.array(mac.bler_sinr_db), np.array(mac.bler)
        self._clear = milliwatts(mac.bler_sinr_db[-1]) * (1 + 1e-9)
        self._bytes = mac.subchannel_bytes

    def noise_mw(self, length: int) -> float:
        """Return the noise in the data of so many subchannels."""
        return self._noise_mw * length

    def length(self, size_bytes: int) -> int:
        """Return the number of subchannels that a frame takes."""
        return -(-max(size_bytes, 1) // self._bytes)

    def sensed_mw(self, power_mw: Array, places: Places) -> Array:
        """Return the power (slots, subchannels, N) of signals with these powers (K, N), with their leakage."""
        sensed_mw = np.zeros((int(places.slot[-1]) + 1, self._subchannels, power_mw.shape[1]))
        each_mw = power_mw / places.length[:, None]
        frames = zip(each_mw * self._leak, each_mw * (1 - self._leak), places.each(), strict=True)
        for leaked_mw, own_mw, (slot, first, length) in frames:
            in_slot_mw = sensed_mw[slot]
            in_slot_mw += leaked_mw
            in_place_mw = in_slot_mw[first] if length == 1 else in_slot_mw[first : first + length]
            in_place_mw += own_mw
        return sensed_mw

    def decodes_reservation(self, own_mw: Array, others_mw: Array, lengths: IntArray) -> Mask:
        """Return the mask (K, N) of receivers that decode the control information of frames of K lengths."""
        least_mw = self._sci * (self._noise_mw * lengths[:, None] + others_mw)
        return np.asarray((own_mw >= self.sensing_mw) & (own_mw >= least_mw))

    def error_rate(self, ratio: Array) -> Array:
        """Return the block error rates at these ratios (any shape) of signal to noise and interference."""
        rates = np.full(ratio.shape, self._table[1][-1])
        some = ratio < self._clear  # beyond it the table stays as it is
        rates[some] = np.interp(10 * np.log10(np.maximum(ratio[some], 1e-30)), *self._table)
        return rates


class SidelinkReception:
    """The stage of the receiver: decides `half_duplex`, `below_sensing`, `faded` and `collided`, in this order.

    One draw decides about a transmission at a receiver, with and without the interference that it met. Of two
    transmissions of a frame one must be received.
    """

    def __init__(self, radio: Radio, signals: Signals) -> None:
        self._link = Link(radio)
        self._count = signals.count

    def __call__(self, transmissions: Sequence[Transmission], receptions: Receptions) -> None:
        """Decide the receptions of the frames that were sent."""
        sent = [index for index, one in enumerate(transmissions) if one.sender_outcome == Outcome.pending]
        if not sent:
            return
        signals = [_signal(transmissions[index]) for index in sent]
        words = np.array([signal.random_draws for signal in signals])
        undecided = receptions.outcome[sent] == PENDING
        deaf, detected, alone, received = np.zeros((4, *words.shape), bool)
        deaf[:] = True
        for nth in range(max(len(signal.slots) for signal in signals)):
            frames = np.array([index for index, signal in enumerate(signals) if nth < len(signal.slots)])
            some = slice(None) if len(frames) == len(signals) else frames  # much faster than an index of all
            slots = [signals[index].slots[nth] for index in frames]
            silent = np.array([slot.deaf for slot in slots])
            power_mw = np.array([slot.power_mw for slot in slots])
            others_mw = np.array([slot.others_mw for slot in slots])
            noise_mw = np.array([self._link.noise_mw(slot.length) for slot in slots])
            deaf[some] &= silent
            hears = (power_mw >= self._link.sensing_mw) & ~silent
            detected[some] |= hears
            able = np.flatnonzero(hears & undecided[some])
            own_mw, noise = power_mw.ravel()[able], noise_mw[able // self._count]
            place = (
                able if isinstance(some, slice) else frames[able // self._count] * self._count + able % self._count
            )
            drawn = words.ravel()[place]
            draws = reception_draws(drawn * _SECOND if nth else drawn)
            alone.ravel()[place] |= draws >= self._link.error_rate(own_mw / noise)
            received.ravel()[place] |= draws >= self._link.error_rate(own_mw / (noise + others_mw.ravel()[able]))
        for mask, outcome in (
            (deaf, Outcome.half_duplex),
            (~detected, Outcome.below_sensing),
            (~alone, Outcome.faded),
            (~received, Outcome.collided),
        ):
            some = np.zeros(receptions.outcome.shape, bool)
            some[sent] = mask
            receptions.decide(some, outcome)

    def powers_db(self, transmissions: Sequence[Transmission], frame_index: IntArray, receiver: IntArray) -> Array:
        """Return received powers in dBm, and their ratios to noise and interference in dB, as an array (2, n).

        `frame_index` and `receiver` (n,) name the receptions. Of two transmissions the ratio is the better one.
        Both are NaN for a frame that was not sent, and out of range.
        """
        own_mw, ratio = np.full((2, len(transmissions), self._count), np.nan)
        for index, sent in enumerate(transmissions):
            if sent.sender_outcome == Outcome.pending:
                for nth, slot in enumerate(_signal(sent).slots):
                    each = slot.power_mw / (self._link.noise_mw(slot.length) + slot.others_mw)
                    if nth:
                        better = each > ratio[index]
                        np.copyto(own_mw[index], slot.power_mw, where=better)
                        np.copyto(ratio[index], each, where=better)
                    else:
                        own_mw[index], ratio[index] = slot.power_mw, each
        place = frame_index * self._count + receiver  # a look-up with one index is much faster than with two
        found = np.array([own_mw.ravel()[place], ratio.ravel()[place]])
        found[:, found[0] == 0] = np.nan
        return np.asarray(10 * np.log10(found))


def _signal(sent: Transmission | None) -> Signal:
    assert sent is not None and sent.signal is not None
    return sent.signal
