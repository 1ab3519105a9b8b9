"""The estimator of a vehicle that exchanges information about the common error (MODEL 10).

Each vehicle filters itself alone, and tells its neighbours what it knew of the common error before its fix, and
what the fix says about it. Priors are pooled with the weights of the fusion rule, because they may rest on the same
fixes; increments are added, because they are new. Increments from out of range are passed on by one hop: a frame
lists those that its sender used in the period before, and so says what its prior holds; a receiver adds of each the
share that the pooled priors do not hold.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.admission import Admission
from agents.cooperative.estimator import mean_consensus, usable
from agents.cooperative.frame import MAX_DEGREE, short_name
from agents.cooperative.fusion_rule import FusionRule
from agents.cooperative.information_frame import (
    INCREMENT_LIMIT,
    MAX_HEARD,
    PASSED,
    InformationFrame,
    decode,
    encode,
    room,
)
from agents.cooperative.options import Options
from vnet import Fix, Packet
from vnet.cmm.consensus import Share, tracked_mean
from vnet.cmm.information import Information
from vnet.cmm.own_vehicle import own_vehicle
from vnet.cmm.plausibility import (
    INCREMENT_FACTOR,
    PRIOR_FACTOR,
    SELF_SHARE,
    SPREAD_GATE,
    Origins,
    cut_to,
    matrices,
    median_belief,
    prior_moments,
    priors_agree,
    scaled_down,
    spread_limit_m,
    unless_most_disagree,
)
from vnet.cmm.rbpf import Observation
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array
from vnet.units import NS_PER_S

LOST_PERIODS = 10
"""Periods on end in which most neighbours contradict the vehicle, after which it is the vehicle that is wrong."""
LOST_NEIGHBOURS = 3
"""Least number of neighbours that can say so."""
PASSED_SHARE = 0.8
"""Share of an increment that is passed on which is added: what priors hold by longer ways is not in their lists,
and with the whole the vehicles are too sure (ANEES 1.25 on N1 in place of 1.16; the error grows by 1 %)."""
MAX_FORGED_SHARE = 0.5
"""Share of the increments that are known first-hand, beyond which a frame that passes on others is forged."""


def as_sent(information: Information) -> tuple[float, ...]:
    """Return the five numbers of `information` with the precision in which frames carry them."""
    (a, b), (_, d) = information.matrix.tolist()
    return tuple(np.array([a, b, d, *information.vector], dtype="<f4").tolist())


class InformationEstimator:
    """The state of one vehicle's cooperation by information.

    period_s, rng: the period and the vehicle's own random numbers.
    own: what the vehicle knows of itself and of the common error.
    fused_m: (2,), the estimate of the common error right after the latest fusion.
    weights: the latest fusion weights by node id, the vehicle's own included.
    mean_m: (2,), the network's mean as far as it is known, None before the first.
    limit_m: distance from the median of what is heard to which the latest period's priors were moved.
    imported: number of increments that the latest period took from others.
    """

    def __init__(
        self, node_id: str, options: Options, lanes: LaneMap | RoadMap, rng: np.random.Generator, period_ns: int
    ) -> None:
        self.name = short_name(node_id)
        self.own = own_vehicle(options.own_config(), lanes, rng)
        self._admission = Admission(self.name, period_ns, decode)
        self.consensus = mean_consensus(options, self.name, self.rejected)
        self.fused_m = self.own.estimate_m
        self.mean_m: Array | None = None
        self.weights: dict[str, float] = {}
        self.imported = 0
        self.limit_m = np.inf
        self._node_id = node_id
        self._options = options
        self._period_ns = period_ns
        self.period_s = period_ns / NS_PER_S
        self.rng = rng
        self._rule = FusionRule(options, rng)
        self._origins = Origins()
        self._frames: dict[str, InformationFrame] = {}
        self._share = Share(0, (0.0, 0.0, 0.0), frozenset(), frozenset())
        self._now_ns = -period_ns
        self._contradicted = 0
        self._prior = np.array(as_sent(self.own.prior))
        self._increment = np.zeros(5)
        self._largest_increment = 0.0
        self._code = _code(self.name)
        self._used = np.array([self._code], dtype=np.uint32), self._increment[None].astype(np.float16)
        self._neighbours = frozenset(map(short_name, options.hears.get(node_id, []))) if options.hears else None

    @property
    def rejected(self) -> Counter[str]:
        """Number of frames and increments of others that were not used, by reason."""
        return self._admission.rejected

    @property
    def common_error(self) -> tuple[Array, Array]:
        """Estimate (2,) of the common error, and its covariance (2, 2)."""
        return self.own.estimate_m, self.own.estimate_covariance_m2

    def sample(self, count: int) -> Array:
        """Draw `count` hypotheses (count, 2) of the common error."""
        return self.own.sample(count)

    def read(self, packets: Iterable[Packet], now_ns: int) -> None:
        """Take in packets from the radio; those that cannot be used are counted by reason."""
        self._frames |= self._admission.admit(packets, now_ns)

    def position(self, own: Fix) -> tuple[Array, Array]:
        """Position (2,) of the vehicle and its covariance (2, 2); NaN as long as no fix tells it."""
        position = self.own.position_m()
        if position is not None:
            return position
        return own.position_m - self.own.estimate_m, own.covariance_m2 + self.own.estimate_covariance_m2

    # A period: first the own fix, then what others say.

    def observe(self, own: Fix) -> None:
        """Advance to the time of the vehicle's own fix, and take it; once a period."""
        if own.time_ns <= self._now_ns:
            return
        dt_s, self._now_ns = (own.time_ns - self._now_ns) / NS_PER_S, own.time_ns
        fix = Observation(own.position_m, own.covariance_m2, own.heading_rad) if usable(own) else None
        increment = np.array(as_sent(self.own.step(dt_s, fix)))
        self._increment = increment * min(1.0, INCREMENT_LIMIT / max(np.abs(increment).max(), 1.0))
        self._prior = np.array(as_sent(self.own.prior))

    def filter(self, own: Fix) -> None:
        """Take the vehicle's own fix, if that has not been done to compose a frame."""
        self.observe(own)

    def agree(self) -> None:
        """Do a round of consensus, and fuse, with the frames of this period."""
        frames = {
            sender: frame for sender, frame in sorted(self._frames.items()) if self._is_current(sender, frame)
        }
        self._frames = {}
        # What this vehicle says itself is the first row of all.
        table = np.array(
            [[*self._prior, *self._increment, *prior_moments(*self._prior.tolist())]]
            + [frame.numbers for frame in frames.values()]
        )
        said, means_m, covariances_m2 = table[:, :10], table[:, 10:12], matrices(table[:, 12:])
        believed = self._believed(list(frames), said, means_m, covariances_m2)
        if not believed.all():
            frames = {name: frames[name] for name, good in zip(frames, believed[1:].tolist(), strict=True) if good}
            table = table[believed]
            said, means_m, covariances_m2 = table[:, :10], table[:, 10:12], matrices(table[:, 12:])
        names = list(frames)
        priors, means_m, leaning = self._moderated(names, said[:, :5], means_m, table[:, 12:])
        self._share = self.consensus.round(means_m[0], {sender: frame.share for sender, frame in frames.items()})
        self.mean_m = self.consensus.mean_m
        if self._options.consensus == "ratio":
            self.mean_m = tracked_mean(means_m.sum(axis=0) / len(means_m), self.mean_m, self.limit_m / SPREAD_GATE)
        priors, increments = self._limited(priors, said[:, 5:])
        weights = self._weigh(frames, means_m, covariances_m2, leaning)
        pooled = weights @ priors + increments.sum(axis=0)
        passed = self._passed_on(frames, weights)
        pooled += passed.sum(axis=0)
        self.imported = len(names) + len(passed)
        self._used = np.array([self._code, *map(_code, names)], dtype=np.uint32), said[:, 5:].astype(np.float16)
        if self.imported:
            self.own.absorb(Information(matrices(pooled[None])[0], pooled[3:]))
        self.fused_m = self.own.estimate_m

    def _is_current(self, sender: str, frame: InformationFrame) -> bool:
        """Tell whether a frame is of this period: what it says is of one instant, and is fused then or never."""
        if sender not in self._admission.ids or (self._neighbours is not None and sender not in self._neighbours):
            return False
        if frame.fix_time_ns == self._now_ns:
            return True
        self.rejected["late"] += 1
        return False

    def _believed(self, names: list[str], said: Array, means_m: Array, covariances_m2: Array) -> NDArray[np.bool_]:
        """Tell which rows (1 + n,) of priors and increments are plausible; the vehicle's own are the first."""
        believed = np.ones(len(said), dtype=np.bool_)
        if not self._options.defence or not names:
            return believed
        own = means_m[0], covariances_m2[0]
        near = priors_agree(means_m[1:], covariances_m2[1:], *own)
        agrees = self._origins.agree([_code(name) for name in names], said[1:, 5:], own, self._now_ns / NS_PER_S)
        agrees = unless_most_disagree(agrees)
        self._notice_being_lost(near, said[1:, :5])
        self._reject("prior", ~near)
        self._reject("increment", near & ~agrees)
        believed[1:] = near & agrees
        return believed

    def _reject(self, reason: str, which: NDArray[np.bool_]) -> None:
        """Count what is not used."""
        if count := int(np.count_nonzero(which)):
            self.rejected[reason] += count

    def _notice_being_lost(self, near: NDArray[np.bool_], priors: Array) -> None:
        """Begin again at the median of what the others know, if most have contradicted this vehicle for long."""
        contradicted = len(near) >= LOST_NEIGHBOURS and 2 * np.count_nonzero(~near) > len(near)
        self._contradicted = self._contradicted + 1 if contradicted else 0
        if self._contradicted >= LOST_PERIODS:
            self._contradicted = 0
            self._origins = Origins()
            self.own.restart(median_belief(priors))
            self._prior = np.array(as_sent(self.own.prior))
            self._increment = np.zeros(5)

    def _moderated(
        self, names: list[str], priors: Array, means_m: Array, variances_m2: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return the priors (1 + n, 5) of the vehicle and of `names`, and their means, none far from their median.

        `variances_m2` (1 + n, 3) are those of the means (1 + n, 2). No vehicle is dropped: where a few hear what
        the others cannot know, they are always off, and right. The last value (1 + n,) tells which always are.
        """
        leaning = np.zeros(len(means_m), dtype=np.bool_)
        if not self._options.defence or not names:
            self.limit_m = np.inf
            return priors, means_m, leaning
        median_m, self.limit_m = spread_limit_m(means_m)
        if self.limit_m == np.inf:
            median_m = means_m[0]
        off_m = means_m[1:] - median_m
        codes = [_code(name) for name in names]
        now_s = self._now_ns / NS_PER_S
        less_m, leaning[1:] = self._origins.without_lean(codes, off_m, variances_m2[1:] + variances_m2[0], now_s)
        less_m = cut_to(less_m, self.limit_m)
        if less_m is off_m:
            return priors, means_m, leaning
        moved_m = np.zeros_like(means_m)
        moved_m[1:] = less_m - off_m
        priors = priors.copy()
        priors[:, 3] += priors[:, 0] * moved_m[:, 0] + priors[:, 1] * moved_m[:, 1]
        priors[:, 4] += priors[:, 1] * moved_m[:, 0] + priors[:, 2] * moved_m[:, 1]
        return priors, means_m + moved_m, leaning

    def _limited(self, priors: Array, increments: Array) -> tuple[Array, Array]:
        """Return priors and increments (1 + n, 5) of all rows, none much more certain than one's own."""
        if not self._options.defence:
            return priors, increments
        traces = (increments[:, 0] + increments[:, 2]).tolist()
        usual = INCREMENT_FACTOR * max(traces[0], sorted(traces)[len(traces) // 2])
        self._largest_increment = max(usual, self.own.largest_increment)
        largest = PRIOR_FACTOR * _trace(self._prior)
        return scaled_down(priors, largest), scaled_down(increments, self._largest_increment)

    def _weigh(
        self,
        frames: Mapping[str, InformationFrame],
        means_m: Array,
        covariances_m2: Array,
        leaning: NDArray[np.bool_],
    ) -> Array:
        """Return the weights (1 + n,) of the priors, with means (1 + n, 2) and covariances (1 + n, 2, 2).

        The weight of who is always to one side, `leaning` (1 + n,), goes to the vehicle itself.
        """
        self._rule.notice([frame.largest_degree for frame in frames.values()], len(self._share.heard))
        degrees = [len(frame.heard) for frame in frames.values()]
        weights = self._rule.weights(means_m, covariances_m2, self.mean_m, degrees)
        if self._options.defence:
            weights = np.where(leaning, 0.0, (1 - SELF_SHARE) * weights)
            weights[0] += 1 - weights.sum()
        ids = [self._node_id, *(self._admission.ids[name] for name in frames)]
        self.weights = dict(zip(ids, weights.tolist(), strict=True))
        return weights

    # What is passed on.

    def _passed_on(self, frames: Mapping[str, InformationFrame], weights: Array) -> Array:
        """Return the increments (m, 5) of the last period from out of range, less what the pooled priors hold."""
        own_codes, own_increments = self._used
        counts = [len(own_codes), *(len(frame.passed) for frame in frames.values())]
        if sum(counts) == len(own_codes):
            return np.zeros((0, 5))
        codes = np.concatenate([own_codes, *(frame.passed_codes for frame in frames.values())])
        numbers = np.concatenate([own_increments, *(frame.passed_numbers for frame in frames.values())])
        sender = np.repeat(np.arange(len(counts)), counts)
        first, index = first_of_each(codes)
        origin = codes[first]
        forged = self._forged(numbers, sender, first[index], len(counts))
        if forged.any():
            weights = np.where(forged, 0.0, weights)
        share = np.bincount(index, weights=weights[sender], minlength=len(origin))
        new = (first >= len(own_codes)) & (share < 1) & ~forged[sender[first]]
        if not new.any():
            return np.zeros((0, 5))
        increments = numbers[first[new]] * (PASSED_SHARE * (1 - share[new]))[:, None]
        if not self._options.defence:
            return np.asarray(increments)
        agrees = self._origins.agree(origin[new].tolist(), increments, self.own.belief, self._now_ns / NS_PER_S)
        if not agrees.all():
            self._reject("passed", ~agrees)
            increments = increments[agrees]
        return scaled_down(increments, self._largest_increment)

    def _forged(
        self, numbers: Array, sender: NDArray[np.intp], first: NDArray[np.intp], count: int
    ) -> NDArray[np.bool_]:
        """Tell which of `count` senders pass on false increments: most of those that are known first-hand differ.

        `numbers` (m, 5) are the increments and `first` (m,) the first row of each one's origin; the vehicle's own
        rows are the first.
        """
        if not self._options.defence:
            return np.zeros(count, dtype=np.bool_)
        known = first < len(self._used[0])
        differs = known & (numbers != numbers[first]).any(axis=1)
        if not differs.any():
            return np.zeros(count, dtype=np.bool_)
        false = np.bincount(sender[differs], minlength=count)
        forged = np.asarray(false > MAX_FORGED_SHARE * np.bincount(sender[known], minlength=count))
        self._reject("forged", forged)
        return forged

    # What goes out.

    def frame(self, fix: Fix, max_payload: int) -> bytes:
        """Return the bytes to broadcast with the newest fix, at most `max_payload`."""
        self.observe(fix)
        frame = self.compose(fix, max_payload)
        self._admission.claim(self.name, fix.time_ns, frame.fingerprint)
        return encode(frame)

    def compose(self, fix: Fix, max_payload: int) -> InformationFrame:
        """Compose the frame with the newest fix: names, then increments to pass on, while `max_payload` lasts."""
        share = self._share
        heard = {name: name in share.out_neighbours for name in sorted(share.heard)[:MAX_HEARD]}
        limit = min(self._options.relay_increments, room(len(heard), max_payload))
        return InformationFrame(
            name=self.name,
            fix_time_ns=fix.time_ns,
            prior=tuple(self._prior.tolist()),
            increment=tuple(self._increment.tolist()),
            epoch=share.epoch,
            running_sum=share.running_sum,
            heard=heard,
            passed=_records(*self._used)[_in_turns(len(self._used[0]), limit, fix.time_ns // self._period_ns)],
            largest_degree=min(self._rule.largest_degree, MAX_DEGREE),
        )


def _code(name: str) -> int:
    """Return the code of a short name; `name_of_code` is the inverse."""
    return int(name, 16)


def _records(codes: NDArray[np.uint32], increments: NDArray[np.float16]) -> NDArray[np.void]:
    """Return records (n,) of `PASSED` of the increments (n, 5) of these origins."""
    records = np.empty(len(codes), dtype=PASSED)
    records["name"] = codes
    records["information"] = increments
    return records


def first_of_each(codes: NDArray[np.uint32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first row of each origin in `codes` (m,), by code, and the number (m,) of each row's origin."""
    order = codes.argsort(kind="stable")
    ordered = codes[order]
    starts = np.ones(len(codes), dtype=np.bool_)
    np.not_equal(ordered[1:], ordered[:-1], out=starts[1:])
    index = np.empty(len(codes), dtype=np.intp)
    index[order] = starts.cumsum() - 1
    return order[starts], index


def _in_turns(count: int, limit: int, period: int) -> NDArray[np.intp] | slice:
    """Return the rows of at most `limit` of `count` records, the first and of the others in turns."""
    if limit >= count:
        return slice(None)
    turned = 1 + (np.arange(limit - 1) + period * limit) % (count - 1)
    return np.append(0, turned)[:limit]


def _trace(information: Array) -> float:
    """Return the trace of the matrix of information (5,)."""
    return float(information[0] + information[2])
