"""The plain way of getting on air: a queue of the sender's own, and nobody in anybody's way."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from emulator.radio.dot11p import airtime_ns
from emulator.radio.frames import Frame
from emulator.radio.outcomes import Outcome
from emulator.scenario.random_streams import Draws
from emulator.scenario.scenario import Radio
from vnet.units import NS_PER_MS


class Mac(Protocol):
    """How frames get on air, and when they have left it. `sent` are those that have, since the engine took them.

    What happens in between has instants of its own, which wake nobody: `run` does what lies strictly before an
    instant, so that all that is handed over at one instant is there before anything of that instant happens.
    """

    sent: list[Frame]

    def enqueue(self, frame: Frame) -> None:
        """Take a frame that is sent at `frame.sent_ns`, and set its `sender_outcome` and `end_ns` in good time."""

    def next_ns(self) -> int | None:
        """When something happens next."""

    def run(self, time_ns: int | None) -> None:
        """Do all that happens before `time_ns`, or all that ever happens if nothing more is handed over."""

    def throttle(self, bitrate_mbps: Mapping[int, float]) -> None:
        """From now on these senders send at these bitrates, and no others are slowed."""


@dataclass
class _Backlog:
    """What a sender has still to send: when each waiting frame starts, and when the last one ends."""

    starts_ns: deque[int] = field(default_factory=deque)
    busy_until_ns: int = 0

    def room(self, time_ns: int, limit: int) -> bool:
        """Whether another frame finds a place at `time_ns`."""
        while self.starts_ns and self.starts_ns[0] <= time_ns:
            self.starts_ns.popleft()
        return len(self.starts_ns) < limit

    def take(self, ready_ns: int, airtime_ns: int) -> int:
        """Put one more frame at the end; returns when it will have been sent."""
        start_ns = max(ready_ns, self.busy_until_ns)
        self.starts_ns.append(start_ns)
        self.busy_until_ns = start_ns + airtime_ns
        return self.busy_until_ns


class TransmitQueue:
    """The sender's own queue: random access delay, airtime at `radio.bitrate_mbps`, at most `queue_frames` waiting.

    With a physical radio the airtime is that of 802.11p.

    When a frame ends is known at once. Faults `throttle` some senders.
    """

    def __init__(self, seed: int, radio: Radio) -> None:
        self._draws = Draws(seed, "access")
        self._access_jitter_ns = radio.access_jitter_ms * NS_PER_MS
        self._bitrate_mbps = radio.bitrate_mbps
        self._is_physical = radio.is_physical
        self._limit = radio.queue_frames
        self._backlogs: dict[int, _Backlog] = {}
        self._throttled_mbps: dict[int, float] = {}
        self._unthrottled: dict[int, _Backlog] = {}
        self.sent: list[Frame] = []

    def throttle(self, bitrate_mbps: Mapping[int, float]) -> None:
        """From now on these senders send at these bitrates, and no others are slowed.

        Who no longer is goes on as if it had never been: what waits is sent as it was decided, but nothing new
        waits behind it, so that the fault ends with its end however slow it was.
        """
        for sender in self._throttled_mbps.keys() - bitrate_mbps.keys():
            self._backlogs[sender] = self._unthrottled.pop(sender)
        for sender in bitrate_mbps.keys() - self._throttled_mbps.keys():
            backlog = self._backlogs.get(sender, _Backlog())
            self._unthrottled[sender] = _Backlog(backlog.starts_ns.copy(), backlog.busy_until_ns)
        self._throttled_mbps = dict(bitrate_mbps)

    def enqueue(self, frame: Frame) -> None:
        """Decide `queue_full`, or when the frame has left the sender."""
        jitter_ns = int(self._access_jitter_ns * self._draws.uniform(frame.sender, frame.seq, 1, frame.draw)[0])
        bitrate_mbps = self._bitrate_mbps
        if (unthrottled := self._unthrottled.get(frame.sender)) is not None:
            self._put(frame, unthrottled, jitter_ns, bitrate_mbps)
            bitrate_mbps = min(bitrate_mbps, self._throttled_mbps[frame.sender])
        backlog = self._backlogs.setdefault(frame.sender, _Backlog())
        end_ns = self._put(frame, backlog, jitter_ns, bitrate_mbps)
        if end_ns is None:
            frame.sender_outcome, frame.end_ns = Outcome.queue_full, frame.sent_ns
        else:
            frame.end_ns = end_ns
        self.sent.append(frame)

    def _put(self, frame: Frame, backlog: _Backlog, jitter_ns: int, bitrate_mbps: float) -> int | None:
        if not backlog.room(frame.sent_ns, self._limit):
            return None
        airtime = round(frame.size_bytes * 8_000 / bitrate_mbps)
        if self._is_physical:  # a throttled sender takes even longer
            airtime = max(airtime_ns(frame.size_bytes, self._bitrate_mbps), airtime)
        return backlog.take(frame.sent_ns + jitter_ns, airtime)

    def next_ns(self) -> int | None:
        """Nothing happens between a frame's handing over and its arrival."""
        return None

    def run(self, time_ns: int | None) -> None:
        """Nothing to be done."""


class Throttle:
    """What stands before an access whose own bitrate is fixed: throttled senders' frames come to it slowly."""

    def __init__(self) -> None:
        self._slow: dict[int, tuple[float, _Backlog]] = {}

    def set(self, bitrate_mbps: Mapping[int, float]) -> None:
        """From now on these senders are throttled, and no others; what waits then comes as it was decided."""
        kept = {sender: backlog for sender, (_, backlog) in self._slow.items()}
        self._slow = {sender: (mbps, kept.get(sender, _Backlog())) for sender, mbps in bitrate_mbps.items()}

    def slows(self, sender: int) -> bool:
        """Whether a sender is throttled now."""
        return sender in self._slow

    def put(self, frame: Frame, ready_ns: int, limit: int) -> int | None:
        """When a frame comes to the access; None if `limit` others wait before it."""
        bitrate_mbps, backlog = self._slow[frame.sender]
        if not backlog.room(frame.sent_ns, limit):
            return None
        return backlog.take(ready_ns, round(frame.size_bytes * 8_000 / bitrate_mbps))
