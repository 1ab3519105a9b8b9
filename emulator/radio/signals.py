"""From a frame to the powers with which it arrives, and all the luck that it has at its receivers.

A frame has one word of 64 random bits a receiver: 16 are of its fading, 16 of its latency, and 32 of the reception.
The word at its sender, which receives nothing, is of its access to the medium.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from emulator.radio.frames import Frame, Signal
from emulator.radio.propagation import QUANTILES, Nakagami
from emulator.scenario.radio import Fading
from emulator.scenario.random_streams import Draws
from vnet.types import Array

Words = NDArray[np.uint64]

JITTER, BACKOFF, NEXT_BACKOFF = 0, 16, 32
"""The lowest of the 16 bits of a sender's word each: when a frame gets to the medium, how long it backs off."""
_STEPS = 1 << 16
_LAST = np.uint64(_STEPS - 1)
_LATENCY, _RECEPTION = np.uint64(16), np.uint64(32)

assert QUANTILES == _STEPS


def latency_draws(random_draws: Words) -> Array:
    """Draws in [0, 1)."""
    return np.asarray((random_draws >> _LATENCY & _LAST) / _STEPS)


def reception_draws(random_draws: Words) -> Array:
    """Draws in (0, 1)."""
    return np.asarray(((random_draws >> _RECEPTION) + 0.5) / (1 << 32))


def sender_draw(frame: Frame, which: int) -> float:
    """One of a sender's draws, in [0, 1)."""
    assert frame.signal is not None
    return (int(frame.signal.random_draws[frame.sender]) >> which & _STEPS - 1) / _STEPS


class Signals:
    """Makes the signals of frames to `count` receivers."""

    def __init__(self, seed: int, fading: Fading | None, count: int) -> None:
        self._draws = Draws(seed, "radio")
        self.nakagami = Nakagami(fading)
        self._count = count

    def of(self, frame: Frame) -> Signal:
        """The signal of one frame."""
        random_draws = self._draws.words(frame.sender, frame.seq, self._count, frame.draw)
        topology, sender = frame.topology, frame.sender
        assert topology.power_mw is not None
        assert topology.fading is not None
        mean_mw = topology.power_mw[sender]
        power_mw = mean_mw * self.nakagami.factor(topology.fading[sender], random_draws & _LAST)
        power_mw[sender] = mean_mw[sender]
        return Signal(random_draws, power_mw)
