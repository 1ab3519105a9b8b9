"""Receptions: stages of the channel that decide them, signals at receivers, decoding, and the cause of each loss.

A frame has a word of 64 random bits for each receiver: 16 bits for its fading, 16 for its latency, and 32 for its
reception. The word of its sender, which receives nothing, is used by the MAC.

One draw decides about a frame at a receiver, both with the interference that it met and without. A frame that would
not have been received without interference has `faded`; one that would have been, but is not, has `collided`.

Stages are functions or callable objects that decide the receptions of a batch of frames. They run in the order of
the engine's chain. Each acts only on the receptions that are still pending, so the first stage that decides a
reception is final. All random numbers come from `Draws`, by the receiver's number. A reception does not depend on
other receivers, nor on the number of frames in a batch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from emulator.radio.dot11p import COST_STEPS, PREAMBLE_NS, airtime_ns, cost
from emulator.radio.frames import Frame, Receptions, Signal, Transmission, frame_keys, rows
from emulator.radio.outcomes import PENDING, Outcome
from emulator.radio.propagation import QUANTILES, Nakagami
from emulator.scenario.radio import Fading, Receiver
from emulator.scenario.random_streams import Draws
from emulator.scenario.scenario import MIN_LATENCY_NS, Radio
from vnet.types import Array, IntArray
from vnet.units import NS_PER_MS, Grid

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


def sender_draw(sent: Transmission, lowest_bit: int) -> float:
    """Return a draw in [0, 1) of a frame's sender: JITTER, BACKOFF or NEXT_BACKOFF."""
    assert sent.signal is not None
    return (sent.signal.sender_draws >> lowest_bit & _STEPS - 1) / _STEPS


