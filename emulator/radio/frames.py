"""What goes through the channel: frames, and the pairs of several frames with every receiver.

A frame keeps how things stood when it was handed over (who could hear whom, which faults acted), so that nothing
that happens while it waits or is on air can change its fate, in whatever pieces the engine's time passes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from emulator.radio.outcomes import PENDING, Outcome
from emulator.radio.topology import TopologySnapshot
from vnet.types import Mask

NO_CAUSE = -1
NOT_ON_AIR = -1


@dataclass(slots=True, eq=False)
class Signal:
    """A frame as it arrives at the receivers, (N,) each; at its own sender, with the power that it was sent with.

    `random_draws` are words of 64 random bits, which give the draws that decide about it. `power_mw` is 0 out of
    range.

    `locked` is where a receiver has set itself on this frame, or None where nothing kept it from doing so.
    `pieces` are the times until which the sum of all powers on air was so much (N,); none if it was alone.
    """

    random_draws: NDArray[np.uint64]
    power_mw: NDArray[np.float64]
    locked: NDArray[np.bool_] | None = None
    pieces: list[tuple[int, NDArray[np.float64]]] = field(default_factory=list)


@dataclass(slots=True, eq=False)
class Frame:
    """One broadcast; `sender` is a receiver number, `seq` counts the sender's frames.

    `copy` counts the times that a frame is sent again (by a fault); such a copy has a row, and luck, of its own:
    `draw` tells its draws from the original's, and depends only on the fault and on what it sends again. It goes
    under `name`, and `cause` is the number of the fault that sends or changes it.

    `topology` and `effects` are those of its handing over. `sender_outcome` is what its sender decides (oversize,
    queue_full, held_back, or pending if it was sent). It was on air from `on_air_ns`, NOT_ON_AIR if nobody knows,
    to `end_ns`. `altered` are the payloads that arrive with other bytes, by receiver.
    """

    sender: int
    seq: int
    sent_ns: int
    size_bytes: int
    topology: TopologySnapshot
    effects: LinkEffects
    copy: int = 0
    draw: int = 0
    payload: bytes = b""
    name: str = ""
    cause: int = NO_CAUSE
    sender_outcome: Outcome = Outcome.pending
    on_air_ns: int = NOT_ON_AIR
    end_ns: int = 0
    signal: Signal | None = None
    altered: dict[int, bytes] = field(default_factory=dict)


class LinkEffects(Protocol):
    """The effects of link faults on the frames sent while they act."""

    @property
    def lose(self) -> bool:
        """Whether any reception may be lost."""

    @property
    def change(self) -> bool:
        """Whether a reception may arrive later, more than once, or with other bytes."""

    @property
    def copy(self) -> bool:
        """Whether a reception may arrive more than once."""

    def losses(self, frame: Frame) -> Iterator[tuple[int, Mask]]:
        """Yield, in the order in which faults act, a fault's number and the receivers (N,) that lose the frame."""

    def changes(self, frame: Frame, index: int, receptions: Receptions) -> None:
        """Change the pending receptions of frame number `index`."""


class Copied(NamedTuple):
    """Pairs of frame number `place` that arrive once more: which (N,), how much later, and by which fault."""

    place: int
    which: NDArray[np.bool_]
    later_ns: int
    cause: int


@dataclass(slots=True)
class Receptions:
    """The pairs of K frames with all N nodes: arrays (K, N), whose columns are receiver numbers.

    `outcome` of `Outcome`; `arrival_ns` is when a frame arrives where it does; `cause` is the number of the fault
    behind an outcome `fault`, or behind changed bytes, else NO_CAUSE. `copies` are pairs that arrive once more.
    `flips` are bytes that change on the way, by frame and receiver: places, and what they are xored with.
    """

    outcome: NDArray[np.uint8]
    arrival_ns: NDArray[np.int64]
    cause: NDArray[np.int16]
    copies: list[Copied] = field(default_factory=list)
    flips: dict[tuple[int, int], list[tuple[int, int]]] = field(default_factory=dict)

    @classmethod
    def of(cls, frames: Sequence[Frame], count: int) -> Receptions:
        """The pairs of frames with `count` nodes, nothing decided."""
        shape = len(frames), count
        arrival_ns = np.zeros(shape, np.int64)
        arrival_ns += _column(frame.end_ns for frame in frames)
        cause = np.zeros(shape, np.int16)
        cause += _column(frame.cause for frame in frames).astype(np.int16)
        return cls(np.zeros(shape, np.uint8), arrival_ns, cause)

    def decide(self, which: NDArray[np.bool_] | bool, outcome: Outcome) -> None:
        """Give `outcome` to those of `which`, (K, N) or what fits that shape, that are still pending."""
        self.outcome[(self.outcome == PENDING) & which] = outcome.value

    def fault(self, place: int, which: NDArray[np.bool_], cause: int) -> None:
        """Frame `place` comes no further, by fault number `cause`, at those of `which` (N,) still pending."""
        decided = (self.outcome[place] == PENDING) & which
        self.outcome[place, decided] = Outcome.fault
        self.cause[place, decided] = cause


def _column(numbers: Iterable[int]) -> NDArray[np.int64]:
    return np.array([*numbers], np.int64)[:, None]


Stage = Callable[[Sequence[Frame], Receptions], None]
"""One step of the channel: decides pairs of frames, or changes when they arrive."""
