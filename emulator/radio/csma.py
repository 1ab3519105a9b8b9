"""Listen before talking: when frames get on air if all senders share it (EDCA of 802.11p, broadcasts only).

**The engine's time.** When a frame ends, and at whom it then arrives, depends on what others send before that. So
this module has instants of its own, at which no program is woken: a frame is ready, a backoff is over, a frame
ends. They stand in one heap, ordered by time, then by kind, then by the sender's number, and never by when they
were put there. Three rules make the result depend only on what was handed over when:

1. `run(t)` does what lies strictly before t. A program that acts at t may hand over a frame at t, whoever is asked
   first; what is due at t is done only when all of them have.
2. Whatever is handed over at t makes instants at t or later, and no arrival earlier than a microsecond after a
   frame's end. So an arrival at t is known once all before t is done, and nothing handed over at t can change it.
3. A frame keeps what it met when it was handed over (`TopologySnapshot`, `LinkEffects`), and its draws depend on it
   alone. So it does not matter at which of their calls the drivers move vehicles, as long as they do so between
   handing over what was sent before and what is sent after.

Lockstep wants to know whom to wake next: it lets this run up to the earliest instant at which a program acts for
another reason, but no further than the first arrival at one that waits for it (`Engine.look_ahead`).

**The rules of access** are those of 802.11-2020, 10.23.2. A frame that is ready while the medium is idle goes on
air at the next boundary of a slot, counted from AIFS after the medium became idle; one that finds it busy draws a
backoff, and so does every sender after each of its frames. Backoffs count down one for each slot that begins idle,
and stand still while the medium is busy. A busy medium is noticed only after 4 µs: who starts within them collides.
What is left out: broadcasts are not acknowledged, so that there are no further attempts and no longer windows, and
the longer wait after a frame that could not be read (EIFS).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import NamedTuple

from emulator.radio.congestion import CongestionControl, congestion_control_of
from emulator.radio.dot11p import AIFSN_AND_CW, DETECTION_NS, SIFS_NS, SLOT_NS, airtime_ns
from emulator.radio.frames import Frame
from emulator.radio.mac import Throttle
from emulator.radio.medium import Medium
from emulator.radio.outcomes import Outcome
from emulator.radio.reception import Threshold, milliwatts
from emulator.radio.signals import BACKOFF, JITTER, NEXT_BACKOFF, Signals, sender_draw
from emulator.scenario.radio import Mac, Receiver
from emulator.scenario.scenario import Radio
from vnet.units import NS_PER_MS

END, READY, SLOWLY_READY, ACCESS = range(4)

_Instant = tuple[int, int, int, int, Frame | None]
"""Something that happens: when, which kind, at which sender, which of its plans, and with which frame."""


@dataclass(slots=True, eq=False)
class _Station:
    """A sender: the frames that wait, and how its backoff stands.

    `queue` are the frames that are ready, and `coming` is how many more will be; `held` is true while congestion
    control, which is asked again at `next_poll_ns`, holds them back. `wants` is true while a frame waits for the
    medium and for nothing else. `slots` are left of its backoff, which counts from `from_ns` while the medium
    is idle, and pauses while it is `busy` there. `plans` counts planned accesses: of these only `access` happens.
    """

    node: int
    queue: deque[Frame] = field(default_factory=deque)
    coming: int = 0
    ready_ns: int = 0
    held: bool = False
    next_poll_ns: int = -1
    on_air: bool = False
    wants: bool = False
    slots: int = 0
    from_ns: int = 0
    busy: bool = False
    plans: int = 0
    access: int = 0

    @property
    def access_ns(self) -> int:
        """When the backoff is over if the medium stays idle."""
        return self.from_ns + self.slots * SLOT_NS


class Times(NamedTuple):
    """Of an access category: how long the medium must be idle (ns), and the largest backoff (slots)."""

    aifs: int
    window: int


def times_ns(mac: Mac) -> Times:
    """The times of the access category that a scenario chooses."""
    aifsn, window = AIFSN_AND_CW[mac.access_category]
    return Times(SIFS_NS + aifsn * SLOT_NS, window)


class Csma:
    """Access to one medium that all `count` vehicles share; see the module's text."""

    def __init__(self, mac: Mac, radio: Radio, signals: Signals, count: int, seed: int) -> None:
        self._aifs_ns, self._window = times_ns(mac)
        self._signals = signals
        self._jitter_ns = radio.access_jitter_ms * NS_PER_MS
        self._bitrate_mbps = radio.bitrate_mbps
        self._limit = radio.queue_frames
        threshold = Threshold(radio.receiver or Receiver())
        self.medium = Medium(count, milliwatts(mac.carrier_sense_dbm), threshold)
        self._congestion = congestion_control_of(radio.congestion, count, seed)
        if self._congestion is not None:
            self.medium.listen(self._congestion.observe)
        self._throttle = Throttle()
        self._instants: list[_Instant] = []
        self._stations: dict[int, _Station] = {}
        self._counting: dict[int, _Station] = {}
        """The stations whose backoff is not over, as far as anybody knows."""
        self._now_ns = 0
        self.sent: list[Frame] = []

    def throttle(self, bitrate_mbps: Mapping[int, float]) -> None:
        """From now on frames of these senders come to the medium at these bitrates, and no others are slowed."""
        self._throttle.set(bitrate_mbps)

    def enqueue(self, frame: Frame) -> None:
        """Take a frame; it is ready after its jitter, and not before those that were handed over earlier."""
        station = self._stations.get(frame.sender)
        if station is None:
            station = self._stations[frame.sender] = _Station(frame.sender)
        frame.signal = self._signals.of(frame)
        ready_ns = frame.sent_ns + int(self._jitter_ns * sender_draw(frame, JITTER))
        if self._throttle.slows(frame.sender):
            slow_ns = self._throttle.put(frame, ready_ns, self._limit)
            if slow_ns is None:
                self._leave(frame, Outcome.queue_full, frame.sent_ns)
            else:
                self._plan(slow_ns, SLOWLY_READY, station, frame)
        elif self._is_full(station):
            self._leave(frame, Outcome.queue_full, frame.sent_ns)
        else:
            station.ready_ns = max(ready_ns, station.ready_ns)
            if station.ready_ns == frame.sent_ns and self._is_quiet(frame.sent_ns):
                self._ready(station, frame, frame.sent_ns)
            else:
                station.coming += 1
                self._plan(station.ready_ns, READY, station, frame)

    def _is_full(self, station: _Station) -> bool:
        return station.coming + len(station.queue) >= self._limit

    def _is_quiet(self, time_ns: int) -> bool:
        """Whether nothing else has to happen before a frame is ready at this instant.

        None goes on air at the instant at which it is ready, so that those of one instant do not meet.
        """
        return self._now_ns <= time_ns and (not self._instants or self._instants[0][:2] > (time_ns, READY))

    def _leave(self, frame: Frame, sender_outcome: Outcome, time_ns: int) -> None:
        frame.sender_outcome, frame.end_ns = sender_outcome, time_ns
        self.sent.append(frame)

    def _plan(self, time_ns: int, kind: int, station: _Station, frame: Frame | None = None) -> None:
        station.plans += 1
        if kind == ACCESS:
            station.access = station.plans
        if time_ns < self._now_ns:  # what was sent over a network may come a little after its time
            time_ns = self._now_ns
        heappush(self._instants, (time_ns, kind, station.node, station.plans, frame))

    def next_ns(self) -> int | None:
        """When something happens next."""
        return self._instants[0][0] if self._instants else None

    def run(self, time_ns: int | None) -> None:
        """Do all that happens before `time_ns`, or all there is to do."""
        instants = self._instants
        while instants and (time_ns is None or instants[0][0] < time_ns):
            self._happen(*heappop(instants))
        if time_ns is not None and time_ns > self._now_ns:
            self._now_ns = time_ns

    def step(self) -> None:
        """Do what happens next."""
        self._happen(*heappop(self._instants))

    def _happen(self, now_ns: int, kind: int, node: int, plan: int, frame: Frame | None) -> None:
        self._now_ns = now_ns
        station = self._stations[node]
        if kind == ACCESS:
            if station.access == plan:
                self._begin(station, now_ns)
        elif kind == END:
            assert frame is not None
            self._end(station, frame, now_ns)
        elif kind == SLOWLY_READY and self._is_full(station):
            assert frame is not None
            self._leave(frame, Outcome.queue_full, now_ns)
        else:
            station.coming -= kind == READY and frame is not None
            self._ready(station, frame, now_ns)

    def _ready(self, station: _Station, frame: Frame | None, now_ns: int) -> None:
        """A frame is ready, or the sender's congestion control is to be asked again."""
        if frame is not None:
            station.queue.append(frame)
        if station.queue and not station.wants and not station.on_air:
            self._want(station, now_ns)

    def _is_let_through(self, station: _Station, congestion: CongestionControl, now_ns: int) -> bool:
        """Whether congestion control lets a station's next frame go; those that are too many never will.

        A frame that was held back gets to the medium with its jitter, like any other: else those that collided once
        would come, after the same pause, at the same instant again.
        """
        self.medium.count(now_ns)
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

    def _want(self, station: _Station, now_ns: int) -> None:
        """Let the first frame of a station go on air as soon as it may."""
        if self._congestion is not None and not self._is_let_through(station, self._congestion, now_ns):
            return
        station.wants = True
        node = station.node
        if node in self._counting and (station.busy or station.access_ns > now_ns):
            if not station.busy:
                self._plan(station.access_ns, ACCESS, station)
            return
        self._counting[node] = station
        station.slots = 0
        station.busy = self.medium.is_sensed(node)
        noticed_ns = self.medium.busy_ns(node) + DETECTION_NS
        if station.busy and noticed_ns <= now_ns:
            station.slots = self._draw(station.queue[0], BACKOFF)
            return
        free_ns = int(self.medium.idle_ns[node]) + self._aifs_ns
        station.from_ns = free_ns + SLOT_NS * max(0, (now_ns - free_ns) // SLOT_NS + 1)
        if not station.busy or station.from_ns < noticed_ns:
            self._plan(station.from_ns, ACCESS, station)

    def _draw(self, frame: Frame, which: int) -> int:
        return int(sender_draw(frame, which) * (self._window + 1))

    def _begin(self, station: _Station, now_ns: int) -> None:
        """A frame goes on air."""
        frame = station.queue.popleft()
        station.wants, station.on_air = False, True
        self._counting.pop(station.node, None)
        frame.on_air_ns = now_ns
        airtime = airtime_ns(frame.size_bytes, self._bitrate_mbps)
        if self._congestion is not None:
            self._congestion.sends(station.node, now_ns, airtime)
        self.medium.begin(frame, now_ns)
        self._plan(now_ns + airtime, END, station, frame)
        self._look(now_ns)

    def _end(self, station: _Station, frame: Frame, now_ns: int) -> None:
        """A frame has been sent; its sender backs off before the next."""
        station.on_air = False
        self.medium.end(frame, now_ns)
        self._leave(frame, Outcome.pending, now_ns)
        station.slots = self._draw(frame, NEXT_BACKOFF)
        station.busy, station.from_ns = self.medium.is_sensed(station.node), now_ns + self._aifs_ns
        self._counting[station.node] = station
        self._look(now_ns)
        if station.queue:
            self._want(station, now_ns)

    def _look(self, now_ns: int) -> None:
        """Every station whose backoff counts looks whether the medium is still what it was."""
        over = []
        sensed = self.medium.sensed
        for station in self._counting.values():
            busy = sensed is not None and bool(sensed[station.node])
            if busy == station.busy:
                if not busy and not station.wants and station.from_ns + station.slots * SLOT_NS <= now_ns:
                    over.append(station.node)
                continue
            station.busy = busy
            if not busy:
                station.from_ns = now_ns + self._aifs_ns
                if station.wants:
                    self._plan(station.access_ns, ACCESS, station)
                continue
            noticed_ns = now_ns + DETECTION_NS
            if station.access_ns >= noticed_ns:
                # A slot that has begun idle counts, though it did not stay so.
                begun = max(0, (noticed_ns - station.from_ns) // SLOT_NS + 1)
                station.slots -= min(begun, station.slots)
                station.access = 0
            elif not station.wants:
                over.append(station.node)
        for node in over:
            del self._counting[node]
