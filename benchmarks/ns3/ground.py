"""Input and output that both simulators share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ROAD_M = 1000.0
RATE_HZ = 10
SIZE_BYTES = 300
BIN_M = 50.0


@dataclass(frozen=True)
class ScheduleConstraints:
    """Vehicles on a road: their places (N,) in metres, and when (ns, in order) which of them sends."""

    east_m: NDArray[np.float64]
    time_ns: NDArray[np.int64]
    sender: NDArray[np.int64]
    seconds: float

    @classmethod
    def of(cls, vehicles: int, seconds: float, seed: int = 0) -> ScheduleConstraints:
        """Uniformly placed; each sends once in every tenth of a second, at another instant each time."""
        draws = np.random.default_rng([seed, vehicles])
        east_m = draws.uniform(0, ROAD_M, vehicles)
        period_ns, periods = 10**9 // RATE_HZ, round(seconds * RATE_HZ)
        time_ns = np.arange(periods)[:, None] * period_ns + draws.integers(0, period_ns, (periods, vehicles))
        order = np.argsort(time_ns, axis=None, kind="stable")
        return cls(east_m, time_ns.ravel()[order], order % vehicles, seconds)

    @property
    def sent(self) -> NDArray[np.int64]:
        """(N,), how many frames each sends."""
        return np.bincount(self.sender, minlength=len(self.east_m))

    def text(self) -> str:
        """As the C++ program reads it."""
        places = "\n".join(f"{east_m!r} 0" for east_m in self.east_m.tolist())
        frames = "\n".join(f"{t} {s}" for t, s in zip(self.time_ns.tolist(), self.sender.tolist(), strict=True))
        return f"{len(self.east_m)}\n{places}\n{len(self.time_ns)}\n{frames}\n"


@dataclass(frozen=True)
class Outcome:
    """Frames received by sender and receiver (N, N), rows are senders; channel busy ratios (N,); CPU time."""

    received: NDArray[np.float64]
    busy: NDArray[np.float64]
    wall_s: float
    cpu_s: float


@dataclass(frozen=True)
class Curve:
    """Delivery against distance, in bins of BIN_M from 0: pairs of frame and receiver, and the share delivered."""

    pairs: NDArray[np.int64]
    share: NDArray[np.float64]

    @classmethod
    def of(cls, ground: ScheduleConstraints, outcome: Outcome) -> Curve:
        """The curve of one simulator."""
        distance_m = np.abs(ground.east_m[:, None] - ground.east_m[None])
        others = ~np.eye(len(distance_m), dtype=bool)
        place = (distance_m[others] // BIN_M).astype(int)
        bins = round(ROAD_M / BIN_M)
        sent = np.broadcast_to(ground.sent[:, None], distance_m.shape)[others]
        pairs = np.bincount(place, sent, bins).astype(int)
        delivered = np.bincount(place, outcome.received[others], bins)
        return cls(pairs, delivered / np.maximum(pairs, 1))
