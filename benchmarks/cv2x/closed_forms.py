"""NR mode 2 beside closed forms of its collisions, for vehicles that all hear each other at equal distance.

**Dynamic scheduling.** In each period every vehicle transmits once, on any of M resources. A frame meets another
vehicle's with probability 1 / M, so with V vehicles it meets none with probability (1 - 1 / M)^(V - 1).

**Semi-persistent scheduling.** A vehicle uses a resource for L periods on average: E[C] / (1 - k), with the
reselection counter C and the probability k of keeping a resource. Two vehicles collide if both select the same
resource while neither has announced its selection. A selection is announced by its first transmission, which is in
the middle of the interval on average. So a second vehicle selects unannounced after a first one with probability
1/2, and as often before it: once in L² periods for two vehicles. Each takes one of the A resources that are free to
it, the same with probability 1 / A, and they collide until one of them selects again: after E[min(life, life)]
periods. And who selects in a slot has not sensed that slot, which the last one of its window repeats: what another
vehicle has reserved for it before is over by then. That vehicle is not excluded: once in 100 L periods for each of
two, until one of them selects again, after E[min(life, rest of a life)] periods. So a frame meets no other with
probability (1 - (E[min(life, life)] / L² + 2 E[min(life, rest)] / (100 L)) / A)^(V - 1).

**The model of Cao et al.** (arXiv 2309.16680, equations 8 and 12, as a public program that uses them restates them;
the paper itself was not at hand) counts each selection of another vehicle in the interval before and after one's
own, and the whole life of a resource as lost. So it has about twice as many collisions, until saturation.

With one subchannel all collisions are between vehicles in one slot, which hear nothing of each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from emulator.radio.engine import Engine
from emulator.radio.outcomes import Outcome
from emulator.scenario.scenario import Radio
from vnet.radio import SentFrame

PERIOD_MS = 100
"""Reservation interval, and selection window."""
COUNTERS = np.arange(5, 16)
"""Values of a new reselection counter with this interval, equally likely."""
LONGEST = 600
"""Periods after which no reservation goes on, but for a share of one in a billion."""


@dataclass(frozen=True)
class Case:
    """Vehicles, subchannels, and how they select: the probability of keeping a resource, None if dynamically."""

    vehicles: int
    subchannels: int = 1
    keep: float | None = 0.0
    re_evaluation: bool = False

    def __post_init__(self) -> None:
        if self.vehicles > self.resources:
            raise ValueError(f"{self.vehicles} vehicles: at most {self.resources}, one a resource")

    @property
    def resources(self) -> int:
        """Resources in a period, with slots of 1 ms."""
        return PERIOD_MS * self.subchannels

    @property
    def name(self) -> str:
        """The case in words."""
        how = "dynamic" if self.keep is None else f"SPS, keep {self.keep:g}"
        again = ", re-evaluation" if self.re_evaluation else ""
        return f"{self.vehicles} vehicles, {self.resources} resources, {how}{again}"


def lives(keep: float) -> np.ndarray:
    """Return the probabilities (LONGEST,) that a resource is used for more than 0, 1, 2, … periods."""
    counter = np.zeros(LONGEST)
    counter[COUNTERS] = 1 / len(COUNTERS)
    ends = np.zeros(LONGEST)
    going = np.zeros(LONGEST)
    going[0] = 1.0
    for _ in range(LONGEST // int(COUNTERS[0])):
        going = np.convolve(going, counter)[:LONGEST]
        ends += (1 - keep) * going
        going = keep * going
    return np.asarray(1 - np.cumsum(ends))


def meets(case: Case) -> float:
    """Return the probability that a frame meets another on its resource, by the closed form."""
    if case.keep is None:
        return float(1 - (1 - 1 / case.resources) ** (case.vehicles - 1))
    longer = lives(case.keep)
    mean, both = longer.sum(), (longer**2).sum()
    left = (longer.sum() - np.cumsum(longer)) / mean  # the share of resources in use that are used more often yet
    free = case.resources - (case.vehicles - 1)
    both_at_once, one_unseen = both / mean**2, 2 * (longer * left).sum() / (PERIOD_MS * mean)
    return float(1 - (1 - (both_at_once + one_unseen) / free) ** (case.vehicles - 1))


def meets_by_cao(case: Case) -> float | None:
    """Return the probability that a frame meets another by Cao et al.; None if dynamic, or if resources are kept.

    With n others, π = 1 / (1 + E[C]) and A = M - n + P n / 2 free resources (two frames share one that collides) it
    is the fixed point P = 1 - (1 - 2 π / A)^n.
    """
    if case.keep != 0:
        return None
    others, selects = case.vehicles - 1, 1 / (1 + float(COUNTERS.mean()))
    meets_another = 0.0
    for _ in range(100):
        free = case.resources - others + meets_another * others / 2
        meets_another = 1 - (1 - 2 * selects / free) ** others
    return meets_another


def measured(case: Case, seconds: float, seed: int = 1) -> float:
    """Return the share of frames that meet another on their resource in a run of the engine."""
    mac: dict[str, Any] = {
        "kind": "nr-mode2",
        "scs_khz": 15,
        "subchannels": case.subchannels,
        "t1_slots": 1,
        "t2_ms": PERIOD_MS,
        "scheduling": "dynamic" if case.keep is None else "sps",
        "keep_probability": case.keep or 0.0,
        "re_evaluation": case.re_evaluation,
        "in_band_emission_db": 300.0,
    }
    radio = Radio.model_validate({"range_m": 1000.0, "access_jitter_ms": 0.0, "max_peers": 10_000, "mac": mac})
    count = case.vehicles
    engine = Engine([f"v{n}" for n in range(count)], radio, seed, np.zeros((count, 2)))
    phase_ns = np.random.default_rng(seed).integers(0, PERIOD_MS * 1_000_000, count)
    order = np.argsort(phase_ns).tolist()
    for period in range(round(seconds * 1000 / PERIOD_MS)):
        for node in order:
            time_ns = period * PERIOD_MS * 1_000_000 + int(phase_ns[node])
            engine.transmit(time_ns, node, [SentFrame(f"v{node}", bytes(20), period_ms=PERIOD_MS)])
        engine.advance((period + 1) * PERIOD_MS * 1_000_000)
    engine.drain()
    rows = engine.trace.to_table()
    sent_ns, sender, seq = (rows[name].to_numpy(zero_copy_only=False) for name in ("sent_ns", "sender", "seq"))
    outcome = rows["outcome"].to_numpy(zero_copy_only=False)
    some = sent_ns >= 2_000_000_000
    frames = dict.fromkeys(zip(sender[some], seq[some], strict=True), False)
    hit = some & (outcome == Outcome.collided.name)
    frames.update(dict.fromkeys(zip(sender[hit], seq[hit], strict=True), True))
    return float(np.mean(list(frames.values())))


CASES = [
    Case(10),
    Case(20),
    Case(40),
    Case(20, keep=0.4),
    Case(20, keep=0.8),
    Case(20, re_evaluation=True),
    Case(20, subchannels=2),
    Case(40, subchannels=2),
    Case(80, subchannels=2),
    Case(20, keep=None),
    Case(40, keep=None),
    Case(40, subchannels=2, keep=None),
]
"""Cases of the table."""
