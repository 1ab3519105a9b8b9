"""The estimator of a vehicle that exchanges information about the common error (MODEL 10).

Each vehicle filters itself alone, and tells its neighbours what it knew of the common error before its fix, and
what the fix says about it. Priors are pooled with the weights of the fusion rule, because they may rest on the same
fixes; increments are added, because they are new. Increments from out of range are passed on by one hop: a frame
lists those that its sender used in the period before, and so says what its prior holds; a receiver adds of each the
share that the pooled priors do not hold.
"""

from __future__ import annotations

import struct
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
    packed_numbers,
    passed_record,
    room,
)
from agents.cooperative.options import Options
from vnet import Fix, Packet
from vnet.cmm.consensus import Share, tracked_mean
from vnet.cmm.information import Information
from vnet.cmm.own_vehicle import own_vehicle
from vnet.cmm.plausibility import (
    INCREMENT_FACTOR,
    MAX_ORIGINS,
    PRIOR_FACTOR,
    SELF_SHARE,
    SPREAD_GATE,
    Origins,
    cut_to,
    matrices,
    median_belief,
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


_SENT = struct.Struct("<5f")
_NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0)
_ROW = 15
"""Numbers of a vehicle: prior, increment, and the prior's mean and covariance."""


def as_sent(information: Information) -> tuple[float, ...]:
    """Return the five numbers of `information` with the precision in which frames carry them."""
    (a, b), (_, d) = information.matrix.tolist()
    return _SENT.unpack(_SENT.pack(a, b, d, *information.vector.tolist()))


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
        self._prior = as_sent(self.own.prior)
        self._increment: tuple[float, ...] = _NOTHING
        self._largest_increment = 0.0
        self._code = int(self.name, 16)
        self._used = passed_record(self._code, self._increment)
        self._passing = Passing()
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
        increment = as_sent(self.own.step(dt_s, fix))
        largest = max(map(abs, increment))
        if largest > INCREMENT_LIMIT:
            increment = tuple(value * (INCREMENT_LIMIT / largest) for value in increment)
        self._increment = increment
        self._prior = as_sent(self.own.prior)

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
        rows = [packed_numbers(self._prior, self._increment), *[frame.numbers for frame in frames.values()]]
        table = np.frombuffer(b"".join(rows)).reshape(-1, _ROW)
        codes = [frame.code for frame in frames.values()]
        believed = self._believed(codes, table)
        if believed is not None:
            frames = {name: frames[name] for name, good in zip(frames, believed, strict=True) if good}
            codes = [frame.code for frame in frames.values()]
            table = table[[True, *believed]]
        said, means_m = table[:, :10], table[:, 10:12]
        priors, means_m, leaning = self._moderated(codes, said[:, :5], means_m, table[:, 12:])
        self._share = self.consensus.round(means_m[0], {sender: frame.share for sender, frame in frames.items()})
        self.mean_m = self.consensus.mean_m
        if self._options.consensus == "ratio":
            self.mean_m = tracked_mean(
                np.add.reduce(means_m) / len(means_m), self.mean_m, self.limit_m / SPREAD_GATE
            )
        priors, increments = self._limited(priors, said[:, 5:])
        weights = self._weigh(frames, means_m, matrices(table[:, 12:]), leaning)
        pooled = weights @ priors + np.add.reduce(increments)
        passed = self._passed_on(frames, weights)
        pooled += np.add.reduce(passed)
        self.imported = len(frames) + len(passed)
        own = passed_record(self._code, self._increment)
        self._used = b"".join([own, *[frame.record for frame in frames.values()]])
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

    def _believed(self, codes: list[int], table: Array) -> list[bool] | None:
        """Tell which of the senders `codes` (n,) are plausible, None if all are.

        `table` (1 + n, 15) has what they say, and first what the vehicle says itself.
        """
        if not self._options.defence or not codes:
            return None
        own, others = table[0], table[1:]
        own_m2 = matrices(own[None, 12:])[0]
        near = priors_agree(others[:, 10:12], others[:, 12:], own[10:12], own[12:])
        agrees = self._origins.agree(codes, others[:, 5:10], (own[10:12], own_m2), self._now_ns / NS_PER_S)
        agrees = unless_most_disagree(agrees)
        self._notice_being_lost(near, others[:, :5])
        believed = near & agrees
        if np.count_nonzero(believed) == len(codes):
            return None
        self._reject("prior", ~near)
        self._reject("increment", near & ~agrees)
        return [bool(good) for good in believed]

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
            self._prior, self._increment = as_sent(self.own.prior), _NOTHING

    def _moderated(
        self, codes: list[int], priors: Array, means_m: Array, variances_m2: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return the priors (1 + n, 5) of the vehicle and of `codes`, and their means, none far from their median.

        `variances_m2` (1 + n, 3) are those of the means (1 + n, 2). No vehicle is dropped: where a few hear what
        the others cannot know, they are always off, and right. The last value (1 + n,) tells which always are.
        """
        leaning = np.zeros(len(means_m), dtype=np.bool_)
        if not self._options.defence or not codes:
            self.limit_m = np.inf
            return priors, means_m, leaning
        median_m, self.limit_m = spread_limit_m(means_m)
        if self.limit_m == np.inf:
            median_m = means_m[0]
        off_m = means_m[1:] - median_m
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
        largest = PRIOR_FACTOR * (self._prior[0] + self._prior[2])
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
            weights = (1 - SELF_SHARE) * weights
            weights[leaning] = 0.0
            weights[0] += 1 - np.add.reduce(weights)
        ids = [self._node_id, *(self._admission.ids[name] for name in frames)]
        self.weights = dict(zip(ids, weights.tolist(), strict=True))
        return weights

    # What is passed on.

    def _passed_on(self, frames: Mapping[str, InformationFrame], weights: Array) -> Array:
        """Return the increments (m, 5) of the last period from out of range, less what the pooled priors hold."""
        said = [self._used, *[frame.passed_records for frame in frames.values()]]
        counts = [len(records) // PASSED.itemsize for records in said]
        joined = b"".join(said)
        records = np.frombuffer(joined, dtype=PASSED)
        if len(records) == counts[0]:
            return np.zeros((0, 5))
        index = self._passing.index(records["name"])
        origins = self._passing.codes
        # The first row of each origin, 0 where it has none; the vehicle's own rows are the first of all.
        first = np.zeros(len(origins), dtype=np.intp)
        first[index[::-1]] = np.arange(len(records) - 1, -1, -1)
        weight = np.repeat(weights, counts)
        new = first >= counts[0]
        if self._options.defence and (differs := _differing(joined, first.take(index))) is not None:
            forged = self._forged(differs, np.repeat(np.arange(len(counts)), counts), first[index] < counts[0])
            weight[forged] = 0.0
            new &= ~forged[first]
        share = np.bincount(index, weights=weight, minlength=len(origins))
        rows = np.flatnonzero(new & (share < 1))
        if not len(rows):
            return np.zeros((0, 5))
        numbers = records["information"][first.take(rows)].astype(np.float64)
        increments = numbers * (PASSED_SHARE * (1 - share.take(rows)))[:, None]
        if not self._options.defence:
            return np.asarray(increments)
        origin = origins.take(rows).tolist()
        agrees = self._origins.agree(origin, increments, self.own.belief, self._now_ns / NS_PER_S)
        if np.count_nonzero(agrees) < len(rows):
            self._reject("passed", ~agrees)
            increments = increments[agrees]
        return scaled_down(increments, self._largest_increment)

    def _forged(
        self, differs: NDArray[np.bool_], sender: NDArray[np.intp], known: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Tell which rows (m,) are of senders that forge: most of what they pass on that is `known` differs."""
        false = np.bincount(sender[differs & known], minlength=sender[-1] + 1)
        forged = np.asarray(false > MAX_FORGED_SHARE * np.bincount(sender[known], minlength=sender[-1] + 1))
        self._reject("forged", forged)
        return np.asarray(forged[sender])

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
        used = np.frombuffer(self._used, dtype=PASSED)
        return InformationFrame(
            name=self.name,
            fix_time_ns=fix.time_ns,
            prior=self._prior,
            increment=self._increment,
            epoch=share.epoch,
            running_sum=share.running_sum,
            heard=heard,
            passed=used[_in_turns(len(used), limit, fix.time_ns // self._period_ns)],
            largest_degree=min(self._rule.largest_degree, MAX_DEGREE),
        )


class Passing:
    """The origins of increments that are passed on.

    codes: (n,), sorted; they are kept from period to period, because to find a code is less work than to sort.
    """

    def __init__(self) -> None:
        self.codes = np.empty(0, dtype=np.uint32)

    def index(self, codes: NDArray[np.uint32]) -> NDArray[np.intp]:
        """Return the index (m,) of each of `codes` (m,) in `self.codes`; new ones are added."""
        if len(self.codes):
            index = np.minimum(self.codes.searchsorted(codes), len(self.codes) - 1)
            if np.count_nonzero(self.codes.take(index) == codes) == len(codes):
                return np.asarray(index)
        kept = self.codes[: MAX_ORIGINS if len(self.codes) < MAX_ORIGINS else 0]
        self.codes = np.unique(np.concatenate([kept, codes]))
        return self.codes.searchsorted(codes)


def _differing(records: bytes, first: NDArray[np.intp]) -> NDArray[np.bool_] | None:
    """Tell which rows (m,) of `records` are not equal to their `first` (m,), None if there are none."""
    entries = np.frombuffer(records, dtype=np.uint16).reshape(len(first), -1)
    differs = entries != entries.take(first, axis=0)
    return differs.any(axis=1) if np.count_nonzero(differs) else None


def _in_turns(count: int, limit: int, period: int) -> NDArray[np.intp] | slice:
    """Return the rows of at most `limit` of `count` records, the first and of the others in turns."""
    if limit >= count:
        return slice(None)
    turned = 1 + (np.arange(limit - 1) + period * limit) % (count - 1)
    return np.append(0, turned)[:limit]
