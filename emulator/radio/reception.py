"""The receiver: which frames it detects and which of them arrive, and what kept those that do not.

One draw decides about a frame at a receiver, with the interference that it met and without: what would have
arrived without and does not with it has collided, and what would not have arrived anyway has faded.
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
    """A power in dBm."""
    return float(10 ** (dbm / 10))


class Threshold:
    """What a receiver detects: its noise, the least ratio to noise and interference, and the least power."""

    def __init__(self, receiver: Receiver) -> None:
        self.noise_mw = milliwatts(receiver.noise_dbm + receiver.noise_figure_db)
        self._least_mw = milliwatts(receiver.min_rssi_dbm)
        self._ratio = milliwatts(receiver.min_snr_db)
        self.alone_mw = max(self._least_mw, self._ratio * self.noise_mw)
        """The least power of a signal that is alone on air."""

    def detects(self, power_mw: Array, total_mw: Array) -> NDArray[np.bool_]:
        """Where a signal of these powers is detected while the sum of all is so much."""
        enough = power_mw * (1 + self._ratio) >= self._ratio * (self.noise_mw + total_mw)
        return np.asarray(enough & (power_mw >= self._least_mw))


class Reception:
    """A stage: decides `faded` and `collided`."""

    def __init__(self, radio: Radio, signals: Signals) -> None:
        self._signals = signals
        self._bitrate_mbps = radio.bitrate_mbps
        self._threshold = Threshold(radio.receiver or Receiver())

    def __call__(self, frames: Sequence[Frame], receptions: Receptions) -> None:
        """Decide about the frames that were sent."""
        sent = [place for place, frame in enumerate(frames) if frame.sender_outcome == Outcome.pending]
        if not sent:
            return
        signals = [self._signal(frames[place]) for place in sent]
        power_mw = np.array([signal.power_mw for signal in signals])
        # A frame arrives if what its time costs is less.
        limit = -np.log(reception_draws(np.array([signal.random_draws for signal in signals]))) * COST_STEPS
        on_air_ns = np.array([airtime_ns(frames[place].size_bytes, self._bitrate_mbps) for place in sent])
        heard = power_mw >= self._threshold.alone_mw
        snr = np.where(heard, power_mw / self._threshold.noise_mw, np.inf)
        alone = heard & (self._cost(snr) * (on_air_ns - PREAMBLE_NS)[:, None] < limit)
        faded, collided = np.zeros_like(receptions.outcome, bool), np.zeros_like(receptions.outcome, bool)
        faded[sent] = ~alone
        met = [number for number, signal in enumerate(signals) if signal.pieces]
        if met:
            at = [sent[number] for number in met]
            collided[at] = ~self._survive([frames[place] for place in at], alone[met], limit[met])
        receptions.decide(faded, Outcome.faded)
        receptions.decide(collided, Outcome.collided)

    def _signal(self, frame: Frame) -> Signal:
        if frame.signal is None:  # nobody has sensed it
            frame.signal = self._signals.of(frame)
        return frame.signal

    def _cost(self, snr: Array) -> NDArray[np.int64]:
        return cost(snr, self._bitrate_mbps)

    def _survive(self, frames: Sequence[Frame], alone: NDArray[np.bool_], limit: Array) -> NDArray[np.bool_]:
        """(M, N), where frames arrive with the interference that they met, of those that arrive `alone`."""
        hopes = []
        for number, frame in enumerate(frames):
            signal = self._signal(frame)
            assert signal.locked is not None
            hopes.append(np.flatnonzero(alone[number] & signal.locked))
        ratios = [self._ratios(self._signal(frame), hopeful) for frame, hopeful in zip(frames, hopes, strict=True)]
        costs = self._cost(np.concatenate([ratio.ravel() for ratio in ratios]))
        survives = np.zeros_like(alone)
        ends = np.cumsum([ratio.size for ratio in ratios])[:-1]
        for number, some in enumerate(np.split(costs, ends)):
            spent = _lengths_ns(frames[number]) @ some.reshape(ratios[number].shape)
            survives[number, hopes[number]] = spent < limit[number, hopes[number]]
        return survives

    def _ratios(self, signal: Signal, at: NDArray[np.intp]) -> Array:
        """(P, n) signal to noise and interference in each piece of a frame's time, at these receivers."""
        power_mw = signal.power_mw[at]
        others_mw = np.array([total_mw[at] for _, total_mw in signal.pieces]) - power_mw
        return np.asarray(power_mw / (self._threshold.noise_mw + np.maximum(others_mw, 0.0)))


def _lengths_ns(frame: Frame) -> NDArray[np.int64]:
    """(P,), how much of a frame's payload lies in each piece of its time."""
    assert frame.signal is not None
    edges_ns = np.array([frame.on_air_ns, *(until_ns for until_ns, _ in frame.signal.pieces)])
    return np.asarray(np.diff(np.maximum(edges_ns, frame.on_air_ns + PREAMBLE_NS)))
