"""The estimator of one vehicle: filter, consensus and fusion, fed with frames and fixes, and the frame it composes.

It has neither input nor output of its own: `program` brings the packets and the time. The mathematics is
`agents.cooperative.cmm`'s; here is what a vehicle does with it, and with what others send. A `FusionRule` weighs
that, as the vehicle's options say.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.cmm.consensus import (
    AveragingConsensus,
    Consensus,
    ConsensusConfig,
    DirectMean,
    RatioConsensus,
    Share,
)
from agents.cooperative.cmm.fusion import (
    Cloud,
    ExactWeights,
    OptimizedWeights,
    Points,
    constant_weights,
    fuse,
    max_degree_weights,
    metropolis_weights,
    no_fusion_weights,
    random_weights,
)
from agents.cooperative.cmm.rbpf import Observation, Rbpf
from agents.cooperative.frame import (
    MAX_DEGREE,
    MAX_HEARD,
    MAX_SENDERS,
    PARTICLE_BYTES,
    POSITION_LIMIT_M,
    RELAY_LIMIT,
    RELAYED,
    Admission,
    CooperativeFrame,
    decode,
    encode,
    heading_of_code,
    name_of_code,
    room,
    short_name,
)
from agents.cooperative.options import Options
from vnet import Fix, Packet
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array
from vnet.units import NS_PER_S

NO_FIX_NS = -(2**61)
"""Time of a vehicle without a fix yet: older than any."""
OWN_FIX_NS = 2**61
"""Time of the vehicle itself: newer than any, so that no fix of it is taken from others."""
CAPACITY = 1024
"""Number of vehicles whose relayed fixes are kept: only an attacker could name more."""
REMEMBERED_PERIODS = 4
"""Periods for which first-hand fixes are kept, to compare relayed ones with them: a relay is no older."""
PERIOD_BITS = 31
"""Bits of a key for the number of the period; 2³¹ periods of 0.1 s are seven years."""
PERIOD_MASK = 2**PERIOD_BITS - 1


class FusionRule:
    """The rule of `options`; random weights come from `rng`.

    largest_degree: the largest number of neighbours of any vehicle, as far as this one knows.
    """

    def __init__(self, options: Options, rng: np.random.Generator) -> None:
        self._options = options
        self._rng = rng
        solver = ExactWeights if options.chosen_solver == "exact" else OptimizedWeights
        self._optimized = solver(options.self_floor, options.ridge_m2 or None)
        self.largest_degree = 0

    def notice(self, largest_degrees: Sequence[int], own_degree: int) -> None:
        """Take note of the largest degrees that others know, and of the own."""
        self.largest_degree = max([self.largest_degree, own_degree, *largest_degrees])

    def weights(
        self, estimates_m: Points, variances_m2: Sequence[float], mean_m: Array | None, degrees: Sequence[int]
    ) -> list[float]:
        """Return weights (1 + n,) of the vehicle itself and n neighbours that hear `degrees` others.

        Estimates (1 + n, 2) and the traces (1 + n,) of their covariances are the vehicle's own first; `mean_m` (2,)
        is the network's mean as far as it is known.
        """
        count = len(estimates_m)
        if self._options.fusion == "optimized":
            mean_m = np.mean(estimates_m, axis=0) if mean_m is None else mean_m
            return self._optimized.solve_by_variance(estimates_m, variances_m2, mean_m.tolist())
        return list(self._simple_weights(count, degrees).tolist())

    def _simple_weights(self, count: int, degrees: Sequence[int]) -> Array:
        """Return the weights (count,) of a rule that depends on numbers of neighbours alone."""
        match self._options.fusion:
            case "random":
                return random_weights(count, self._rng)
            case "constant":
                return constant_weights(count, self._options.alpha)
            case "metropolis":
                return metropolis_weights(count - 1, degrees)
            case "max-degree":
                return max_degree_weights(count, max(self.largest_degree, count - 1))
            case _:
                return no_fusion_weights(count)


class FixTable:
    """The newest fixes by vehicle. `own_code` is the vehicle itself, which needs no fix from others."""

    def __init__(self, own_code: int, period_ns: int) -> None:
        self._period_ns = period_ns
        # In ascending order of the codes. The vehicle itself is among them, with a time that nothing exceeds.
        self._code = np.array([own_code], dtype=np.int64)
        self._time_ns = np.array([OWN_FIX_NS], dtype=np.int64)
        self._fix = np.zeros(1, dtype=RELAYED)
        self._names = [name_of_code(own_code)]
        # First-hand fixes of the last periods: keys (vehicle and period) in ascending order, and fingerprints.
        self._first_hand_key = np.array([np.iinfo(np.int64).max])
        self._first_hand = np.zeros(1, dtype=np.int64)

    def learn(self, frames: Sequence[tuple[int, CooperativeFrame]]) -> list[int]:
        """Take the fixes of frames (with their senders' codes), the senders' own and those that they relay.

        Returns the senders of forged frames, which are not used: of the fixes that they relay and that this vehicle
        has received first-hand as well, most differ.
        """
        if not frames:
            return []
        # Joined as bytes, because numpy is slow to concatenate records. Own fixes first, then relayed ones.
        count = len(frames)
        parts = [frame.own_fix(code).tobytes() for code, frame in frames]
        parts += [frame.relayed.tobytes() for _, frame in frames]
        fixes = np.frombuffer(b"".join(parts), dtype=RELAYED)
        relays = [len(frame.relayed) for _, frame in frames]
        sender = np.concatenate([np.arange(count), np.repeat(np.arange(count), relays)])
        sent_ns = np.array([frame.fix_time_ns for _, frame in frames])
        time_ns = sent_ns[sender] - fixes["age"].astype(np.int64) * self._period_ns
        code = fixes["name"].astype(np.int64)
        forged = self._forged(code, time_ns, _fingerprint(fixes), sender, count)
        kept = np.ones(len(sender), dtype=np.bool_) if not len(forged) else ~np.isin(sender, forged)
        self._take(code[kept], time_ns[kept], fixes[kept], int(kept[:count].sum()))
        return [frames[index][0] for index in forged.tolist()]

    def _forged(
        self,
        code: NDArray[np.int64],
        time_ns: NDArray[np.int64],
        fingerprint: NDArray[np.int64],
        sender: NDArray[np.intp],
        count: int,
    ) -> NDArray[np.intp]:
        """Find those of `count` senders that relay false fixes: indices. The first `count` fixes are their own."""
        key = (code << PERIOD_BITS) + time_ns // self._period_ns
        self._remember(key[:count], fingerprint[:count])
        key, fingerprint, sender = key[count:], fingerprint[count:], sender[count:]
        index = np.searchsorted(self._first_hand_key, key)
        known = self._first_hand_key[index] == key
        differs = known & (self._first_hand[index] != fingerprint)
        if not differs.any():
            return np.empty(0, dtype=np.intp)
        false = np.bincount(sender[differs], minlength=count)
        return np.flatnonzero(2 * false > np.bincount(sender[known], minlength=count))

    def _remember(self, key: NDArray[np.int64], fingerprint: NDArray[np.int64]) -> None:
        """Keep first-hand fixes for `REMEMBERED_PERIODS`."""
        now = (key & PERIOD_MASK).max()
        kept = (self._first_hand_key & PERIOD_MASK) > now - REMEMBERED_PERIODS  # and the last key
        key = np.concatenate([key, self._first_hand_key[kept]])
        order = np.argsort(key)
        self._first_hand_key = key[order]
        self._first_hand = np.concatenate([fingerprint, self._first_hand[kept]])[order]

    def _take(
        self, code: NDArray[np.int64], time_ns: NDArray[np.int64], fixes: NDArray[np.void], count: int
    ) -> None:
        """Keep the newest fix of each vehicle; of the same time the first-hand one, as the first `count` are."""
        rank = 2 * time_ns
        rank[:count] += 1
        order = np.argsort(rank, kind="stable")  # of several assignments to a row the last holds
        fixes, time_ns, rank, sorted_code = fixes[order], time_ns[order], rank[order], code[order]
        row = self._rows(sorted_code)
        if not np.array_equal(self._code[row], sorted_code):
            self._admit(code[:count], MAX_SENDERS)
            self._admit(code[count:], 0)
            row = self._rows(sorted_code)
        newer = (self._code[row] == sorted_code) & (rank > 2 * self._time_ns[row])
        row = row[newer]
        self._time_ns[row] = time_ns[newer]
        self._fix[row] = fixes[newer]

    def _rows(self, code: NDArray[np.int64]) -> NDArray[np.intp]:
        """Return the row of each code, or the row before which it would be inserted: its row may be another's."""
        return np.minimum(np.searchsorted(self._code, code), len(self._code) - 1)

    def _admit(self, code: NDArray[np.int64], reserve: int) -> None:
        """Make room for codes that are not known yet, up to the capacity and `reserve`."""
        new = np.setdiff1d(code, self._code)[: max(0, CAPACITY + reserve + 1 - len(self._code))]
        everybody = np.concatenate([self._code, new])
        order = np.argsort(everybody)
        self._code = everybody[order]
        self._time_ns = np.concatenate([self._time_ns, np.full(len(new), NO_FIX_NS)])[order]
        self._fix = np.concatenate([self._fix, np.zeros(len(new), dtype=RELAYED)])[order]
        self._names = [name_of_code(c) for c in self._code.tolist()]

    def forget(self, before_ns: int) -> None:
        """Drop what is older than `before_ns`."""
        kept = self._time_ns >= before_ns
        if not kept.all():
            self._code, self._time_ns, self._fix = self._code[kept], self._time_ns[kept], self._fix[kept]
            self._names = [name_of_code(c) for c in self._code.tolist()]

    def observations(self, now_ns: int, covariance_m2: Array) -> Iterator[tuple[str, Observation]]:
        """Yield all fixes up to `now_ns` by name, with the receiver's own `covariance_m2` (2, 2) for all."""
        position_m = np.column_stack([self._fix["x_cm"], self._fix["y_cm"]]) / 100
        age_s = ((now_ns - self._time_ns) / NS_PER_S).tolist()
        codes = self._fix["heading"].tolist()
        for name, position, code, age in zip(self._names, position_m, codes, age_s, strict=True):
            if age >= 0:
                yield name, Observation(position, covariance_m2, heading_of_code(code), age)

    def freshest(self, now_ns: int, count: int) -> NDArray[np.void]:
        """Return at most `count` fixes to relay in a frame with a fix of `now_ns`, the newest first."""
        age = np.round((now_ns - self._time_ns) / self._period_ns)
        order = np.argsort(age, kind="stable")
        order = order[(age[order] >= 0) & (age[order] <= 255)][:count]
        fixes = self._fix[order]
        fixes["age"] = age[order]
        return fixes


def _fingerprint(fixes: NDArray[np.void]) -> NDArray[np.int64]:
    """Return a number for each fix that differs where heading or position do: multiplicative hashing, may wrap."""
    x, y = fixes["x_cm"].astype(np.int64), fixes["y_cm"].astype(np.int64)
    return np.asarray((x * 0x9E3779B97F4A7C1 + y) * 0x2545F4914F6CDD1 + fixes["heading"])


MASS_GATE_SIGMAS = 5.0
"""Gate of the consensus, in deviations of the common error: mass further from the own estimate is implausible."""
MIN_SIGMA_M = 1.0
"""Deviation (m) of the common error below which the gate does not shrink: estimates scatter all the same."""
MIN_VARIANCE_M2 = 1e-6
"""Variance (m²) added to that of an estimate, so that the covariance of a collapsed cloud stays positive."""


class Estimator:
    """The state of one vehicle's cooperation.

    rbpf, consensus: the particle filter and the mean consensus.
    fused_m: (2,), the estimate of the common error right after the latest fusion.
    weights: the latest fusion weights by node id, the vehicle's own included.
    imported: number of hypotheses that the latest period imported from neighbours.
    """

    def __init__(
        self, node_id: str, options: Options, lanes: LaneMap | RoadMap, rng: np.random.Generator, period_ns: int
    ) -> None:
        self.name = short_name(node_id)
        self._admission = Admission(self.name, period_ns, decode, options.two_frames)
        self.rbpf = Rbpf(options.filter_config(), lanes, rng)
        self.consensus = mean_consensus(options, self.name, self.rejected)
        self.fused_m = self.rbpf.estimate_m
        self.weights: dict[str, float] = {}
        self.imported = 0
        self._node_id = node_id
        self._options = options
        self._rng = rng
        self._period_ns = period_ns
        self._since_fusion_s = 0.0
        self._now_ns = -period_ns
        self._covariance_m2 = np.eye(2)
        self._frames: dict[str, CooperativeFrame] = {}
        self._fixes = FixTable(int(self.name, 16), period_ns)
        self._rule = FusionRule(options, rng)
        self._share = Share(0, (0.0, 0.0, 0.0), frozenset(), frozenset())
        self._sent = self._estimate()
        self._neighbours = frozenset(map(short_name, options.hears.get(node_id, []))) if options.hears else None

    @property
    def mean_m(self) -> Array | None:
        """The network's mean (2,) as far as it is known, None before the first."""
        return self.consensus.mean_m

    @property
    def rejected(self) -> Counter[str]:
        """Number of frames and shares of others that were not used, by reason."""
        return self._admission.rejected

    # What comes in.

    def read(self, packets: Iterable[Packet], now_ns: int) -> None:
        """Take in packets from the radio; those that cannot be used are counted by reason."""
        admitted = dict(self._admission.admit(packets, now_ns))
        heard = [(int(sender, 16), frame) for sender, frame in admitted.items() if self._is_neighbour(sender)]
        forged = self._fixes.learn(heard)
        for code in forged:
            self.rejected["forged"] += 1
            del admitted[name_of_code(code)]
        self._frames |= admitted

    def _is_neighbour(self, sender: str) -> bool:
        return self._neighbours is None or sender in self._neighbours

    @property
    def common_error(self) -> tuple[Array, Array]:
        """Estimate (2,) of the common error, and its covariance (2, 2)."""
        return self.rbpf.estimate_m, self.rbpf.estimate_covariance_m2

    def sample(self, count: int) -> Array:
        """Draw at most `count` hypotheses of the common error, (n, 2)."""
        return self.rbpf.sample(min(count, self.rbpf.config.particles))

    def filter(self, own: Fix) -> None:
        """Take all fixes that have come, up to the time of the vehicle's `own`."""
        dt_s = max(0, own.time_ns - self._now_ns) / NS_PER_S
        self._since_fusion_s += dt_s
        self._now_ns = max(self._now_ns, own.time_ns)
        self._fixes.forget(own.time_ns - round(self.rbpf.config.memory_s * NS_PER_S))
        if np.isfinite(own.covariance_m2).all():
            self._covariance_m2 = own.covariance_m2
        observations = dict(self._fixes.observations(own.time_ns, self._covariance_m2))
        if usable(own):
            observations[self.name] = Observation(own.position_m, own.covariance_m2, own.heading_rad)
        self.rbpf.step(dt_s, observations)

    def position(self, own: Fix) -> tuple[Array, Array]:
        """Position (2,) of the vehicle and its covariance (2, 2); NaN as long as no fix tells it."""
        if self.name in self.rbpf.vehicles:
            return self.rbpf.position_m(self.name)
        # The filter has forgotten a vehicle whose own fixes have been outliers for seconds.
        return own.position_m - self.rbpf.estimate_m, own.covariance_m2 + self.rbpf.estimate_covariance_m2

    # Agreement with the neighbours.

    def agree(self) -> None:
        """Do one round of consensus, and fuse, with the senders of the frames since the last round."""
        # After a pause there are frames of before it: of senders that have been forgotten since.
        fresh = {sender: frame for sender, frame in sorted(self._frames.items()) if sender in self._admission.ids}
        everybody, self._frames = self._plausible(fresh), {}
        frames = {sender: frame for sender, frame in everybody.items() if self._is_neighbour(sender)}
        self._take_round(everybody if self._options.consensus == "exact" else frames)
        self._rule.notice([frame.largest_degree for frame in frames.values()], len(self._share.heard))
        self.imported = 0
        self.fused_m = self._fuse(frames) if frames and self._fusion_is_due() else self.rbpf.estimate_m
        if self._options.separate_map_update:
            self.rbpf.update_from_map()

    def _plausible(self, frames: dict[str, CooperativeFrame]) -> dict[str, CooperativeFrame]:
        """Return the frames without outliers: estimates that are not where most are. Decided again each period."""
        if not frames or not self._options.defence:
            return frames
        inside = near_the_median(*self._sent_estimates(frames), self._options.common_sigma_m)[1:].tolist()
        if all(inside):
            return frames
        self.rejected["outlier"] += inside.count(False)
        return {sender: frame for (sender, frame), good in zip(frames.items(), inside, strict=True) if good}

    def _take_round(self, frames: Mapping[str, CooperativeFrame]) -> None:
        """Do a round of consensus with the shares in `frames`."""
        shares = {
            sender: Share(frame.epoch, frame.running_sum, frame.out_neighbours, frame.names_heard)
            for sender, frame in frames.items()
        }
        self._share = self.consensus.round(self.rbpf.estimate_m, shares)

    def _fusion_is_due(self) -> bool:
        """Tell whether the fusion interval is over, and begin the next one if so."""
        half_period_s = self._period_ns / 2 / NS_PER_S
        if self._since_fusion_s < self._options.fusion_interval_s - half_period_s:
            return False
        self._since_fusion_s = 0.0
        return True

    def _fuse(self, frames: Mapping[str, CooperativeFrame]) -> Array:
        """Mix the neighbours' particles; returns the estimate (2,) right afterwards."""
        weights = self._fusion_weights(frames)
        ids = [self._node_id, *(self._admission.ids[sender] for sender in frames)]
        self.weights = dict(zip(ids, weights, strict=True))
        clouds = [Cloud(frame.cloud_m, _known(sender, frame)) for sender, frame in frames.items()]
        fused_m, self.imported = fuse(self.rbpf, clouds, np.array(weights), self._rng)
        return fused_m

    def _fusion_weights(self, frames: Mapping[str, CooperativeFrame]) -> list[float]:
        """Fusion weights (1 + n,) of this vehicle and its neighbours, by the rule of the options."""
        degrees = [len(frame.heard) for frame in frames.values()]
        estimates_m, covariances_m2 = self._sent_estimates(frames)
        variances_m2 = covariances_m2[:, 0, 0] + covariances_m2[:, 1, 1]
        return self._rule.weights(estimates_m.tolist(), variances_m2.tolist(), self.consensus.mean_m, degrees)

    def _sent_estimates(self, frames: Mapping[str, CooperativeFrame]) -> tuple[Array, Array]:
        """Estimates (1 + n, 2) and covariances (1 + n, 2, 2) as they were sent, the vehicle's own first."""
        estimates = np.array([self._sent[0], *(frame.estimate_m for frame in frames.values())])
        return estimates, np.array([self._sent[1], *(frame.covariance_m2 for frame in frames.values())])

    def _estimate(self) -> tuple[Array, Array]:
        """Estimate (2,) of the common error and its covariance (2, 2), as they are sent."""
        return self.rbpf.estimate_m, self.rbpf.estimate_covariance_m2 + MIN_VARIANCE_M2 * np.eye(2)

    # What goes out.

    def frame(self, fix: Fix, max_payload: int) -> bytes:
        """Return the bytes to broadcast with the newest fix, at most `max_payload`."""
        frame = self.compose(fix, max_payload)
        self._admission.claim(self.name, fix.time_ns, frame.fingerprint)
        return encode(frame)

    def compose(self, fix: Fix, max_payload: int) -> CooperativeFrame:
        """Compose the frame with the newest fix: names, then particles, then relays, while `max_payload` lasts."""
        share = self._share
        self._sent = self._estimate()
        heard = {name: name in share.out_neighbours for name in sorted(share.heard)[:MAX_HEARD]}
        left = room(len(heard), max_payload)
        mixes = self._options.fusion != "none"
        particles = min(self.rbpf.config.particles, left // PARTICLE_BYTES) if mixes else 0
        relays = min(RELAY_LIMIT, (left - PARTICLE_BYTES * particles) // RELAYED.itemsize)
        return CooperativeFrame(
            fix_time_ns=fix.time_ns,
            fix_m=fix.position_m,
            heading_rad=fix.heading_rad,
            estimate_m=self._sent[0],
            covariance_m2=self._sent[1],
            epoch=share.epoch,
            running_sum=share.running_sum,
            heard=heard,
            cloud_m=self.rbpf.sample(particles),
            relayed=self._fixes.freshest(fix.time_ns, relays if self._options.relay else 0),
            largest_degree=min(self._rule.largest_degree, MAX_DEGREE),
            name=self.name,
        )


def usable(fix: Fix) -> bool:
    """Tell whether a fix can be filtered and sent: receivers fail, too."""
    position_m = fix.position_m.tolist()
    numbers = (*position_m, *fix.covariance_m2.ravel().tolist(), fix.heading_rad or 0.0)
    return all(map(math.isfinite, numbers)) and max(map(abs, position_m)) <= POSITION_LIMIT_M


def _known(sender: str, frame: CooperativeFrame) -> frozenset[str]:
    """Names of the vehicles whose fixes are in the sender's cloud."""
    return frame.names_heard | {sender} | {name_of_code(code) for code in frame.relayed["name"].tolist()}


def mean_consensus(options: Options, name: str, rejected: Counter[str]) -> Consensus:
    """Return the consensus of the options for the vehicle `name`; it counts in `rejected` what it does not take."""
    gate_m = MASS_GATE_SIGMAS * max(MIN_SIGMA_M, options.common_sigma_m) if options.defence else np.inf
    config = ConsensusConfig(gate_m=gate_m)
    match options.consensus:
        case "ratio":
            return RatioConsensus(name, config, rejected)
        case "exact":
            return DirectMean(current=options.two_frames)
        case rule:
            return AveragingConsensus(name, rule, config, rejected)


GATE_SIGMAS = 5.0
"""Width of the gate in standard deviations: honest estimates are outside four times in a million."""
GATE_FLOOR_M = 0.25
"""Deviation (m) added in quadrature: filters are somewhat overconfident, and drift apart by chance."""


def median(points: Array) -> Array:
    """Return the coordinate-wise median (d,) of points (n, d); of two it is the middle."""
    ordered = np.sort(points, axis=0)
    count = len(points)
    return np.asarray((ordered[(count - 1) // 2] + ordered[count // 2]) / 2)


def near_the_median(estimates_m: Array, covariances_m2: Array, largest_sigma_m: float) -> NDArray[np.bool_]:
    """Find the estimates (n, 2) with covariances (n, 2, 2) that are near the median of all: a mask (n,).

    A gate around the median of all: d² ≤ g² (σ² + σ_j² + f²), with σ² the median of all variances an axis, and
    σ_j² the variance that j claims, but no more than `largest_sigma_m`². As long as attackers are a minority they
    move the centre no further than honest estimates scatter, and neither a small nor a large covariance helps
    them. A vehicle that knows little and says so, as after a restart, is inside.
    """
    variance = np.einsum("nii->n", covariances_m2) / 2
    usual = median(variance[:, None])[0]
    allowed = usual + np.minimum(variance, largest_sigma_m**2) + GATE_FLOOR_M**2
    offset = estimates_m - median(estimates_m)
    return np.asarray((offset * offset).sum(axis=1) <= GATE_SIGMAS**2 * allowed)