class Signals:
    """Factory of the signals of frames at `count` receivers."""

    def __init__(self, seed: int, fading: Fading | None, count: int) -> None:
        self._draws = Draws(seed, "radio")
        self.nakagami = Nakagami(fading)
        self.count = count

    def of(self, frame: Frame) -> Signal:
        """Return the signal of a frame."""
        random_draws = self._draws.words(frame.sender, frame.seq, self.count, frame.draw)
        return Signal(random_draws, self.power_mw(frame, random_draws), random_draws.item(frame.sender))

    def power_mw(self, frame: Frame, fading_draws: Words) -> Array:
        """Return the received powers (N,) in mW of a frame whose fading is drawn by the lowest 16 bits of words."""
        topology, sender = frame.topology, frame.sender
        assert topology.power_mw is not None
        assert topology.fading is not None
        mean_mw = topology.power_mw[sender]
        power_mw = mean_mw.copy()
        if self.nakagami.fades:
            steps = (fading_draws & _LAST).view(np.int64)  # of the type of an index, which numpy need not convert
            power_mw *= self.nakagami.factor(topology.fading[sender], steps)
            power_mw[sender] = mean_mw[sender]
        if frame.gain_db:
            power_mw *= 10 ** (frame.gain_db / 10)
        return np.asarray(power_mw)


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
        self._threshold = Threshold(radio.receiver or Receiver())
        cost(np.zeros(1), radio.bitrate_mbps)  # what is slow to import is there before the first frame

    def __call__(self, transmissions: Sequence[Transmission], receptions: Receptions) -> None:
        """Decide the receptions of the frames that were sent."""
        sent = [index for index, one in enumerate(transmissions) if one.sender_outcome == Outcome.pending]
        if not sent:
            return
        frames = [transmissions[index].frame for index in sent]
        signals = [self._signal(transmissions[index]) for index in sent]
        power_mw = np.array([signal.power_mw for signal in signals])
        random_draws = np.array([signal.random_draws for signal in signals])
        rates_mbps = np.array([frame.bitrate_mbps for frame in frames])
        on_air_ns = np.array([airtime_ns(frame.size_bytes, frame.bitrate_mbps) for frame in frames])
        alone = self._received_alone(power_mw, random_draws, on_air_ns - PREAMBLE_NS, rates_mbps)
        faded = np.zeros_like(receptions.outcome, bool)
        faded[sent] = ~alone
        receptions.decide(faded, Outcome.faded)
        if interfered := [number for number, signal in enumerate(signals) if signal.pieces]:
            some = [transmissions[sent[number]] for number in interfered]
            locked = np.array([signals[number].locked for number in interfered], dtype=bool)
            candidates = alone[interfered] & locked
            lost = alone[interfered] & ~locked
            lost |= self._destroyed(some, candidates, power_mw[interfered], random_draws[interfered])
            collided = np.zeros_like(faded)
            collided[[sent[number] for number in interfered]] = lost
            receptions.decide(collided, Outcome.collided)

    def powers_db(self, transmissions: Sequence[Transmission], frame_index: IntArray, receiver: IntArray) -> Array:
        """Return received powers in dBm, and their ratios to noise and interference in dB, as an array (2, n).

        `frame_index` and `receiver` (n,) name the receptions. Interference is averaged over the payload. Both are
        NaN for a frame that was not sent, and out of range.
        """
        own_mw, others_mw = np.full((2, len(transmissions), self._signals.count), np.nan)
        for index, sent in enumerate(transmissions):
            if sent.sender_outcome == Outcome.pending:
                signal = self._signal(sent)
                own_mw[index] = signal.power_mw
                others_mw[index] = self._threshold.noise_mw + self._interference_mw(sent, signal)
        place = (
            frame_index * self._signals.count + receiver
        )  # a look-up with one index is much faster than with two
        power_mw = own_mw.ravel()[place]
        power_mw[power_mw == 0] = np.nan
        return np.asarray(10 * np.log10([power_mw, power_mw / others_mw.ravel()[place]]))

    def _interference_mw(self, sent: Transmission, signal: Signal) -> Array | float:
        """Return the mean power (N,) of all other signals during a frame's payload."""
        if not (pieces := [*self._pieces(sent)]):
            return 0.0
        lengths_ns = np.array([length_ns for length_ns, _ in pieces])
        others_mw = np.maximum(np.array([total_mw for _, total_mw in pieces]) - signal.power_mw, 0.0)
        return np.asarray(lengths_ns @ others_mw / lengths_ns.sum())

    def _signal(self, sent: Transmission) -> Signal:
        if sent.signal is None:  # without a shared medium nothing needed it before
            sent.signal = self._signals.of(sent.frame)
        return sent.signal

    def _received_alone(
        self, power_mw: Array, random_draws: Words, payload_ns: IntArray, rates_mbps: Array
    ) -> NDArray[np.bool_]:
        """Return the mask (K, N) of receptions that would succeed without interference.

        Draws decide only where bits are in error: at the edge of the range.
        """
        alone = power_mw >= self._threshold.alone_mw
        costs = _costs(np.where(alone, power_mw / self._threshold.noise_mw, np.inf), rates_mbps)
        if costs.any():
            edge = costs > 0
            spent = (costs * payload_ns[:, None])[edge]
            alone[edge] = spent < _max_cost(random_draws[edge])
        return alone

    def _destroyed(
        self,
        transmissions: Sequence[Transmission],
        candidates: NDArray[np.bool_],
        power_mw: Array,
        random_draws: Words,
    ) -> NDArray[np.bool_]:
        """Return the mask (M, N) of those `candidates` (M, N) that their interference destroys.

        The other arguments are those of the frames: powers and words (M, N).
        """
        pieces = [[*self._pieces(sent)] for sent in transmissions]
        each = [len(some) for some in pieces]
        lengths_ns = np.array([length_ns for some in pieces for length_ns, _ in some])
        total_mw = np.array([total_mw for some in pieces for _, total_mw in some])
        frame_of = np.repeat(np.arange(len(transmissions)), each)
        own_mw = power_mw[frame_of]
        others_mw = np.maximum(total_mw - own_mw, 0.0)
        snr = np.where(candidates[frame_of], own_mw / (self._threshold.noise_mw + others_mw), np.inf)
        rates_mbps = np.array([sent.frame.bitrate_mbps for sent in transmissions])[frame_of]
        costs = _costs(snr, rates_mbps) * lengths_ns[:, None]
        spent = np.add.reduceat(costs, np.cumsum([0, *each[:-1]]), axis=0)
        destroyed: NDArray[np.bool_] = spent > 0
        destroyed[destroyed] = spent[destroyed] >= _max_cost(random_draws[destroyed])
        return destroyed

    def _pieces(self, sent: Transmission) -> Iterator[tuple[int, Array]]:
        """Yield the pieces of a frame's payload: time in ns, and the sum of all powers (N,) in mW."""
        begin_ns = sent.on_air_ns + PREAMBLE_NS
        for until_ns, total_mw in self._signal(sent).pieces:
            if until_ns > begin_ns:
                yield until_ns - begin_ns, total_mw
                begin_ns = until_ns


def _costs(snr: Array, rates_mbps: Array) -> IntArray:
    """Return the costs (K, N) of a nanosecond of payload of frames at these bit rates (K,)."""
    if (rates_mbps == rates_mbps[0]).all():
        return cost(snr, float(rates_mbps[0]))
    return np.array([cost(row, rate) for row, rate in zip(snr, rates_mbps.tolist(), strict=True)])


def _max_cost(random_draws: Words) -> Array:
    """Return the costs (n,) below which a payload's cost, summed over time, must stay to be received."""
    return np.asarray(-np.log(reception_draws(random_draws)) * COST_STEPS)


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
