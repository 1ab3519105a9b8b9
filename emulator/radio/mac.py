"""Interface of the MAC, and the default MAC: a transmit queue for each sender, without a shared medium."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from emulator.radio.dot11p import airtime_ns
from emulator.radio.frames import Frame, Receptions, Transmission, frame_keys
from emulator.radio.outcomes import Outcome
from emulator.scenario.random_streams import Draws
from emulator.scenario.scenario import Radio
from vnet.types import Array
from vnet.units import NS_PER_MS


class Mac:
    """A MAC: it takes frames, and decides when each is on air. What it does not have, it answers with "none".

    `sent` holds the transmissions that have left their senders since the engine last took them.

    A MAC may have events of its own, at which no program runs. `run` processes the events strictly before a time,
    so that all frames enqueued at this time are there before its events are processed. Where what a MAC does next
    depends on who can read a transmission that has ended, `run` and `step` return it. Its receptions must then be
    judged, and those of all others in `sent`, before the next call.
    """

    shares_medium: ClassVar[bool] = False
    """True if the vehicles share a medium, and sense how busy it is."""
    acknowledges: ClassVar[bool] = False
    """True if frames to one vehicle are acknowledged."""

    def __init__(self) -> None:
        self.sent: list[Transmission] = []

    def take_sent(self) -> list[Transmission]:
        """Remove and return the transmissions of `sent`, with all that decides about their receptions."""
        sent, self.sent = self.sent, []
        return sent

    def enqueue(self, transmissions: Sequence[Transmission]) -> None:
        """Take frames sent at one instant, in order; set `sender_outcome` and `end_ns` of one that is in `sent`."""
        raise NotImplementedError

    def throttle(self, bitrate_mbps: Mapping[int, float]) -> None:
        """Throttle exactly these senders, to these bitrates, from now on."""
        raise NotImplementedError

    def next_ns(self) -> int | None:
        """Return the time of the next event, or None."""
        return None

    def run(self, time_ns: int | None) -> Transmission | None:
        """Process all events before `time_ns`, or all if it is None; return a transmission to judge first."""
        return None

    def step(self) -> Transmission | None:
        """Process the next event; return a transmission that must be judged before the event after it."""
        return None

    def judge(self, transmissions: Sequence[Transmission], receptions: Receptions) -> None:
        """Note who could read transmissions, and what becomes of those to single vehicles."""

    def busy_ratios(self, time_ns: int) -> list[Array]:
        """Return the channel busy ratios (N,) of every window that ends by `time_ns`, which `run` has reached."""
        return []

    def busy_ratios_at(self, time_ns: int) -> Array | None:
        """Return the channel busy ratios (N,) of the 100 ms before `time_ns`, or None without a medium."""
        return None


@dataclass
class _Backlog:
    """A sender's waiting frames: the time at which each starts, and the time at which the last one ends."""

    starts_ns: deque[int] = field(default_factory=deque)
    busy_until_ns: int = 0

    def room(self, time_ns: int, limit: int) -> bool:
        """Return true if another frame may wait at `time_ns`."""
        while self.starts_ns and self.starts_ns[0] <= time_ns:
            self.starts_ns.popleft()
        return len(self.starts_ns) < limit

    def take(self, ready_ns: int, airtime_ns: int) -> int:
        """Append a frame; return the time at which its transmission ends."""
        start_ns = max(ready_ns, self.busy_until_ns)
        self.starts_ns.append(start_ns)
        self.busy_until_ns = start_ns + airtime_ns
        return self.busy_until_ns


