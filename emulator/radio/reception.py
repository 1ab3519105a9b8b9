"""The receiver: detection and decoding of frames, and the cause of each loss.

One draw decides about a frame at a receiver, both with the interference that it met and without. A frame that would
not have been received without interference has `faded`; one that would have been, but is not, has `collided`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from emulator.radio.dot11p import COST_STEPS, PREAMBLE_NS, airtime_ns, cost
from emulator.radio.frames import Frame, Receptions, Signal
from emulator.radio.outcomes import Outcome
from emulator.radio.signals import Signals, reception_draws
from emulator.scenario.radio import Receiver
from emulator.scenario.scenario import Radio
from vnet.types import Array


def milliwatts(dbm: float) -> float:
    """Convert a power from dBm to mW, or a ratio from dB to linear."""
    return float(10 ** (dbm / 10))


class Threshold:
    """Detection threshold of a receiver: its noise, the least SINR, and the least power."""

    def __init__(self, receiver: Receiver) -> None:
        self.noise_mw = milliwatts(receiver.noise_dbm + receiver.noise_figure_db)
        self._least_mw = milliwatts(receiver.min_rssi_dbm)
        self._ratio = milliwatts(receiver.min_snr_db)
        self.alone_mw = max(self._least_mw, self._ratio * self.noise_mw)
        """Least power in mW at which a signal is detected without interference."""

    def detects(self, power_mw: Array, total_mw: Array) -> NDArray[np.bool_]:
        """Return the mask of receivers that detect a signal of these powers when all signals sum to `total_mw`."""
        enough = power_mw * (1 + self._ratio) >= self._ratio * (self.noise_mw + total_mw)
        return np.asarray(enough & (power_mw >= self._least_mw))


class Reception:
    """The stage of the receiver: decides `faded` and `collided`."""

    def __init__(self, radio: Radio, signals: Signals) -> None:
        self._signals = signals
        self._bitrate_mbps = radio.bitrate_mbps
        self._threshold = Threshold(radio.receiver or Receiver())

    def __call__(self, frames: Sequence[Frame], receptions: Receptions) -> None:
        """Decide the receptions of the frames that were sent."""
        sent = [index for index, frame in enumerate(frames) if frame.sender_outcome == Outcome.pending]
        if not sent:
            return
        signals = [self._signal(frames[index]) for index in sent]
        power_mw = np.array([signal.power_mw for signal in signals])
        # A frame is received if the cost of its payload, summed over time, is less than this.
        max_cost = -np.log(reception_draws(np.array([signal.random_draws for signal in signals]))) * COST_STEPS
        on_air_ns = np.array([airtime_ns(frames[index].size_bytes, self._bitrate_mbps) for index in sent])
        detected = power_mw >= self._threshold.alone_mw
        snr = np.where(detected, power_mw / self._threshold.noise_mw, np.inf)
        alone = detected & (self._cost(snr) * (on_air_ns - PREAMBLE_NS)[:, None] < max_cost)
        faded, collided = np.zeros_like(receptions.outcome, bool), np.zeros_like(receptions.outcome, bool)
        faded[sent] = ~alone
        interfered = [number for number, signal in enumerate(signals) if signal.pieces]
        if interfered:
            indices = [sent[number] for number in interfered]
            survives = self._survive([frames[index] for index in indices], alone[interfered], max_cost[interfered])
            collided[indices] = ~survives
        receptions.decide(faded, Outcome.faded)
        receptions.decide(collided, Outcome.collided)

    def _signal(self, frame: Frame) -> Signal:
        if frame.signal is None:  # without a shared medium nothing needed it before
            frame.signal = self._signals.of(frame)
        return frame.signal

    def _cost(self, snr: Array) -> NDArray[np.int64]:
        return cost(snr, self._bitrate_mbps)

    def _survive(self, frames: Sequence[Frame], alone: NDArray[np.bool_], max_cost: Array) -> NDArray[np.bool_]:
        """Return the mask (M, N) of receptions that survive their interference.

        `alone` (M, N) marks those received without interference, and `max_cost` (M, N) is the cost they may sum to.
        """
        candidates = []
        for number, frame in enumerate(frames):
            signal = self._signal(frame)
            assert signal.locked is not None
            candidates.append(np.flatnonzero(alone[number] & signal.locked))
        ratios = [self._ratios(self._signal(frame), at) for frame, at in zip(frames, candidates, strict=True)]
        costs = self._cost(np.concatenate([ratio.ravel() for ratio in ratios]))
        survives = np.zeros_like(alone)
        ends = np.cumsum([ratio.size for ratio in ratios])[:-1]
        for number, some in enumerate(np.split(costs, ends)):
            spent = _lengths_ns(frames[number]) @ some.reshape(ratios[number].shape)
            survives[number, candidates[number]] = spent < max_cost[number, candidates[number]]
        return survives

    def _ratios(self, signal: Signal, at: NDArray[np.intp]) -> Array:
        """Return the SINR (P, n), linear, in each piece of a frame's time at the receivers `at` (n,)."""
        power_mw = signal.power_mw[at]
        others_mw = np.array([total_mw[at] for _, total_mw in signal.pieces]) - power_mw
        return np.asarray(power_mw / (self._threshold.noise_mw + np.maximum(others_mw, 0.0)))


def _lengths_ns(frame: Frame) -> NDArray[np.int64]:
    """Return the time in ns (P,) of a frame's payload that lies in each piece of its time on air."""
    assert frame.signal is not None
    edges_ns = np.array([frame.on_air_ns, *(until_ns for until_ns, _ in frame.signal.pieces)])
    return np.asarray(np.diff(np.maximum(edges_ns, frame.on_air_ns + PREAMBLE_NS)))
