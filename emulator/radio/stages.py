"""The stages of the channel: small objects with one method over all receivers of some frames.

Stages run in the order of the chain; each looks only at the pairs that are still pending, and the first that
decides a pair has decided it. Whatever is random comes from `Draws`, indexed by receiver number. No stage needs
state of two receivers, and none cares how many frames it is given at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.radio.frames import Frame, Receptions
from emulator.radio.outcomes import PENDING, Outcome
from emulator.radio.signals import latency_draws
from emulator.scenario.random_streams import Draws
from emulator.scenario.scenario import Radio
from vnet.types import Array
from vnet.units import NS_PER_MS

MIN_LATENCY_NS = 1_000
"""No exchange without time passing: every pair's latency is at least a microsecond."""


def rows(frames: Sequence[Frame], name: str) -> NDArray[Any]:
    """(K, N): each frame's sender's row of a matrix of its surroundings."""
    first = frames[0].topology
    matrix = getattr(first, name)
    if all(frame.topology is first for frame in frames):
        return np.asarray(matrix[[frame.sender for frame in frames]])
    return np.stack([getattr(frame.topology, name)[frame.sender] for frame in frames])


def frame_draws(draws: Draws, frames: Sequence[Frame], count: int) -> Array:
    """Return the draws of each frame, (K, count), to be indexed by receiver number."""
    drawn = np.empty((len(frames), count))
    for index, frame in enumerate(frames):
        drawn[index] = draws.uniform(frame.sender, frame.seq, count, frame.draw)
    return drawn


def in_range(frames: Sequence[Frame], receptions: Receptions) -> None:
    """Whom a frame cannot reach is `out_of_range`."""
    receptions.decide(~rows(frames, "in_range"), Outcome.out_of_range)


def sender_side(frames: Sequence[Frame], receptions: Receptions) -> None:
    """A frame that its sender did not send reaches nobody."""
    for place, frame in enumerate(frames):
        if frame.sender_outcome:
            row = receptions.outcome[place]
            row[row == PENDING] = frame.sender_outcome


def peer_cap(frames: Sequence[Frame], receptions: Receptions) -> None:
    """Each receiver hears its nearest `radio.max_peers` live senders in range, ties by number."""
    receptions.decide(~rows(frames, "admitted"), Outcome.peer_cap)


def lose_by_faults(frames: Sequence[Frame], receptions: Receptions) -> None:
    """Decide `fault` where a link was cut, or a fault loses the frame."""
    for place, frame in enumerate(frames):
        if frame.effects.lose:
            for number, lost in frame.effects.losses(frame):
                receptions.fault(place, lost, number)


def change_by_faults(frames: Sequence[Frame], receptions: Receptions) -> None:
    """After the latency: what does not lose a pair; later arrivals, copies, other bytes."""
    for place, frame in enumerate(frames):
        if frame.effects.change:
            frame.effects.changes(frame, place, receptions)


class Loss:
    """Every pair is lost independently with probability `radio.loss`."""

    def __init__(self, seed: int, loss: float) -> None:
        self._draws = Draws(seed, "loss")
        self._loss = loss

    def __call__(self, frames: Sequence[Frame], receptions: Receptions) -> None:
        """Decide `lost`."""
        if self._loss > 0:
            receptions.decide(
                frame_draws(self._draws, frames, receptions.outcome.shape[1]) < self._loss, Outcome.lost
            )


class Latency:
    """Propagation and processing: `latency_ms` plus uniform `jitter_ms`, rounded up to the delivery tick."""

    def __init__(self, seed: int, radio: Radio) -> None:
        self._draws = Draws(seed, "latency")
        self._latency_ns = radio.latency_ms * NS_PER_MS
        self._jitter_ns = radio.jitter_ms * NS_PER_MS
        self._tick_ns = radio.delivery_tick_us * 1_000

    def __call__(self, frames: Sequence[Frame], receptions: Receptions) -> None:
        """Set when each pair arrives."""
        draws = self._draws_of(frames, receptions.outcome.shape[1])
        latency_ns = (self._latency_ns + self._jitter_ns * draws).astype(np.int64)
        arrival_ns = receptions.arrival_ns + np.maximum(latency_ns, MIN_LATENCY_NS)
        if self._tick_ns:
            arrival_ns = -(-arrival_ns // self._tick_ns) * self._tick_ns
        receptions.arrival_ns = arrival_ns

    def _draws_of(self, frames: Sequence[Frame], count: int) -> NDArray[np.float64]:
        """(K, count), those of the signals where frames have one."""
        if all(frame.signal is None for frame in frames):
            return frame_draws(self._draws, frames, count)
        nothing = np.zeros(count, np.uint64)
        return latency_draws(np.array([nothing if f.signal is None else f.signal.random_draws for f in frames]))