class TransmitQueue(Mac):
    """A transmit queue for each sender: random access delay, airtime, and at most `radio.queue_frames` waiting.

    The airtime is the frame's bits at its bit rate; with a physical radio it is that of 802.11p. A frame's
    end is known as soon as it is enqueued. Faults `throttle` some senders.
    """

    def __init__(self, seed: int, radio: Radio) -> None:
        super().__init__()
        self._draws = Draws(seed, "access")
        self._access_jitter_ns = radio.access_jitter_ms * NS_PER_MS
        self._is_physical = radio.is_physical
        self._limit = radio.queue_frames
        self._backlogs: dict[int, _Backlog] = {}
        self._throttled_mbps: dict[int, float] = {}
        self._unthrottled: dict[int, _Backlog] = {}

    def throttle(self, bitrate_mbps: Mapping[int, float]) -> None:
        """Throttle exactly these senders, to these bitrates, from now on.

        A sender that is no longer throttled continues as if it had never been: waiting frames are sent at the times
        already decided, but new frames do not wait for them. So the fault's effect ends with it.
        """
        for sender in self._throttled_mbps.keys() - bitrate_mbps.keys():
            self._backlogs[sender] = self._unthrottled.pop(sender)
        for sender in bitrate_mbps.keys() - self._throttled_mbps.keys():
            backlog = self._backlogs.get(sender, _Backlog())
            self._unthrottled[sender] = _Backlog(backlog.starts_ns.copy(), backlog.busy_until_ns)
        self._throttled_mbps = dict(bitrate_mbps)

    def enqueue(self, transmissions: Sequence[Transmission]) -> None:
        """Decide `queue_full`, or the time at which each frame's transmission ends."""
        jitter_ns = np.zeros(len(transmissions))
        if self._access_jitter_ns and len(transmissions):
            some = np.ones(len(transmissions), np.intp)
            jitter_ns = self._access_jitter_ns * self._draws.uniform_at(frame_keys(transmissions), some, some - 1)
        for sent, each_ns in zip(transmissions, jitter_ns.tolist(), strict=True):
            self._take(sent, int(each_ns))

    def _take(self, sent: Transmission, jitter_ns: int) -> None:
        frame = sent.frame
        bitrate_mbps = frame.bitrate_mbps
        if (unthrottled := self._unthrottled.get(frame.sender)) is not None:
            self._put(frame, unthrottled, jitter_ns, bitrate_mbps)
            bitrate_mbps = min(bitrate_mbps, self._throttled_mbps[frame.sender])
        backlog = self._backlogs.get(frame.sender)
        if backlog is None:
            backlog = self._backlogs[frame.sender] = _Backlog()
        end_ns = self._put(frame, backlog, jitter_ns, bitrate_mbps)
        if end_ns is None:
            sent.sender_outcome, sent.end_ns = Outcome.queue_full, frame.sent_ns
        else:
            sent.end_ns = end_ns
        self.sent.append(sent)

    def _put(self, frame: Frame, backlog: _Backlog, jitter_ns: int, bitrate_mbps: float) -> int | None:
        if not backlog.room(frame.sent_ns, self._limit):
            return None
        airtime = round(frame.size_bytes * 8_000 / bitrate_mbps)
        if self._is_physical:  # a throttled sender takes even longer
            airtime = max(airtime_ns(frame.size_bytes, frame.bitrate_mbps), airtime)
        return backlog.take(frame.sent_ns + jitter_ns, airtime)


class ThrottledMac(Mac):
    """A MAC of fixed bitrate with a slow queue before it, through which throttled senders' frames pass."""

    def __init__(self) -> None:
        super().__init__()
        self._slow: dict[int, tuple[float, _Backlog]] = {}

    def throttle(self, bitrate_mbps: Mapping[int, float]) -> None:
        """Throttle exactly these senders from now on; the times of waiting frames do not change."""
        kept = {sender: backlog for sender, (_, backlog) in self._slow.items()}
        self._slow = {sender: (mbps, kept.get(sender, _Backlog())) for sender, mbps in bitrate_mbps.items()}

    def enqueue(self, transmissions: Sequence[Transmission]) -> None:
        """Take frames; each is ready after its access jitter, and not before the sender's earlier frames."""
        for sent in transmissions:
            self._take(sent)

    def _take(self, sent: Transmission) -> None:
        raise NotImplementedError

    def _slows(self, sender: int) -> bool:
        """Return true if a sender is throttled now."""
        return sender in self._slow

    def _put_slowly(self, frame: Frame, ready_ns: int, limit: int) -> int | None:
        """Return the time at which a throttled sender's frame is ready; None if `limit` others wait before it."""
        bitrate_mbps, backlog = self._slow[frame.sender]
        if not backlog.room(frame.sent_ns, limit):
            return None
        return backlog.take(ready_ns, round(frame.size_bytes * 8_000 / bitrate_mbps))
