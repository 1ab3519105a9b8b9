"""Frames to single vehicles: acknowledgements, attempts, and the results that their senders are told.

The timing of the exchange is that of 802.11-2020: an acknowledgement follows a frame after SIFS, whatever the state
of the medium. Its sender waits for it for SIFS, a slot, and the time of a preamble. A frame without one is
transmitted again after a backoff from a window that doubles, up to the short retry limit.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from heapq import heappop, heappush

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from emulator.radio.dot11p import PREAMBLE_NS, SIFS_NS, SLOT_NS, airtime_ns
from emulator.radio.faults import ActiveLinkFaults
from emulator.radio.frames import BROADCAST, NO_CAUSE, Frame, Transmission, UnicastResult
from emulator.radio.outcomes import Outcome
from emulator.radio.trace import Trace
from vnet.types import IntArray, Mask

MOST_ATTEMPTS = 7
"""Transmissions of a frame without an acknowledgement: dot11ShortRetryLimit (802.11-2020, annex C)."""
ACK_BYTES = 14
"""Length of an acknowledgement."""
_ACKNOWLEDGEMENT = bytes(ACK_BYTES)
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


def ack_rate_mbps(bitrate_mbps: float) -> float:
    """Return the bit rate of the acknowledgement of a frame."""
    return max(rate for rate in BASIC_RATES_MBPS if rate <= bitrate_mbps)


def ack_airtime_ns(bitrate_mbps: float) -> int:
    """Return the airtime of the acknowledgement of a frame at this bit rate."""
    return airtime_ns(ACK_BYTES, ack_rate_mbps(bitrate_mbps))


def acknowledgement_of(sent: Transmission) -> Transmission:
    """Return the acknowledgement of a transmission, as its addressee sends it, at the scenario's power.

    It has the topology and the faults of its frame, but for rules of the user's own, which see programs' frames.
    """
    frame, effects = sent.frame, sent.frame.effects
    if isinstance(effects, ActiveLinkFaults):
        effects = dataclasses.replace(effects, ruled=())
    return Transmission(
        Frame(
            sender=frame.to,
            seq=(frame.sender + 1 << _SENDER_BITS) + frame.seq,
            sent_ns=sent.end_ns,
            payload=_ACKNOWLEDGEMENT,
            topology=frame.topology,
            effects=effects,
            bitrate_mbps=ack_rate_mbps(frame.bitrate_mbps),
            draw=frame.draw + _ACK_DRAW,
        )
    )


def retry_of(sent: Transmission, copy: int) -> Transmission:
    """Return the next attempt of a frame, which is copy number `copy` of it."""
    assert sent.decoded is not None
    frame = replace(sent.frame, copy=copy, draw=sent.frame.draw + (1 << _ATTEMPT_BITS))
    received_as = sent.received_as or (sent if sent.decoded[frame.to] else None)
    return Transmission(frame, sent.attempt + 1, received_as=received_as)


class Deferral:
    """Virtual carrier sense of `count` vehicles: NAV, and EIFS after a frame that was received in error."""

    def __init__(self, count: int) -> None:
        self._nav_ns: IntArray = np.zeros(count, np.int64)
        self._eifs_ns: IntArray = np.zeros(count, np.int64)

    def hear(self, sent: Transmission, now_ns: int) -> None:
        """Take note of a transmission that ends: who could read it, and who could not."""
        assert sent.decoded is not None and sent.garbled is not None
        self._eifs_ns[sent.decoded] = now_ns
        self._eifs_ns[sent.garbled] = now_ns + EIFS_NS
        if sent.attempt:
            others = sent.decoded.copy()
            others[sent.frame.to] = False
            until_ns = now_ns + SIFS_NS + ack_airtime_ns(sent.frame.bitrate_mbps)
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

    def __init__(self, delay_ns: int, trace: Trace) -> None:
        self._delay_ns = delay_ns
        self._trace = trace
        self._tickets = 0
        self._open: dict[int, tuple[int, int]] = {}
        self._results: list[UnicastResult] = []
        self._duplicates: list[tuple[int, int, int, Transmission]] = []
        """Heap of attempts received once more: arrival time, row, addressee, and the attempt received first."""

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

    def leave(self, sent: Transmission) -> None:
        """Note that a frame has left its queue at `end_ns` without being transmitted."""
        self._conclude(sent.frame.ticket, False, 0, sent.end_ns)

    def finish(self, sent: Transmission, time_ns: int) -> None:
        """Note that the last attempt of a frame is over."""
        self._conclude(sent.frame.ticket, sent.acked, sent.attempt, time_ns)

    def _conclude(self, ticket: int, delivered: bool, attempts: int, time_ns: int) -> None:
        if asked := self._open.pop(ticket, None):
            heappush(self._results, UnicastResult(time_ns + self._delay_ns, *asked, delivered, attempts))

    def note_duplicates(
        self,
        transmissions: Sequence[Transmission],
        first_row: int,
        outcome: NDArray[np.uint8],
        arrival_ns: IntArray,
    ) -> None:
        """Note the attempts received once more; outcome and arrival (n,) are those of rows from the first on.

        One that would arrive before the attempt received first stays a duplicate: that may still find somebody.
        """
        for sent in transmissions:
            index = sent.row - first_row
            first = sent.received_as
            if first is None or outcome[index] != Outcome.duplicate:
                continue
            if arrival_ns[index] >= self._trace.rows(np.array([first.row]))["arrival_ns"][0]:
                heappush(self._duplicates, (int(arrival_ns[index]), sent.row, sent.frame.to, first))

    def miss_duplicates(self, time_ns: int, up: Mask, counts: dict[Outcome, int]) -> None:
        """Change attempts that would arrive by `time_ns` to `receiver_down`, where nobody got the one before.

        The addressee is down (`up` (N,)), and was so when the attempt arrived that was received first.
        """
        while self._duplicates and self._duplicates[0][0] <= time_ns:
            arrival_ns, row, to, first = heappop(self._duplicates)
            if first.is_missed and not up[to]:
                self._trace.miss(row, arrival_ns)
                counts[Outcome.duplicate] -= 1
                counts[Outcome.receiver_down] += 1

    def forget(self, node: int) -> None:
        """Forget what a node that goes down has asked for."""
        self._open = {ticket: asked for ticket, asked in self._open.items() if asked[0] != node}
        self._results = sorted(result for result in self._results if result.sender != node)

    def next_ns(self) -> int | None:
        """Return the time of the next result, or None."""
        return self._results[0].time_ns if self._results else None

    def take(self, time_ns: int) -> list[UnicastResult]:
        """Remove and return the results up to `time_ns`, in order."""
        taken = []
        while self._results and self._results[0].time_ns <= time_ns:
            taken.append(heappop(self._results))
        return taken


def address(
    sent: Transmission, outcome: NDArray[np.uint8], locked: Mask, cause: NDArray[np.int16], is_up: bool
) -> None:
    """Note who could read a frame, and who not; of a frame to one vehicle keep its reception alone.

    `outcome` and `cause` (N,) are those of all vehicles, as if it were a broadcast, and are changed; `locked` marks
    the vehicles whose receivers were locked on the frame. `is_up` is true if its addressee is up.
    """
    to = sent.frame.to
    sent.decoded = outcome == Outcome.pending.value
    in_error = np.zeros(len(outcome), bool)
    for each in IN_ERROR:
        in_error |= outcome == each
    sent.garbled = locked & in_error
    if to == BROADCAST:
        return
    others = np.arange(len(outcome)) != to
    outcome[others], cause[others] = Outcome.out_of_range.value, NO_CAUSE
    if sent.decoded[to] and not is_up:  # whoever is down acknowledges nothing, and knows nothing again
        sent.decoded[to], outcome[to] = False, Outcome.receiver_down.value
    elif sent.decoded[to] and sent.received_as is not None and not sent.received_as.is_missed:
        outcome[to] = Outcome.duplicate.value
