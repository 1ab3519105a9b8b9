"""Signals: the received powers of a frame, and its random draws at every receiver.

A frame has a word of 64 random bits for each receiver: 16 bits for its fading, 16 for its latency, and 32 for its
reception. The word of its sender, which receives nothing, is used by the MAC.
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
"""Lowest of 16 bits each in a sender's word: access jitter, backoff before the frame, backoff after it."""
_STEPS = 1 << 16
_LAST = np.array(_STEPS - 1, np.uint64)
_LATENCY, _RECEPTION = np.uint64(16), np.uint64(32)

assert QUANTILES == _STEPS


def latency_draws(random_draws: Words) -> Array:
    """Return the latency draws in [0, 1) of words of any shape."""
    return np.asarray((random_draws >> _LATENCY & _LAST) / _STEPS)


def reception_draws(random_draws: Words) -> Array:
    """Return the reception draws in (0, 1) of words of any shape."""
    return np.asarray(((random_draws >> _RECEPTION) + 0.5) / (1 << 32))


def sender_draw(frame: Frame, lowest_bit: int) -> float:
    """Return a draw in [0, 1) of a frame's sender: JITTER, BACKOFF or NEXT_BACKOFF."""
    assert frame.signal is not None
    return (frame.signal.sender_draws >> lowest_bit & _STEPS - 1) / _STEPS


class Signals:
    """Factory of the signals of frames at `count` receivers."""

    def __init__(self, seed: int, fading: Fading | None, count: int) -> None:
        self._draws = Draws(seed, "radio")
        self.nakagami = Nakagami(fading)
        self.count = count

    def of(self, frame: Frame) -> Signal:
        """Return the signal of a frame."""
        random_draws = self._draws.words(frame.sender, frame.seq, self.count, frame.draw)
        topology, sender = frame.topology, frame.sender
        assert topology.power_mw is not None
        assert topology.fading is not None
        mean_mw = topology.power_mw[sender]
        steps = (random_draws & _LAST).view(np.int64)  # of the type of an index, which numpy need not convert
        power_mw = mean_mw * self.nakagami.factor(topology.fading[sender], steps)
        power_mw[sender] = mean_mw[sender]
        if frame.gain_db:
            power_mw *= 10 ** (frame.gain_db / 10)
        return Signal(random_draws, power_mw, random_draws.item(sender))
