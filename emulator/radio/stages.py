"""The stages of the channel: functions or callable objects that decide the receptions of a batch of frames.

Stages run in the order of the engine's chain. Each acts only on the receptions that are still pending, so the first
stage that decides a reception is final. All random numbers come from `Draws`, by the receiver's number. A
reception does not depend on other receivers, nor on the number of frames in a batch.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from emulator.radio.frames import Receptions, Transmission, frame_keys, rows
from emulator.radio.outcomes import PENDING, Outcome
from emulator.radio.reception import latency_draws
from emulator.scenario.random_streams import Draws
from emulator.scenario.scenario import MIN_LATENCY_NS, Radio
from vnet.types import Array
from vnet.units import NS_PER_MS, Grid


def frame_draws(draws: Draws, transmissions: Sequence[Transmission], receptions: Receptions) -> Array:
    """Return the draws of the pending receptions, and 1 for the others (K, M)."""
    drawn = np.ones(receptions.outcome.shape)
    if receptions.receiver is None:
        count = receptions.outcome.shape[1]
        for index, sent in enumerate(transmissions):
            drawn[index] = draws.uniform(sent.frame.sender, sent.frame.seq, count, sent.frame.draw)
        return drawn
    pending = receptions.outcome == PENDING
    drawn[pending] = draws.uniform_at(frame_keys(transmissions), pending.sum(axis=1), receptions.receiver[pending])
    return drawn


def in_range(transmissions: Sequence[Transmission], receptions: Receptions) -> None:
    """Decide `out_of_range` for receivers that a frame cannot reach."""
    receptions.decide(~rows(transmissions, "in_range"), Outcome.out_of_range)


def sender_side(transmissions: Sequence[Transmission], receptions: Receptions) -> None:
    """Give the receptions of a frame that its sender did not send the sender's outcome."""
    for index, sent in enumerate(transmissions):
        if sent.sender_outcome:
            row = receptions.outcome[index]
            row[row == PENDING] = sent.sender_outcome


def peer_cap(transmissions: Sequence[Transmission], receptions: Receptions) -> None:
    """Decide `peer_cap` for senders beyond a receiver's nearest `radio.max_peers` live ones in range."""
    receptions.decide(~rows(transmissions, "admitted"), Outcome.peer_cap)


def lose_by_faults(transmissions: Sequence[Transmission], receptions: Receptions) -> None:
    """Decide `fault` where a fault cuts the link or loses the frame."""
    for index, sent in enumerate(transmissions):
        if sent.frame.effects.lose:
            for number, lost in sent.frame.effects.losses(sent):
                receptions.fault(index, lost, number)


def change_by_faults(transmissions: Sequence[Transmission], receptions: Receptions) -> None:
    """Apply, after the latency, the faults that do not lose receptions: delays, duplicates, altered bytes."""
    for index, sent in enumerate(transmissions):
        if sent.frame.effects.change:
            sent.frame.effects.changes(sent, index, receptions)


class LossStage:
    """Independent loss of every reception, with probability `radio.loss`, or with that of its link."""

    def __init__(self, seed: int, loss: float) -> None:
        self._draws = Draws(seed, "loss")
        self._loss = loss

    def __call__(self, transmissions: Sequence[Transmission], receptions: Receptions) -> None:
        """Decide `lost`."""
        loss = self._loss if transmissions[0].frame.topology.loss is None else rows(transmissions, "loss")
        if loss > 0 if isinstance(loss, float) else (loss > 0).any():
            receptions.decide(frame_draws(self._draws, transmissions, receptions) < loss, Outcome.lost)


class LatencyStage:
    """Transport latency: `latency_ms` plus uniform `jitter_ms`, rounded up to the delivery tick."""

    def __init__(self, seed: int, radio: Radio) -> None:
        self._draws = Draws(seed, "latency")
        self._latency_ns = radio.latency_ms * NS_PER_MS
        self._jitter_ns = radio.jitter_ms * NS_PER_MS
        self._tick_ns = radio.delivery_tick_us * 1_000

    def __call__(self, transmissions: Sequence[Transmission], receptions: Receptions) -> None:
        """Set the arrival time of each reception."""
        jitter_ns = self._jitter_ns * self._draws_of(transmissions, receptions) if self._jitter_ns else np.zeros(1)
        latency_ns = (self._latency_ns + jitter_ns).astype(np.int64)
        arrival_ns = receptions.arrival_ns + np.maximum(latency_ns, MIN_LATENCY_NS)
        if self._tick_ns:
            arrival_ns = -(-arrival_ns // self._tick_ns) * self._tick_ns
        receptions.arrival_ns = arrival_ns

    def _draws_of(self, transmissions: Sequence[Transmission], receptions: Receptions) -> NDArray[np.float64]:
        """Return the latency draws (K, M), from the frames' signals if they have any."""
        if all(sent.signal is None for sent in transmissions):
            return frame_draws(self._draws, transmissions, receptions)
        zeros = np.zeros(receptions.outcome.shape[1], np.uint64)
        return latency_draws(
            np.array([zeros if s.signal is None else s.signal.random_draws for s in transmissions])
        )


class RoundedUp:
    """Arrivals at the instants of a grid, whatever has delayed them; duplicates keep their distance."""

    def __init__(self, grid: Grid) -> None:
        self._grid = grid

    def __call__(self, transmissions: Sequence[Transmission], receptions: Receptions) -> None:
        """Set the arrival time of each reception."""
        receptions.arrival_ns = self._grid.at_or_after(receptions.arrival_ns)
