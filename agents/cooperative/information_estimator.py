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
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from agents.cooperative.admission import Admission
from agents.cooperative.estimator import mean_consensus, usable
from agents.cooperative.frame import MAX_DEGREE, short_name
from agents.cooperative.fusion_rule import FusionRule
from agents.cooperative.information_frame import (
    INCREMENT_LIMIT,
    MAX_HEARD,
    InformationFrame,
    decode,
    encode,
    packed_numbers,
    passed_record,
    room,
)
from agents.cooperative.options import Options
from agents.cooperative.passing import Passing, codes_and_increments
from vnet import Fix, Packet
from vnet.cmm.consensus import Share, tracked_mean
from vnet.cmm.information import Five, Information, plain_moments
from vnet.cmm.own_vehicle import own_vehicle
from vnet.cmm.plausibility import (
    INCREMENT_FACTOR,
    PRIOR_FACTOR,
    SELF_SHARE,
    SPREAD_GATE,
    Origins,
    cut_to,
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


_SENT = struct.Struct("<5f")
_NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0)


def as_sent(information: Information) -> Five:
    """Return the five numbers of `information` with the precision in which frames carry them."""
    a, b, d, x, y = _SENT.unpack(_SENT.pack(*information.numbers))
    return a, b, d, x, y


@lru_cache(maxsize=256)  # a vehicle hears the same others for many periods
def _out_neighbours_by_name(heard: frozenset[str], out_neighbours: frozenset[str]) -> Mapping[str, bool]:
    """Return whether each of `heard` is one of `out_neighbours`, for as many as a frame can name."""
    return MappingProxyType({name: name in out_neighbours for name in sorted(heard)[:MAX_HEARD]})


def _trace(information: Five) -> float:
    """Return the trace of the matrix."""
    return information[0] + information[2]


def _sum(rows: Array) -> Array:
    """Return the sum (m,) of rows (n, m): numpy's takes longer where they are few."""
    return np.asarray(np.ones(len(rows)).dot(rows))


