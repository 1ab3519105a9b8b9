"""802.11p in 10 MHz: how long a frame is on air, how it gets there, and how often it arrives (802.11-2020)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

from emulator.scenario.scenario import Radio
from vnet.types import Array

PREAMBLE_NS = 40_000
"""Training sequences (32 µs) and the field SIGNAL (8 µs)."""
SYMBOL_NS = 8_000
SERVICE_AND_TAIL_BITS = 22
SLOT_NS = 13_000
SIFS_NS = 32_000
DETECTION_NS = 4_000
"""How long a signal must be there before it is noticed: 802.11 allows 8 µs in 10 MHz, ns-3 takes 4."""
AIFSN_AND_CW = {"VO": (2, 3), "VI": (3, 7), "BE": (6, 15), "BK": (9, 15)}
"""Access categories outside a basic service set (802.11-2020, table 9-156); broadcasts are never sent again, so
that only the least contention window counts."""

# Bits a subcarrier, and numerator and denominator of the code rate (table 17-4).
_MODES = {
    3.0: (1, 1, 2),
    4.5: (1, 3, 4),
    6.0: (2, 1, 2),
    9.0: (2, 3, 4),
    12.0: (4, 1, 2),
    18.0: (4, 3, 4),
    24.0: (6, 2, 3),
    27.0: (6, 3, 4),
}
_CARRIERS = 48

# Weights of error events by distance, from the free distance on, as in Pei and Henderson 2010 (the "NIST" model of
# ns-3) after Frenger, Orten and Ottosson 1999. Rate 1/2 has only even distances.
_EVENTS: dict[tuple[int, int], tuple[int, int, tuple[float, ...]]] = {
    (1, 2): (10, 2, (36, 211, 1404, 11633, 77433, 502690, 3322763, 21292910, 134365911)),
    (2, 3): (6, 1, (3, 70, 285, 1276, 6160, 27128, 117019, 498860, 2103891, 8784123)),
    (3, 4): (5, 1, (42, 201, 1492, 10469, 62935, 379644, 2253373, 13073811, 75152755, 428005675)),
}

COST_STEPS = 1 << 40
"""Costs are whole numbers of 2⁻⁴⁰ nepers, so that a sum does not depend on how the time was cut."""
DEAD_PER_NS = 0.04
"""A microsecond at this cost, in nepers a nanosecond, is the end of any frame; and the longest frame's time at it
is still less than 2⁶³ steps."""


@lru_cache(maxsize=4096)
def airtime_ns(size_bytes: int, bitrate_mbps: float) -> int:
    """How long a frame of this many bytes in all is on air: 40 µs + 8 µs · ⌈(22 + 8 L) / bits a symbol⌉."""
    bits, numerator, denominator = _MODES[bitrate_mbps]
    per_symbol = _CARRIERS * bits * numerator // denominator
    return PREAMBLE_NS + SYMBOL_NS * -(-(SERVICE_AND_TAIL_BITS + 8 * size_bytes) // per_symbol)


def airtimes_ns(radio: Radio, size_bytes: NDArray[np.int64]) -> NDArray[np.int64]:
    """How long frames of these sizes are on air by a scenario: without a physical radio, bits by bit rate."""
    if not radio.is_physical:
        return np.rint(size_bytes * 8_000 / radio.bitrate_mbps).astype(np.int64)
    sizes, place = np.unique(size_bytes, return_inverse=True)
    return np.array([airtime_ns(size, radio.bitrate_mbps) for size in sizes.tolist()], np.int64)[place]


def cost(snr: Array, bitrate_mbps: float) -> NDArray[np.int64]:
    """What a nanosecond of a frame's payload costs at these signal-to-noise ratios (linear, any shape).

    A frame arrives with probability exp(-cost · time). The bit error rates are those of the NIST model (Pei and
    Henderson 2010): union bounds of the Viterbi decoder with hard decisions.
    """
    costs = np.zeros(snr.shape, np.int64)
    costly = snr < _free_snr(bitrate_mbps)
    if costly.any():
        costs[costly] = _cost(snr[costly], bitrate_mbps)
    return costs


@lru_cache
def _free_snr(bitrate_mbps: float) -> float:
    """From which ratio on a nanosecond costs nothing, in whole steps."""
    ratios = 10 ** (np.arange(-10, 60, 0.125) / 10)
    return float(ratios[np.flatnonzero(_cost(ratios, bitrate_mbps))[-1] + 1])


def _cost(snr: Array, bitrate_mbps: float) -> NDArray[np.int64]:
    bits, numerator, denominator = _MODES[bitrate_mbps]
    raw = _raw_error_rate(snr, bits)
    first, step, weights = _EVENTS[numerator, denominator]
    squared = 4 * raw * (1 - raw)
    base = squared if step == 2 else np.sqrt(squared)
    error: Array = np.full_like(snr, weights[-1])
    for weight in weights[-2::-1]:
        error = error * base + weight
    error = np.minimum(error * base ** (first // step) / (2 * numerator), 1 - 1e-12)
    nepers_per_ns = -np.log1p(-error) * (bitrate_mbps * 1e-3)
    return np.asarray(np.minimum(nepers_per_ns, DEAD_PER_NS) * COST_STEPS).astype(np.int64)


def _raw_error_rate(snr: Array, bits: int) -> Array:
    """Before decoding: BPSK, QPSK and square QAM of so many bits a subcarrier."""
    if bits <= 2:
        return np.asarray(0.5 * erfc(np.sqrt(snr / bits)))
    side = 2 ** (bits // 2)
    return np.asarray((side - 1) / (side * bits / 2) * erfc(np.sqrt(snr * 3 / (2 * (side**2 - 1)))))


def arrival_probability(snr: Array, on_air_ns: int, bitrate_mbps: float) -> Array:
    """The probability that a frame arrives that was detected and is on air so long, without interference."""
    payload_ns = on_air_ns - PREAMBLE_NS
    return np.asarray(np.exp(-cost(snr, bitrate_mbps) * (payload_ns / COST_STEPS)))
