"""802.11p in 10 MHz: airtimes, timing of channel access, and error model (IEEE 802.11-2020)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from emulator.scenario.program import RoadsideUnit
from emulator.scenario.radio import RATES_MBPS
from emulator.scenario.scenario import Radio
from vnet.radio import RadioAbilities
from vnet.types import Array

PREAMBLE_NS = 40_000
"""Duration of the training sequences (32 µs) and the SIGNAL field (8 µs)."""
SYMBOL_NS = 8_000
"""Duration of an OFDM symbol."""
SERVICE_AND_TAIL_BITS = 22
"""Bits of a frame beside its bytes: SERVICE (16) and tail (6)."""
SLOT_NS = 13_000
"""Slot time."""
SIFS_NS = 32_000
"""Short interframe space."""
DETECTION_NS = 4_000
"""Time until a signal is detected: 802.11 allows 8 µs in 10 MHz, ns-3 uses 4."""
AIFSN_AND_CW = {"VO": (2, 3), "VI": (3, 7), "BE": (6, 15), "BK": (9, 15)}
"""AIFSN and CWmin of the access categories outside a basic service set (802.11-2020, table 9-156)."""
MAX_WINDOW = {"VO": 7, "VI": 15, "BE": 1023, "BK": 1023}
"""CWmax of the access categories (the same table). Only frames that are acknowledged are sent again, with a larger
contention window."""

# Bit rate in Mbit/s: bits a subcarrier, numerator and denominator of the code rate (table 17-4).
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

# Code rate: free distance, step between distances, and weights of the error events by distance, as in Pei and
# Henderson 2010 (the "NIST" model of ns-3) after Frenger, Orten and Ottosson 1999. Rate 1/2 has only even
# distances.
_EVENTS: dict[tuple[int, int], tuple[int, int, tuple[float, ...]]] = {
    (1, 2): (10, 2, (36, 211, 1404, 11633, 77433, 502690, 3322763, 21292910, 134365911)),
    (2, 3): (6, 1, (3, 70, 285, 1276, 6160, 27128, 117019, 498860, 2103891, 8784123)),
    (3, 4): (5, 1, (42, 201, 1492, 10469, 62935, 379644, 2253373, 13073811, 75152755, 428005675)),
}

COST_STEPS = 1 << 40
"""Costs are integer multiples of 2⁻⁴⁰ nepers, so that their sum does not depend on how a frame's time is
divided."""
MAX_COST_PER_NS = 0.04
"""Upper bound of the cost in nepers a nanosecond: a microsecond of it destroys any frame, and the longest frame
at this cost still sums to less than 2⁶³ steps."""


@lru_cache(maxsize=4096)
def airtime_ns(size_bytes: int, bitrate_mbps: float) -> int:
    """Airtime in ns of a frame of L bytes, headers included: 40 µs + 8 µs · ⌈(22 + 8 L) / bits a symbol⌉."""
    bits, numerator, denominator = _MODES[bitrate_mbps]
    per_symbol = _CARRIERS * bits * numerator // denominator
    return PREAMBLE_NS + SYMBOL_NS * -(-(SERVICE_AND_TAIL_BITS + 8 * size_bytes) // per_symbol)


def airtimes_ns(radio: Radio, size_bytes: NDArray[np.int64], bitrate_mbps: Array) -> NDArray[np.int64]:
    """Airtimes in ns (n,) of frames of these sizes and bit rates; without a physical radio, bits / bit rate."""
    if not radio.is_physical:
        return np.rint(size_bytes * 8_000 / bitrate_mbps).astype(np.int64)
    airtimes = np.zeros(len(size_bytes), np.int64)
    for rate in np.unique(bitrate_mbps).tolist():
        some = bitrate_mbps == rate
        sizes, index = np.unique(size_bytes[some], return_inverse=True)
        airtimes[some] = np.array([airtime_ns(size, rate) for size in sizes.tolist()], np.int64)[index]
    return airtimes


def abilities_of(radio: Radio, unit: RoadsideUnit | None = None) -> RadioAbilities:
    """Return what programs of vehicles, or of a roadside unit, may choose for a frame with this radio."""
    power_dbm = None if radio.path_loss is None else radio.path_loss.tx_power_dbm
    if power_dbm is not None and unit is not None and unit.tx_power_dbm is not None:
        power_dbm = unit.tx_power_dbm
    if radio.sidelink is not None:
        return RadioAbilities(power_dbm, periods_ms=radio.sidelink.periods_ms)
    return RadioAbilities(power_dbm, RATES_MBPS if radio.is_physical else (), radio.mac is not None)


def cost(snr: Array, bitrate_mbps: float) -> NDArray[np.int64]:
    """Cost of a nanosecond of payload at these signal-to-noise ratios (linear, any shape), in `COST_STEPS`.

    A frame is received with probability exp(-cost · time). The bit error rates are those of the NIST model (Pei and
    Henderson 2010): union bounds of the Viterbi decoder with hard decisions.
    """
    costs = np.zeros(snr.shape, np.int64)
    costly = snr < _error_free_snr(bitrate_mbps)
    if costly.any():
        costs[costly] = _cost(snr[costly], bitrate_mbps)
    return costs


@lru_cache
def _error_free_snr(bitrate_mbps: float) -> float:
    """Return the least signal-to-noise ratio (linear, on a grid of 1/8 dB) at which the cost rounds to 0 steps."""
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
    return np.asarray(np.minimum(nepers_per_ns, MAX_COST_PER_NS) * COST_STEPS).astype(np.int64)


def _raw_error_rate(snr: Array, bits: int) -> Array:
    """Bit error rate before decoding: BPSK, QPSK or square QAM of `bits` a subcarrier."""
    from scipy.special import erfc  # slow to import, and the disc radio does without

    if bits <= 2:
        return np.asarray(0.5 * erfc(np.sqrt(snr / bits)))
    side = 2 ** (bits // 2)
    return np.asarray((side - 1) / (side * bits / 2) * erfc(np.sqrt(snr * 3 / (2 * (side**2 - 1)))))


def arrival_probability(snr: Array, on_air_ns: int, bitrate_mbps: float) -> Array:
    """Probability that a detected frame of this airtime is received, without interference."""
    payload_ns = on_air_ns - PREAMBLE_NS
    return np.asarray(np.exp(-cost(snr, bitrate_mbps) * (payload_ns / COST_STEPS)))