def _joined(rows: list[bytes]) -> Array:
    """Return rows of `packed_numbers` as an array (n, 15)."""
    return np.frombuffer(b"".join(rows)).reshape(len(rows), -1)


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
        self._origins = Origins(self.own.drops_outliers)
        self._frames: dict[str, InformationFrame] = {}
        self._share = Share(0, (0.0, 0.0, 0.0), frozenset(), frozenset())
        self._now_ns = -period_ns
        self._contradicted = 0
        self._prior = as_sent(self.own.prior)
        self._increment: Five = _NOTHING
        self._largest_increment = 0.0
        self._code = int(self.name, 16)
        self._passing = Passing(passed_record(self._code, self._increment))
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
            a, b, d, x, y = (value * (INCREMENT_LIMIT / largest) for value in increment)
            increment = a, b, d, x, y
        self._increment = increment
        self._prior = as_sent(self.own.prior)

    def filter(self, own: Fix) -> None:
        """Take the vehicle's own fix, if that has not been done to compose a frame."""
        self.observe(own)

    def agree(self) -> None:
        """Do a round of consensus, and fuse, with the frames of this period."""
        frames = self._current_frames()
        # What this vehicle says itself is the first row of all.
        own = plain_moments(*self._prior)
        table = _joined([packed_numbers(self._prior, self._increment, own), *[f.numbers for f in frames.values()]])
        believed = self._believed(list(frames.values()), own, table)
        if believed is not None:
            frames = {name: frames[name] for name, share in zip(frames, believed, strict=True) if share}
            table = table[[True, *map(bool, believed)]]
            table[1:, 5:10] *= np.array([share for share in believed if share])[:, None]
        heard = list(frames.values())
        priors, means_m, leaning = self._moderated(heard, own, table[:, :5], table[:, 10:12])
        self._share = self.consensus.round(means_m[0], {sender: frame.share for sender, frame in frames.items()})
        self.mean_m = self.consensus.mean_m
        if self._options.consensus == "ratio":
            self.mean_m = tracked_mean(_sum(means_m) / len(means_m), self.mean_m, self.limit_m / SPREAD_GATE)
        priors, increments = self._limited(heard, priors, table[:, 5:10])
        weights = self._weigh(frames, means_m, table[:, 12] + table[:, 14], leaning)
        passed = self._passed_on(heard, weights[1:])
        pooled = np.array(weights).dot(priors) + _sum(increments) + _sum(passed)
        self.imported = len(frames) + len(passed)
        self._passing.use([passed_record(self._code, self._increment), *[frame.record for frame in heard]])
        if self.imported:
            self.own.absorb(Information(tuple(pooled.tolist())))
        self.fused_m = self.own.estimate_m

    def _current_frames(self) -> dict[str, InformationFrame]:
        """Take the frames of this period, by sender: what one says is of one instant, fused then or never."""
        ids, neighbours, now_ns = self._admission.ids, self._neighbours, self._now_ns
        frames = {}
        for sender in sorted(self._frames):
            if sender in ids and (neighbours is None or sender in neighbours):
                frame = self._frames[sender]
                if frame.fix_time_ns == now_ns:
                    frames[sender] = frame
                else:
                    self.rejected["late"] += 1
        self._frames = {}
        return frames

    def _believed(self, frames: Sequence[InformationFrame], own: Five, table: Array) -> list[float] | None:
        """Return the share of the increment of each frame (n,) that is used, None if all are used in full.

        It is 0 for frames that are not plausible. `own` is the mean and the covariance of the vehicle's own prior,
        and `table` (1 + n, 15) has what all say.
        """
        if not self._options.defence or not frames:
            return None
        x, y, p, q, r = own
        codes, now_s = [frame.code for frame in frames], self._now_ns / NS_PER_S
        near = priors_agree([frame.moments for frame in frames], own)
        shares = self._origins.shares(codes, table[1:, 5:10], ((x, y), (p, q, r)), now_s)
        shares = unless_most_disagree(shares)
        self._notice_being_lost(near, table[1:, :5])
        believed = [share if is_near else 0.0 for is_near, share in zip(near, shares, strict=True)]
        if min(believed) == 1:
            return None
        self._reject("prior", near.count(False))
        self._reject("increment", believed.count(0.0) - near.count(False))
        return believed

    def _reject(self, reason: str, count: int) -> None:
        """Count what is not used."""
        if count:
            self.rejected[reason] += count

    def _notice_being_lost(self, near: list[bool], priors: Array) -> None:
        """Begin again at the median of what the others know, if most have contradicted this vehicle for long."""
        contradicted = len(near) >= LOST_NEIGHBOURS and 2 * near.count(False) > len(near)
        self._contradicted = self._contradicted + 1 if contradicted else 0
        if self._contradicted >= LOST_PERIODS:
            self._contradicted = 0
            self._origins = Origins(self.own.drops_outliers)
            self.own.restart(median_belief(priors))
            self._prior, self._increment = as_sent(self.own.prior), _NOTHING

    def _moderated(
        self, frames: Sequence[InformationFrame], own: Five, priors: Array, means_m: Array
    ) -> tuple[Array, Array, list[bool] | None]:
        """Return the priors (1 + n, 5) of the vehicle and of `frames`, and their means, none far from their median.

        No vehicle is dropped: where a few hear what the others cannot know, they are always off, and right. The
        last value (n,) tells which always are, None if nobody is.
        """
        if not self._options.defence or not frames:
            self.limit_m = np.inf
            return priors, means_m, None
        moments = [frame.moments for frame in frames]
        middle_m, self.limit_m = spread_limit_m([own, *moments])
        if self.limit_m == np.inf:
            middle_m = own[:2]
        codes = [frame.code for frame in frames]
        off_m, leaning = self._origins.without_lean(codes, moments, own, middle_m, self._now_ns / NS_PER_S)
        less_m = cut_to(off_m, self.limit_m)
        if less_m is off_m and leaning is None:
            return priors, means_m, None
        moved_m = np.zeros_like(means_m)
        moved_m[1:] = np.array(less_m) + middle_m - means_m[1:]
        priors = priors.copy()
        priors[:, 3] += priors[:, 0] * moved_m[:, 0] + priors[:, 1] * moved_m[:, 1]
        priors[:, 4] += priors[:, 1] * moved_m[:, 0] + priors[:, 2] * moved_m[:, 1]
        return priors, means_m + moved_m, leaning

    def _limited(self, frames: Sequence[InformationFrame], priors: Array, increments: Array) -> tuple[Array, Array]:
        """Return priors and increments (1 + n, 5) of all rows, none much more certain than one's own."""
        if not self._options.defence:
            return priors, increments
        own, largest = _trace(self._increment), PRIOR_FACTOR * _trace(self._prior)
        traces = sorted([own, *[frame.increment[0] + frame.increment[2] for frame in frames]])
        usual = INCREMENT_FACTOR * max(own, traces[len(traces) // 2])
        self._largest_increment = max(usual, self.own.largest_increment)
        if traces[-1] > self._largest_increment:
            increments = scaled_down(increments, self._largest_increment)
        if max([frame.prior[0] + frame.prior[2] for frame in frames], default=0.0) > largest:
            priors = scaled_down(priors, largest)
        return priors, increments

    def _weigh(
        self,
        frames: Mapping[str, InformationFrame],
        means_m: Array,
        variances_m2: Array,
        leaning: list[bool] | None,
    ) -> list[float]:
        """Return the weights (1 + n,) of the priors.

        They have means (1 + n, 2) and covariances with traces (1 + n,). The weight of who is always to one side,
        `leaning` (n,), goes to the vehicle itself.
        """
        self._rule.notice([frame.largest_degree for frame in frames.values()], len(self._share.heard))
        degrees = [len(frame.heard) for frame in frames.values()]
        weights: list[float] = self._rule.weights(means_m, variances_m2, self.mean_m, degrees).tolist()
        if self._options.defence:
            leaning = leaning or [False] * len(frames)
            each = zip(weights[1:], leaning, strict=True)
            others = [0.0 if leans else (1 - SELF_SHARE) * weight for weight, leans in each]
            weights = [1 - sum(others), *others]
        ids = [self._node_id, *(self._admission.ids[name] for name in frames)]
        self.weights = dict(zip(ids, weights, strict=True))
        return weights

    # What is passed on.

    def _passed_on(self, frames: Sequence[InformationFrame], weights: Sequence[float]) -> Array:
        """Return the increments (m, 5) of the last period from out of range, less what the pooled priors hold."""
        listed = [frame.passed_records for frame in frames]
        shares, forged = self._passing.shares(listed, weights, self._options.defence)
        if forged:
            self.rejected["forged"] += forged
        new = [record for record, share in shares.items() if share < 1]
        if not new:
            return np.zeros((0, 5))
        origins, increments = codes_and_increments(new)
        added = np.array([PASSED_SHARE * (1 - share) for share in shares.values() if share < 1])
        increments *= added[:, None]
        if not self._options.defence:
            return increments
        mean_m, covariance_m2 = self.own.belief
        (p, q), (_, r) = covariance_m2.tolist()
        belief = mean_m.tolist(), (p, q, r)
        used = self._origins.shares(origins, increments, belief, self._now_ns / NS_PER_S)
        if min(used) < 1:
            self._reject("passed", used.count(0.0))
            increments = (increments * np.array(used)[:, None])[np.array(used) > 0]
        return scaled_down(increments, self._largest_increment)

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
        heard = _out_neighbours_by_name(share.heard, share.out_neighbours)
        limit = min(self._options.relay_increments, room(len(heard), max_payload))
        return InformationFrame(
            name=self.name,
            fix_time_ns=fix.time_ns,
            prior=self._prior,
            increment=self._increment,
            epoch=share.epoch,
            running_sum=share.running_sum,
            heard=heard,
            passed=self._passing.to_send(limit, fix.time_ns // self._period_ns),
            largest_degree=min(self._rule.largest_degree, MAX_DEGREE),
        )
