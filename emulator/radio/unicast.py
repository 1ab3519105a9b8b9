"""Frames to single vehicles: acknowledgements, attempts, and the results that their senders are told.

The timing of the exchange is that of 802.11-2020: an acknowledgement follows a frame after SIFS, whatever the state
of the medium. Its sender waits for it for SIFS, a slot, and the time of a preamble. A frame without one is
transmitted again after a backoff from a window that doubles, up to the short retry limit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from heapq import heappop, heappush
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from emulator.radio.dot11p import PREAMBLE_NS, SIFS_NS, SLOT_NS, airtime_ns
from emulator.radio.faults import ActiveLinkFaults
from emulator.radio.frames import BROADCAST, NO_CAUSE, Frame, Receptions
from emulator.radio.medium import Medium
from emulator.radio.outcomes import Outcome
from emulator.radio.trace import Trace
from vnet.types import IntArray, Mask

MOST_ATTEMPTS = 7
"""Transmissions of a frame without an acknowledgement: dot11ShortRetryLimit (802.11-2020, annex C)."""
ACK_BYTES = 14
"""Length of an acknowledgement."""
BASIC_RATES_MBPS = (3.0, 6.0, 12.0)
"""Mandatory bit rates in 10 MHz; an acknowledgement has the highest that is not above that of its frame."""
ACK_TIMEOUT_NS = SIFS_NS + SLOT_NS + PREAMBLE_NS
"""Time from the end of a frame until its acknowledgement must have begun to be received.

