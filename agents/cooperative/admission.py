"""Which frames a vehicle reads at all, and why not the others: counted by reason.

What is judged here is each frame by itself, and against what its sender has said before. Whether what it says fits
what others say is judged where it is used.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from agents.cooperative.frame import CooperativeFrame, FrameError, decode, short_name
from vnet import Packet
from vnet.types import Array

STALE_PERIODS = 3
EPOCH_MARGIN = 10
"""A network starts at most one epoch a period: a frame that claims more is absurd, and would spread."""
MOST_SENDERS = 255
"""A frame can name no more as heard. Known senders keep their place for as long as they are heard."""
FORGET_PERIODS = 10


class Admission:
    """The gate of the vehicle `name`. `rejected` counts by reason; `ids` are node ids of senders by short name.

    `again`: a sender may send several frames with the same fix.
    """

    def __init__(self, name: str, period_ns: int, again: bool = False) -> None:
        self.rejected: Counter[str] = Counter()
        self.ids: dict[str, str] = {}
        self._name = name
        self._period_ns = period_ns
        self._again = again
        self._newest_ns: dict[str, int] = {}
        self._said_by: dict[tuple[int, bytes], str] = {}
        self._early: dict[tuple[str, int], tuple[str, CooperativeFrame]] = {}
        self._forgot_ns = 0

    def admit(self, packets: Iterable[Packet], now_ns: int) -> list[tuple[str, CooperativeFrame]]:
        """The frames to read, with their senders' short names, in the order of their arrival.

        In real time a vehicle that is late with its work finds frames of the next period: they wait for it.
        """
        if now_ns - self._forgot_ns >= FORGET_PERIODS * self._period_ns:
            self._forget(now_ns)
        waiting, self._early = self._early, {}
        frames = list(waiting.values())
        for packet in packets:
            try:
                frames.append((packet.sender, decode(packet.payload)))
            except FrameError as error:
                self.rejected[str(error)] += 1
        admitted = []
        for node, frame in frames:
            sender = short_name(node)
            reason = self._objection(sender, frame, now_ns)
            if reason:
                self.rejected[reason] += 1
            elif frame.fix_time_ns > now_ns - now_ns % self._period_ns:
                self._early[sender, frame.fix_time_ns] = node, frame
            else:
                self.ids[sender] = node
                self._newest_ns[sender] = frame.fix_time_ns
                admitted.append((sender, frame))
        return admitted

    def _objection(self, sender: str, frame: CooperativeFrame, now_ns: int) -> str | None:
        """The reason not to read the frame, if there is one."""
        if frame.name != sender or sender == self._name:
            return "copy"
        if abs(now_ns - frame.fix_time_ns) > STALE_PERIODS * self._period_ns:
            return "stale"
        if frame.epoch > EPOCH_MARGIN + now_ns // self._period_ns:
            return "absurd"
        if sender not in self._newest_ns and len(self._newest_ns) + len(self._early) >= MOST_SENDERS:
            return "crowd"
        known = (sender, frame.fix_time_ns) in self._early or self._newest_ns.get(sender, -1) >= frame.fix_time_ns
        if known and not self._again:
            return "old"
        return None if self.said(sender, frame.fix_time_ns, frame.fix_m) else "copy"

    def said(self, sender: str, time_ns: int, fix_m: Array) -> bool:
        """Whether `sender` is the first with this fix (2,), as frames say it: no two agree to the centimetre."""
        return self._said_by.setdefault((time_ns, fix_m.tobytes()), sender) == sender

    def _forget(self, now_ns: int) -> None:
        """Drop what frames that are not stale cannot bear upon."""
        self._forgot_ns = now_ns
        oldest_ns = now_ns - (STALE_PERIODS + 1) * self._period_ns
        self._said_by = {key: sender for key, sender in self._said_by.items() if key[0] >= oldest_ns}
        self._newest_ns = {name: time_ns for name, time_ns in self._newest_ns.items() if time_ns >= oldest_ns}
        self.ids = {name: node for name, node in self.ids.items() if name in self._newest_ns}
