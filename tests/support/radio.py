"""Small engines with a given radio, and a reference error model."""

import math
from typing import Any

import numpy as np

from emulator.radio.engine import Engine
from emulator.scenario.scenario import Radio


def engine(position_m: np.ndarray, seed: int = 1, **radio: Any) -> Engine:
    """Return an engine of nodes v0, v1, … at these positions (N, 2), without access jitter."""
    ids = [f"v{number}" for number in range(len(position_m))]
    return Engine(ids, Radio.model_validate({"access_jitter_ms": 0, **radio}), seed, position_m, None)


def line(*east_m: float) -> np.ndarray:
    """Return positions (N, 2) on a line from west to east."""
    return np.column_stack([east_m, np.zeros(len(east_m))])


def drained(of: Engine) -> list[dict[str, Any]]:
    """Return the rows of the trace once all has been decided."""
    of.drain()
    return of.trace.to_table().to_pylist()


def nist_qpsk_half(snr: float, bits: int) -> float:
    """Return the arrival probability of `bits` at 6 Mbit/s by Pei and Henderson's formula, term by term."""
    raw = 0.5 * math.erfc(math.sqrt(snr / 2))
    d = math.sqrt(4 * raw * (1 - raw))
    weights = [36, 211, 1404, 11633, 77433, 502690, 3322763, 21292910, 134365911]
    error = 0.5 * sum(weight * d ** (10 + 2 * number) for number, weight in enumerate(weights))
    return float((1 - min(error, 1)) ** bits)