The standard adds aRxPHYStartDelay to SIFS and a slot. It is taken as the time of preamble and SIGNAL field, 40 µs
in 10 MHz, as ns-3 does, which cites table 17-21 of 802.11-2020 for 20 µs in 20 MHz; the edition of 2012 had 25 µs.
"""
EIFS_NS = SIFS_NS + airtime_ns(ACK_BYTES, BASIC_RATES_MBPS[0])
"""Time for which AIFS begins later after a frame that was received in error: EIFS - DIFS."""
IN_ERROR = (Outcome.faded.value, Outcome.collided.value, Outcome.lost.value)
"""Outcomes after which a receiver that was locked on the frame waits for EIFS."""
_ACK_DRAW, _ATTEMPT_BITS, _SENDER_BITS = 1 << 62, 48, 40
"""Places of what distinguishes the random draws of attempts and acknowledgements."""


class Result(NamedTuple):
    """Result of frame `number` of the node number `sender`, which learns it at `time_ns`."""

    time_ns: int
    sender: int
    number: int
    delivered: bool
    attempts: int


def ack_rate_mbps(bitrate_mbps: float) -> float:
    """Return the bit rate of the acknowledgement of a frame."""
    return max(rate for rate in BASIC_RATES_MBPS if rate <= bitrate_mbps)


def ack_airtime_ns(bitrate_mbps: float) -> int:
    """Return the airtime of the acknowledgement of a frame at this bit rate."""
    return airtime_ns(ACK_BYTES, ack_rate_mbps(bitrate_mbps))


def acknowledgement_of(frame: Frame) -> Frame:
    """Return the acknowledgement of a frame, as its addressee sends it, at the scenario's power.

    It has the topology and the faults of its frame, but for rules of the user's own, which see programs' frames.
    """
    effects = frame.effects
    if isinstance(effects, ActiveLinkFaults):
        effects = replace(effects, ruled=())
    return Frame(
        sender=frame.to,
        seq=(frame.sender + 1 << _SENDER_BITS) + frame.seq,
        sent_ns=frame.end_ns,
        size_bytes=ACK_BYTES,
        topology=frame.topology,
        effects=effects,
        bitrate_mbps=ack_rate_mbps(frame.bitrate_mbps),
        draw=frame.draw + _ACK_DRAW,
    )


def retry_of(frame: Frame, copy: int) -> Frame:
    """Return the next attempt of a frame, which is copy number `copy` of it."""
    assert frame.decoded is not None
    return replace(
        frame,
        copy=copy,
        draw=frame.draw + (1 << _ATTEMPT_BITS),
        attempt=frame.attempt + 1,
        row=-1,
        received_as=frame.received_as or (frame if frame.decoded[frame.to] else None),
        is_missed=False,
        decoded=None,
        garbled=None,
        signal=None,
        ack=None,
        altered={},
        answers={},
    )


class Deferral:
    """Virtual carrier sense of `count` vehicles: NAV, and EIFS after a frame that was received in error."""

    def __init__(self, count: int) -> None:
        self._nav_ns: IntArray = np.zeros(count, np.int64)
        self._eifs_ns: IntArray = np.zeros(count, np.int64)

    def hear(self, frame: Frame, now_ns: int) -> None:
        """Take note of a frame that ends: who could read it, and who could not."""
        assert frame.decoded is not None and frame.garbled is not None
        self._eifs_ns[frame.decoded] = now_ns
        self._eifs_ns[frame.garbled] = now_ns + EIFS_NS
        if frame.to != BROADCAST:
            others = frame.decoded.copy()
            others[frame.to] = False
            until_ns = now_ns + SIFS_NS + ack_airtime_ns(frame.bitrate_mbps)
            self._nav_ns[others] = np.maximum(self._nav_ns[others], until_ns)

    def reserved_ns(self, node: int) -> int:
        """Return the time until which others have reserved the medium at `node`."""
        return int(self._nav_ns[node])

    def until_ns(self, node: int, idle_ns: int) -> int:
        """Return from when on AIFS counts at `node`, where the medium is idle since `idle_ns`."""
        return max(idle_ns, int(self._nav_ns[node]), int(self._eifs_ns[node]))


class Unicasts:
    """The frames to single vehicles that programs have sent, and the results that their nodes have yet to be told.

    A node learns a result `delay_ns` after its MAC knows it.
    """

    def __init__(self, delay_ns: int) -> None:
        self._delay_ns = delay_ns
        self._tickets = 0
        self._open: dict[int, tuple[int, int]] = {}
        self._results: list[Result] = []
        self._duplicates: list[tuple[int, int, int, Frame]] = []
        """Heap of attempts received once more: arrival time, row, addressee, and the attempt received first."""
        self.counts = {"sent": 0, "delivered": 0, "attempts": 0}
        """Frames to single vehicles whose results are known, those acknowledged, and transmissions."""

    @property
    def are_open(self) -> bool:
        """True if a result is not known yet, or has not been taken."""
        return bool(self._open or self._results)

    def register(self, sender: int, number: int) -> int:
        """Return a ticket for frame `number` of a node."""
        self._tickets += 1
        self._open[self._tickets] = sender, number
        return self._tickets

    def refuse(self, sender: int, number: int, time_ns: int) -> None:
        """Note that a frame is addressed to nobody."""
        self._conclude(self.register(sender, number), False, 0, time_ns)

    def leave(self, frame: Frame) -> None:
        """Note that a frame has left its queue at `frame.end_ns` without being transmitted."""
        self._conclude(frame.ticket, False, 0, frame.end_ns)

    def finish(self, frame: Frame, time_ns: int) -> None:
        """Note that the last attempt of a frame is over."""
        self._conclude(frame.ticket, frame.acked, frame.attempt, time_ns)

    def _conclude(self, ticket: int, delivered: bool, attempts: int, time_ns: int) -> None:
        if asked := self._open.pop(ticket, None):
            heappush(self._results, Result(time_ns + self._delay_ns, *asked, delivered, attempts))
            self.counts["sent"] += 1
            self.counts["delivered"] += delivered
            self.counts["attempts"] += attempts

    def note_duplicates(
        self,
        frames: Sequence[Frame],
        first_row: int,
        outcome: NDArray[np.uint8],
        arrival_ns: IntArray,
        trace: Trace,
    ) -> None:
        """Note the attempts received once more; outcome and arrival (n,) are those of rows from the first on.

        One that would arrive before the attempt received first stays a duplicate: that may still find somebody.
        """
        for frame in frames:
            index = frame.row - first_row
            first = frame.received_as
            if first is None or outcome[index] != Outcome.duplicate:
                continue
            if arrival_ns[index] >= trace.rows(np.array([first.row]))["arrival_ns"][0]:
                heappush(self._duplicates, (int(arrival_ns[index]), frame.row, frame.to, first))

    def miss_duplicates(self, time_ns: int, up: Mask, trace: Trace, counts: dict[Outcome, int]) -> None:
        """Change attempts that would arrive by `time_ns` to `receiver_down`, where nobody got the one before.

        The addressee is down (`up` (N,)), and was so when the attempt arrived that was received first.
        """
        while self._duplicates and self._duplicates[0][0] <= time_ns:
            arrival_ns, row, to, first = heappop(self._duplicates)
            if first.is_missed and not up[to]:
                trace.miss(row, arrival_ns)
                counts[Outcome.duplicate] -= 1
                counts[Outcome.receiver_down] += 1

    def forget(self, node: int) -> None:
        """Forget what a node that goes down has asked for."""
        self._open = {ticket: asked for ticket, asked in self._open.items() if asked[0] != node}
        self._results = sorted(result for result in self._results if result.sender != node)

    def next_ns(self) -> int | None:
        """Return the time of the next result, or None."""
        return self._results[0].time_ns if self._results else None

    def take(self, time_ns: int) -> list[Result]:
        """Remove and return the results up to `time_ns`, in order."""
        taken = []
        while self._results and self._results[0].time_ns <= time_ns:
            taken.append(heappop(self._results))
        return taken


def address(
    frame: Frame, outcome: NDArray[np.uint8], locked: Mask, cause: NDArray[np.int16], is_up: bool = True
) -> None:
    """Note who could read a frame, and who not; of a frame to one vehicle keep its reception alone.

    `outcome` and `cause` (N,) are those of all vehicles, as if it were a broadcast, and are changed; `locked` marks
    the vehicles whose receivers were locked on the frame.
    """
    frame.decoded = outcome == Outcome.pending.value
    in_error = np.zeros(len(outcome), bool)
    for each in IN_ERROR:
        in_error |= outcome == each
    frame.garbled = locked & in_error
    if frame.to == BROADCAST:
        return
    others = np.arange(len(outcome)) != frame.to
    outcome[others], cause[others] = Outcome.out_of_range.value, NO_CAUSE
    if frame.decoded[frame.to] and not is_up:  # whoever is down acknowledges nothing, and knows nothing again
        frame.decoded[frame.to], outcome[frame.to] = False, Outcome.receiver_down.value
    elif frame.decoded[frame.to] and frame.received_as is not None and not frame.received_as.is_missed:
        outcome[frame.to] = Outcome.duplicate.value


class SharedMedium(Protocol):
    """Part of the MAC that decides what becomes of frames to single vehicles."""

    has_eifs: bool
    is_up: Callable[[int], bool]
    medium: Medium
    unicasts: Unicasts


def address_all(frames: Sequence[Frame], receptions: Receptions, mac: SharedMedium) -> None:
    """Note who could read frames where others act on it, and what becomes of those to single vehicles."""
    for index, frame in enumerate(frames):
        if frame.ticket and (not frame.attempt or frame.sender_outcome != Outcome.pending):
            mac.unicasts.leave(frame)  # it is over, or an older one was broadcast in its place
        if not (frame.attempt or mac.has_eifs):
            continue
        outcome, cause = receptions.outcome[index], receptions.cause[index]
        if frame.sender_outcome == Outcome.pending:
            is_up = frame.to == BROADCAST or mac.is_up(frame.to)
            address(frame, outcome, mac.medium.locked(frame), cause, is_up)
        elif frame.attempt:
            outcome[:] = Outcome.out_of_range.value
            outcome[frame.to] = frame.sender_outcome.value  # also if its addressee is out of range: it was not sent
