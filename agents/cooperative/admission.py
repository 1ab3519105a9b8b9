"""Admission: the frames that a vehicle reads, and the reasons for which it rejects the others.

A frame is judged here by itself, and against what its sender has sent before. Whether it agrees with what others
send is judged where it is used.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Generic, Protocol, TypeVar

from agents.cooperative.frame import FrameError, short_name
from agents.cooperative.vehicle_cache import VehicleCache, add_vehicle
from vnet import Packet

STALE_PERIODS = 3
"""Age in periods beyond which a frame is stale: the radio takes less than one, a late vehicle another."""
EPOCH_MARGIN = 10
"""Epochs by which a frame may be ahead of one a period since the start, the most that a network begins. A frame
that claims more is absurd, and its epoch would spread."""
MAX_SENDERS = 255
"""Number of senders that are read: a frame can name no more as heard. Known senders go before new ones."""
FORGET_PERIODS = 10
"""Periods between two times at which senders are forgotten: it need not be exact."""


class JudgedFrame(Protocol):
    """The part of a frame that is judged, whatever its layout."""

    @property
    def name(self) -> str:
        """The sender's short name."""
        ...

    @property
    def fix_time_ns(self) -> int:
        """Time of the sender's fix."""
        ...

    @property
    def epoch(self) -> int:
        """Epoch of the consensus."""
        ...

    @property
    def fingerprint(self) -> bytes:
        """Bytes that come from the noise of the sender's receiver."""
        ...


F = TypeVar("F", bound=JudgedFrame)


class Admission(Generic[F]):
    """The frames that the vehicle `name` admits.

    rejected: number of rejected frames by reason: those of `FrameError`, and replayed, stale, absurd,
        too_many_senders, duplicate.
    ids: node ids of the senders by short name.
    """

    def __init__(self, name: str, period_ns: int, decode: VehicleCache[[bytes], F], several: bool = False) -> None:
        """Frames are decoded by `decode`; with `several`, a sender may send several with the same fix."""
        add_vehicle(self)
        self._decode = decode
        self.rejected: Counter[str] = Counter()
        self.ids: dict[str, str] = {}
        self._name = name
        self._period_ns = period_ns
        self._several = several
        self._newest_ns: dict[str, int] = {}
        self._first_sender: dict[tuple[int, bytes], str] = {}
        self._early: dict[tuple[str, int], tuple[str, F]] = {}
        self._forgotten_ns = 0

    def admit(self, packets: Iterable[Packet], now_ns: int) -> list[tuple[str, F]]:
        """Return the frames to read, with their senders' short names, in the order of their arrival.

        In real time a vehicle that is late with its work finds frames of the next period: they wait for it.
        """
        if now_ns - self._forgotten_ns >= FORGET_PERIODS * self._period_ns:
            self._forget(now_ns)
        waiting, self._early = self._early, {}
        frames, decode = list(waiting.values()), self._decode.cached
        for packet in packets:
            try:
                frames.append((packet.sender, decode(packet.payload)))
            except FrameError as error:
                self.rejected[str(error)] += 1
        admitted = []
        newest_ns, first_sender = self._newest_ns, self._first_sender
        period_ns, late_ns = now_ns - now_ns % self._period_ns, STALE_PERIODS * self._period_ns
        largest_epoch = EPOCH_MARGIN + now_ns // self._period_ns
        for node, frame in frames:
            sender, time_ns = short_name(node), frame.fix_time_ns
            if frame.name != sender or sender == self._name:
                self.rejected["replayed"] += 1
            elif not -late_ns <= now_ns - time_ns <= late_ns:
                self.rejected["stale"] += 1
            elif frame.epoch > largest_epoch:
                self.rejected["absurd"] += 1
            elif sender not in newest_ns and len(newest_ns) + len(self._early) >= MAX_SENDERS:
                self.rejected["too_many_senders"] += 1
            elif not self._several and (
                newest_ns.get(sender, -1) >= time_ns or (self._early and (sender, time_ns) in self._early)
            ):
                self.rejected["duplicate"] += 1
            elif first_sender.setdefault((time_ns, frame.fingerprint), sender) != sender:
                self.rejected["replayed"] += 1
            elif time_ns > period_ns:
                self._early[sender, time_ns] = node, frame
            else:
                self.ids[sender] = node
                newest_ns[sender] = time_ns
                admitted.append((sender, frame))
        return admitted

    def claim(self, sender: str, time_ns: int, fingerprint: bytes) -> None:
        """Note that `sender` is the first with what comes from a fix: no two receivers' noise is the same."""
        self._first_sender.setdefault((time_ns, fingerprint), sender)

    def _forget(self, now_ns: int) -> None:
        """Forget senders and fixes that no frame can concern that is not stale."""
        self._forgotten_ns = now_ns
        oldest_ns = now_ns - (STALE_PERIODS + 1) * self._period_ns
        self._first_sender = {key: sender for key, sender in self._first_sender.items() if key[0] >= oldest_ns}
        self._newest_ns = {name: time_ns for name, time_ns in self._newest_ns.items() if time_ns >= oldest_ns}
        self.ids = {name: node for name, node in self.ids.items() if name in self._newest_ns}
