"""From a frame to the powers with which it arrives."""

from __future__ import annotations

from emulator.channel.draws import Draws
from emulator.channel.frames import Frame, Signal
from emulator.channel.propagation import Nakagami
from vnet.radio import Fading

FADING, RECEPTION, LATENCY = range(3)
"""What the three draws of a signal at a receiver are for."""
JITTER, BACKOFF, NEXT_BACKOFF = range(3)
"""And those at its sender, which receives nothing: when it gets to the medium, and how long it backs off."""


class Signals:
    """Makes the signals of frames to `count` receivers."""

    def __init__(self, seed: int, fading: Fading | None, count: int) -> None:
        self._draws = Draws(seed, "radio")
        self.nakagami = Nakagami(fading)
        self._count = count

    def of(self, frame: Frame) -> Signal:
        """The signal of one frame."""
        luck = self._draws.uniform(frame.sender, frame.seq, 3 * self._count, frame.draw).reshape(-1, 3)
        surroundings, sender = frame.surroundings, frame.sender
        assert surroundings.power_mw is not None
        assert surroundings.fading is not None
        factor = self.nakagami.factor(surroundings.fading[sender], luck[:, FADING])
        factor[sender] = 1.0
        return Signal(luck, surroundings.power_mw[sender] * factor)
