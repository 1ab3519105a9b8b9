"""The receiver: which frames it detects and which of them arrive, and what kept those that do not.

One draw decides about a frame at a receiver, with the interference that it met and without: what would have
arrived without and does not with it has collided, and what would not have arrived anyway has faded.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from emulator.channel.dot11p import COST_STEPS, PREAMBLE_NS, airtime_ns, cost
from emulator.channel.frames import Frame, Pairs, Signal
from emulator.channel.outcomes import Outcome
from emulator.channel.signals import RECEPTION, Signals
from vnet.radio import Receiver
from vnet.roads.lanes import Array
from vnet.scenario import Radio


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

    def __call__(self, frames: Sequence[Frame], pairs: Pairs) -> None:
        """Decide about the frames that were sent."""
        sent = [place for place, frame in enumerate(frames) if frame.fate == Outcome.pending]
        if not sent:
            return
        signals = [self._signal(frames[place]) for place in sent]
        power_mw = np.stack([signal.power_mw for signal in signals])
        # -ln(1 - draw): a frame arrives if what its time costs is less.
        limit = -np.log1p(-np.stack([signal.luck[:, RECEPTION] for signal in signals])) * COST_STEPS
        payload_ns = [airtime_ns(frames[place].size_bytes, self._bitrate_mbps) - PREAMBLE_NS for place in sent]
        spent = self._cost(power_mw / self._threshold.noise_mw) * np.array(payload_ns)[:, None]
        alone = (power_mw >= self._threshold.alone_mw) & (spent < limit)
        faded, collided = np.zeros_like(pairs.outcome, bool), np.zeros_like(pairs.outcome, bool)
        faded[sent] = ~alone
        for number in [number for number, signal in enumerate(signals) if signal.pieces]:
            frame, signal = frames[sent[number]], signals[number]
            assert signal.locked is not None
            collided[sent[number]] = ~(signal.locked & (self._among_others(frame, signal) < limit[number]))
        pairs.decide(faded, Outcome.faded)
        pairs.decide(collided, Outcome.collided)

    def _signal(self, frame: Frame) -> Signal:
        if frame.signal is None:  # nobody has sensed it
            frame.signal = self._signals.of(frame)
        return frame.signal

    def _cost(self, snr: Array) -> NDArray[np.int64]:
        return cost(snr, self._bitrate_mbps)

    def _among_others(self, frame: Frame, signal: Signal) -> NDArray[np.int64]:
        """(N,) what a frame's payload costs with the interference that it met."""
        edges_ns = np.array([frame.on_air_ns, *(until_ns for until_ns, _ in signal.pieces)])
        lengths_ns = np.diff(np.maximum(edges_ns, frame.on_air_ns + PREAMBLE_NS))
        others_mw = np.stack([total_mw for _, total_mw in signal.pieces]) - signal.power_mw
        snr = signal.power_mw / (self._threshold.noise_mw + np.maximum(others_mw, 0.0))
        return np.asarray((self._cost(snr) * lengths_ns[:, None]).sum(axis=0))
