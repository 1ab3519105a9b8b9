"""The estimator of a vehicle that exchanges information about the common error (MODEL 10).

Each vehicle filters itself alone, and tells its neighbours what it knew of the common error before its fix, and
what the fix says about it. Priors are pooled with the weights of the fusion rule, because they may rest on the same
fixes; increments are added, because they are new. Increments from out of range are passed on by one hop: a frame
lists those that its sender used in the period before, and so says what its prior holds; a receiver adds of each the
share that the pooled priors do not hold.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Set
from itertools import filterfalse
from operator import itemgetter
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.cmm.consensus import Share, tracked_mean
from agents.cooperative.cmm.information import Five, Information, plain_moments
from agents.cooperative.cmm.kalman_bound import common_step
from agents.cooperative.cmm.lane_memory import LaneExchange, all_information_of, is_of_lane, kind_of_increment
from agents.cooperative.cmm.own_vehicle import OwnVehicle, own_vehicle
from agents.cooperative.cmm.plausibility import (
    INCREMENT_FACTOR,
    PRIOR_FACTOR,
    SELF_SHARE,
    SENDER_FACTOR,
    SPREAD_GATE,
    Belief,
    Origins,
    all_of,
    cut_to,
    median_belief,
    moved,
    prior_shares,
    relative_to_most,
    scaled_by,
    scaled_down,
    spread_limit_m,
    traces_of,
)
from agents.cooperative.cmm.rbpf import Observation
from agents.cooperative.estimator import FusionRule, mean_consensus, usable
from agents.cooperative.frame import (
    MAX_DEGREE,
    MAX_HEARD,
    NAME_BYTES,
    Admission,
    VehicleCache,
    name_of_code,
    short_name,
)
from agents.cooperative.information_frame import (
    INCREMENT_LIMIT,
    PASSED,
    HeardFrames,
    InformationFrame,
    decode,
    encode,
    passed_increment,
    passed_record,
    room,
)
from agents.cooperative.options import Options
from vnet import Fix, Packet
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array
from vnet.units import NS_PER_S

LOST_PERIODS = 10
"""Consecutive periods in which most neighbours contradict the vehicle, after which the vehicle itself is wrong."""
LOST_NEIGHBOURS = 3
"""Least number of neighbours that can say so."""
PASSED_SHARE = 0.8
"""Share of an increment that is passed on which a vehicle on a map adds: what priors hold by longer ways is not in
their lists. On straight lanes the error in common covers it."""
LEARNED_S = 1.3
"""Time (s) in which c moves by the error that the increments of a period have in common: offsets in lanes were
learned with what c was (Bar-Shalom 1981). With 0 s 30 vehicles in range have an ANEES of 1.6 in place of 1.1."""
REMEMBERED_PERIODS = 8
"""Periods for which a vehicle on a map remembers increments, so that it uses none twice. If c moves in so many by
less than its deviation, it also passes on what others have passed on: else that comes too late."""
RARE_PERIOD_S = 0.25
"""Period from which on it does so: with more fixes a second averages bring the same in time, and increments of one
vehicle have the same errors of the map (Ann Arbor, 5 Hz: ANEES 1.28 without and 1.68 with it)."""
LEAST_SHARE = 3e-4
"""Share of what a vehicle on a map knows of c below which it does not pass an increment on."""
LEAST_LISTERS = 3
"""Number of frames that list an increment from which on its origin counts as one: a pair of liars invents none."""
TOLD_SHARE = 0.1
"""An increment of which less than this share is used is not told: honest ones have less than 0.5 at times."""
COUNTED_SHARE = 0.5
"""An increment of which less than this share is used is counted among what is rejected."""

_SENT = struct.Struct("<5f")
_NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0)


def as_sent(numbers: Five) -> Five:
    """Return five numbers with the precision in which frames carry them."""
    a, b, d, x, y = _SENT.unpack(_SENT.pack(*numbers))
    return a, b, d, x, y


@VehicleCache  # a vehicle hears the same others for many periods
def _out_neighbours_by_name(heard: frozenset[str], out_neighbours: frozenset[str]) -> Mapping[str, bool]:
    """Return whether each of `heard` is one of `out_neighbours`, for as many as a frame can name."""
    return MappingProxyType({name: name in out_neighbours for name in sorted(heard)[:MAX_HEARD]})


def _pooled(
    weights: Sequence[float], priors: Sequence[Five], increments: Iterable[Five], common_m2: float
) -> Information:
    """Return the sum of `priors` by their weights, and of `increments` with an error of `common_m2` in common."""
    sum_a = sum_b = sum_d = sum_x = sum_y = 0.0
    for a, b, d, x, y in increments:
        sum_a += a
        sum_b += b
        sum_d += d
        sum_x += x
        sum_y += y
    share = 1 / (1 + common_m2 * (sum_a + sum_d) / 2)
    sum_a, sum_b, sum_d, sum_x, sum_y = share * sum_a, share * sum_b, share * sum_d, share * sum_x, share * sum_y
    for weight, (a, b, d, x, y) in zip(weights, priors, strict=True):
        sum_a += weight * a
        sum_b += weight * b
        sum_d += weight * d
        sum_x += weight * x
        sum_y += weight * y
    return Information((sum_a, sum_b, sum_d, sum_x, sum_y))


class InformationEstimator:
    """The state of one vehicle's cooperation by information.

    period_s, rng: the period and the vehicle's own random numbers.
    own: what the vehicle knows of itself and of the common error.
    fused_m: (2,), the estimate of the common error right after the latest fusion.
    mean_m: (2,), the network's mean as far as it is known, None before the first.
    limit_m: distance from the median of what is heard to which the latest period's priors were moved.
    imported: number of increments that the latest period took from others.
    """

    def __init__(
        self, node_id: str, options: Options, lanes: LaneMap | RoadMap, rng: np.random.Generator, period_ns: int
    ) -> None:
        self.name = short_name(node_id)
        self.own = own_vehicle(options.own_config(), lanes, rng)
        self.period_s = period_ns / NS_PER_S
        self._lanes = LaneExchange(self.own, self.period_s) if isinstance(self.own, OwnVehicle) else None
        self._admission = Admission(self.name, period_ns, decode)
        self.consensus = mean_consensus(options, self.name, self.rejected)
        self.fused_m = self.own.estimate_m
        self.mean_m: Array | None = None
        self._weights: list[float] = []
        self._weighed: Sequence[int] = ()
        self.imported = 0
        self.limit_m = math.inf
        self._node_id = node_id
        self._options = options
        self._period_ns = period_ns
        self.rng = rng
        self._rule = FusionRule(options, rng)
        self._origins = Origins()
        self._frames: list[tuple[str, InformationFrame]] = []
        self._share = Share(0, (0.0, 0.0, 0.0), frozenset(), frozenset())
        self._now_ns = -period_ns
        self._contradicted = 0
        self._prior_shares: list[float] = []  # of the frames of this period
        self._used_shares: list[float] = []  # of their increments
        self._prior = as_sent(self.own.prior.numbers)
        self._increment: Five = _NOTHING
        self._largest_increment = 0.0
        self._code = int(self.name, 16)
        self._is_rare = self._lanes is None and self.period_s >= RARE_PERIOD_S
        periods = REMEMBERED_PERIODS if self._is_rare else 1
        self._passing = Passing(passed_record(self._code, self._increment), periods)
        config = options.filter_config()
        moves_as = config.common_sigma_m, config.common_tau_s, config.common_walk_m
        self._period_step = common_step(*moves_as, self.period_s)
        self._moves_m2 = REMEMBERED_PERIODS * self._period_step[1]
        self._common_m2 = common_step(*moves_as, LEARNED_S)[1] if self._lanes else 0.0
        self._neighbours = frozenset(map(short_name, options.hears.get(node_id, []))) if options.hears else None

    @property
    def rejected(self) -> Counter[str]:
        """Number of frames and increments of others that were not used, or for less than half, by reason."""
        return self._admission.rejected

    @property
    def common_error(self) -> tuple[Array, Array]:
        """Estimate (2,) of the common error, and its covariance (2, 2)."""
        return self.own.estimate_m, self.own.estimate_covariance_m2

    @property
    def weights(self) -> dict[str, float]:
        """The latest fusion weights by node id, the vehicle's own included."""
        if not self._weights:
            return {}
        names, ids = map(name_of_code, self._weighed), self._admission.ids
        return dict(zip([self._node_id, *[ids.get(name, name) for name in names]], self._weights, strict=True))

    def sample(self, count: int) -> Array:
        """Draw `count` hypotheses (count, 2) of the common error."""
        return self.own.sample(count)

    def read(self, packets: Iterable[Packet], now_ns: int) -> None:
        """Take in packets from the radio; those that cannot be used are counted by reason."""
        self._frames += self._admission.admit(packets, now_ns)

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
        since_ns, self._now_ns = own.time_ns - self._now_ns, own.time_ns
        if since_ns > self._period_ns:
            nothing = [passed_record(self._code, _NOTHING)]
            self._passing.use(nothing, nothing)  # in the period before
        multipath = own.multipath_sigma_m, own.multipath_tau_s
        seen = Observation(
            own.position_m, own.covariance_m2, own.heading_rad, multipath=multipath, speed_m_s=own.speed_m_s
        )
        fix = seen if usable(own) else None
        dt_s = since_ns / NS_PER_S
        said = self._lanes.step(dt_s, fix) if self._lanes else self.own.step(dt_s, fix).numbers
        increment = as_sent(said)
        largest = max(map(abs, increment))
        if largest > INCREMENT_LIMIT:
            a, b, d, x, y = (value * (INCREMENT_LIMIT / largest) for value in increment)
            increment = a, b, d, x, y
        self._increment = increment
        self._prior = as_sent(self.own.prior.numbers)

    def filter(self, own: Fix) -> None:
        """Take the vehicle's own fix, if that has not been done to compose a frame."""
        self.observe(own)

    def agree(self) -> None:
        """Do a round of consensus, and fuse, with the frames of this period, and late ones of the one before."""
        own = plain_moments(*self._prior)
        frames, late_frames = self._current_frames()
        heard, late = HeardFrames.of(frames.values()), HeardFrames.of(late_frames.values())
        if self._lanes:
            self._lanes.join(heard.increments, late.increments)
        missing = [late_frames[name] for name in late_frames if name not in frames]
        pool = heard.and_earlier(missing, *self._period_step)
        self._compare(heard, pool, own)
        if self._begins_again(pool):
            own, frames, late_frames = plain_moments(*self._prior), {}, {}  # the new belief is what they know
            heard = late = pool = HeardFrames()
        # Of all that follows what this vehicle says itself is the first.
        priors, means_m, leaning = self._moderated(pool, own)
        shares = dict(zip([*late_frames, *frames], [*late.shares, *heard.shares], strict=True))
        self._share = self.consensus.round(np.array(means_m[0]), shares)
        self.mean_m = self.consensus.mean_m
        if self._options.consensus == "ratio":
            count = len(means_m)
            middle_m = math.fsum([x for x, _ in means_m]) / count, math.fsum([y for _, y in means_m]) / count
            limit_m = self.limit_m / SPREAD_GATE
            if self._options.defence and limit_m == math.inf:  # few are heard: false sums would choose among them
                limit_m = math.sqrt(own[2] + own[4])
            self.mean_m = tracked_mean(middle_m, self.mean_m, limit_m)
        limited, increments = self._limited(heard, priors)
        self._weighed = pool.codes
        weights = self._weights = self._weigh(pool, means_m, own[2] + own[4], leaning, len(frames))
        passed, onward = self._passed_on(heard, late.records, weights[1 : 1 + len(frames)])
        self.imported = len(frames) + sum(weight > 0 for weight in weights[1 + len(frames) :]) + len(passed)
        self._pass_on(heard, onward, own[2] + own[4])
        self._absorb(weights, limited, increments, passed)
        self.fused_m = self.own.estimate_m

    def _absorb(
        self, weights: Sequence[float], priors: Sequence[Five], now: Sequence[Five], before: Sequence[Five]
    ) -> None:
        """Replace what is known of c by pooled `priors`, and increments of this period and the one before."""
        about_c = [increment for increment in (*now, *before) if increment[2] >= 0]
        if not (self._lanes and self._lanes.has_joined):
            if self.imported:
                self.own.absorb(_pooled(weights, priors, about_c, self._common_m2))
            return
        if not self.imported and not is_of_lane(self._increment):
            self._lanes.follow_own()
            return
        pooled = _pooled(weights, priors, about_c, self._common_m2)
        heard, others = len(now) - 1, (1 - weights[0]) / (1 - SELF_SHARE)
        now, before = [each for each in now if is_of_lane(each)], [each for each in before if is_of_lane(each)]
        self._lanes.absorb(pooled, now, before, heard, others)

    def _shares_used(
        self,
        codes: Sequence[int],
        increments: Sequence[Five],
        belief: Belief,
        is_before: bool,
        unvouched: Set[int] = frozenset(),
    ) -> list[float]:
        """Return the share (n,) of each increment (n,) of `codes` that is used; `belief` is the one about c."""
        now_s, said = self._now_ns / NS_PER_S, all_information_of(increments)
        if not (self._lanes and self._lanes.has_joined):
            return self._origins.shares(codes, said, belief, now_s, unvouched=unvouched)
        used = [0.0 if any(each) else 1.0 for each in said]
        by_kind: dict[int, list[int]] = {}
        for row, increment in enumerate(increments):
            if self._lanes.can_use(increment, is_before):
                by_kind.setdefault(kind_of_increment(increment), []).append(row)
        for kind, rows in by_kind.items():
            about = self._lanes.news(kind, is_before) if kind else belief
            shares = self._origins.shares(
                [codes[row] for row in rows], [said[row] for row in rows], about, now_s, True
            )
            for row, share in zip(rows, shares, strict=True):
                used[row] = share
        return used

    def _current_frames(self) -> tuple[dict[str, InformationFrame], dict[str, InformationFrame]]:
        """Take the frames of this period, and those that have missed the period before, by sender."""
        ids, neighbours, now_ns = self._admission.ids, self._neighbours, self._now_ns
        frames, late = {}, {}
        for sender, frame in sorted(self._frames, key=itemgetter(0)):
            if sender in ids and (neighbours is None or sender in neighbours):
                if frame.fix_time_ns == now_ns:
                    frames[sender] = frame
                elif frame.fix_time_ns == now_ns - self._period_ns:
                    late[sender] = frame
                else:
                    self.rejected["late"] += 1
        self._frames = []
        return frames, late

    def _compare(self, heard: HeardFrames, pool: HeardFrames, own: Five) -> None:
        """Find the shares (n,) of the priors of `pool` and of the increments `heard` that are used.

        `own` is the mean and the covariance of the vehicle's own prior. Who has been heard lately and is not now
        contradicts nobody: in some periods a few are most of those that are heard.
        """
        self._prior_shares, self._used_shares = [1.0] * len(pool.codes), [1.0] * len(heard.codes)
        if not self._options.defence or not pool.codes:
            return
        x, y, *covariance_m2 = own
        self._prior_shares = prior_shares(pool.moments, own)
        belief = (x, y), (covariance_m2[0], covariance_m2[1], covariance_m2[2])
        used = self._shares_used(heard.codes, heard.increments, belief, False)
        self._used_shares = relative_to_most(used, self._silent(heard))
        if min([*self._prior_shares, *self._used_shares]) < 1:
            self._reject("prior", sum(share < COUNTED_SHARE for share in self._prior_shares))
            self._reject("increment", sum(share < COUNTED_SHARE for share in self._used_shares))

    def _reject(self, reason: str, count: int) -> None:
        """Count what is not used."""
        if count:
            self.rejected[reason] += count

    def _silent(self, heard: HeardFrames) -> int:
        """Return the number of vehicles that have been heard lately, and are not in this period."""
        return max(0, len(self._share.heard) - len(heard.codes))

    def _begins_again(self, pool: HeardFrames) -> bool:
        """Begin again at the median of what the others know, if most have contradicted this vehicle for long.

        Returns whether it did. A period in which nothing is heard says neither.
        """
        shares = self._prior_shares
        if not shares or not self._options.defence:
            return False
        far = len(shares) - shares.count(1.0)
        contradicted = len(shares) >= LOST_NEIGHBOURS and 2 * far > max(len(shares), len(self._share.heard))
        self._contradicted = self._contradicted + 1 if contradicted else 0
        if self._contradicted < LOST_PERIODS:
            return False
        self._contradicted = 0
        self._origins = Origins()
        self.restart(median_belief(pool.priors))
        self._prior, self._increment = as_sent(self.own.prior.numbers), _NOTHING
        self._prior_shares = self._used_shares = []
        return True

    def restart(self, belief: Information) -> None:
        """Begin again with this belief about c."""
        self.own.restart(belief)
        if self._lanes and self._lanes.has_joined:
            self._lanes.restart()

    def _moderated(
        self, pool: HeardFrames, own: Five
    ) -> tuple[list[Five], list[tuple[float, float]], list[bool] | None]:
        """Return the priors (1 + n,) of the vehicle and those heard, and their means, none far from their median.

        No vehicle is dropped: where a few hear what the others cannot know, they are always off, and right. The
        last value (n,) tells which always are, None if nobody is.
        """
        priors, means_m = [self._prior, *pool.priors], [own[:2], *pool.means_m]
        if not self._options.defence or not pool.codes:
            self.limit_m = math.inf
            return priors, means_m, None
        middle_m, self.limit_m = spread_limit_m([own, *pool.moments])
        if self.limit_m == math.inf:
            middle_m = own[:2]
        now_s = self._now_ns / NS_PER_S
        off_m, leaning = self._origins.without_lean(pool.codes, pool.moments, own, middle_m, now_s)
        less_m = cut_to(off_m, self.limit_m)
        if less_m is off_m and leaning is None:
            return priors, means_m, None
        middle_x, middle_y = middle_m
        for row, (off_x, off_y) in enumerate(less_m, 1):
            mean_x, mean_y = means_m[row]
            means_m[row] = middle_x + off_x, middle_y + off_y
            priors[row] = moved(priors[row], means_m[row][0] - mean_x, means_m[row][1] - mean_y)
        return priors, means_m, leaning

    def _limited(self, heard: HeardFrames, priors: list[Five]) -> tuple[Sequence[Five], Sequence[Five]]:
        """Return priors and increments (1 + n,) of all, none much more certain than one's own."""
        increments = [self._increment, *heard.increments]
        if not self._options.defence:
            return priors, increments
        own, largest = traces_of([self._increment, self._prior])
        traces = sorted([*traces_of(increments), *[own] * self._silent(heard)])
        usual = INCREMENT_FACTOR * max(own, traces[len(traces) // 2])
        self._largest_increment = max(usual, self.own.largest_increment)
        if traces[-1] > self._largest_increment:
            increments = scaled_down(increments, self._largest_increment)
        # Shares are of what is left: who claims more is not to weigh as the honest do.
        if heard.codes and min(self._used_shares) < 1:
            each = zip(increments[1:], self._used_shares, strict=True)
            increments[1:] = [scaled_by(increment, share) for increment, share in each]
        return scaled_down(priors, PRIOR_FACTOR * largest), increments

    def _weigh(
        self,
        pool: HeardFrames,
        means_m: Sequence[tuple[float, float]],
        own_variance_m2: float,
        leaning: list[bool] | None,
        punctual: int,
    ) -> list[float]:
        """Return the weights (1 + n,) of the priors.

        They have means (1 + n,), and the own a covariance with this trace. The weight of who is always to one side,
        `leaning` (n,), goes to the vehicle itself, and of who is far off in part; also that of priors of the period
        before, beyond the first `punctual`, that are no more certain than the own: they lack what was used since.
        The others of those weigh by their share, so that one that claims more does not speak for all.
        """
        self._rule.notice(pool.largest_degrees, len(self._share.heard))
        weights = self._rule.weights(means_m, [own_variance_m2, *pool.variances_m2], self.mean_m, pool.degrees)
        others = weights[1:]
        if self._options.defence:
            each = zip(others, self._prior_shares, leaning or [False] * len(others), strict=True)
            others = [0.0 if leans else (1 - SELF_SHARE) * share * weight for weight, share, leans in each]
        knows_more = [variance_m2 < own_variance_m2 for variance_m2 in pool.variances_m2[punctual:]]
        share = sum(knows_more) / max(len(knows_more), 1)
        others[punctual:] = [
            share * weight if knows else 0.0 for weight, knows in zip(others[punctual:], knows_more, strict=True)
        ]
        return [1 - math.fsum(others), *others]

    # What is passed on.

    def _pass_on(self, heard: HeardFrames, onward: list[bytes], variance_m2: float) -> None:
        """Take what the next frame passes on: the increments heard and used, and `onward`, which others passed on.

        `variance_m2` is the trace of the vehicle's own covariance of c.
        """
        own = passed_record(self._code, self._increment)
        least, further = 0.0, list[bytes]()
        if self._is_rare:
            least = LEAST_SHARE * (self._prior[0] + self._prior[2])
            if variance_m2 > 2 * self._moves_m2:
                traces = traces_of([passed_increment.cached(record)[1] for record in onward])
                further = [record for record, trace in zip(onward, traces, strict=True) if trace >= least]
        each = zip(heard.records, traces_of(heard.increments), self._used_shares, strict=True)
        told = [record for record, trace, share in each if share >= TOLD_SHARE and trace >= least]
        self._passing.use([own, *heard.records], [own, *told], further)

    def _passed_on(
        self, heard: HeardFrames, late: Records, weights: Sequence[float]
    ) -> tuple[list[Five], list[bytes]]:
        """Return the increments of the period before that are new, less what the pooled priors hold.

        They are those that frames of these `weights` list, and those of `late` frames. The second value are the
        records of those that are used: what can go further.
        """
        # A late increment counts as one that a frame without a prior lists; the first of an origin is used.
        first_hand = len(late)
        listed, weights = [*[(record,) for record in late], *heard.passed], [*[0.0] * first_hand, *weights]
        listers, forged = self._passing.new(listed, self._options.defence)
        self._reject("forged", forged)
        records: list[bytes] = []
        origins: list[int] = []
        increments: list[Five] = []
        by_few: dict[int, list[int]] = {}
        has_joined = self._lanes is not None and self._lanes.has_joined
        for record, rows in listers.items():
            code, increment = passed_increment.cached(record)
            share = 0.0
            for row in rows:
                share += weights[row]
            if share >= 1:
                continue
            a, b, d, x, y = increment
            if is_of_lane(increment) != has_joined:
                continue  # those about c are too old for precise receivers, those of lanes nothing to others
            if has_joined:
                increment = scaled_by(increment, 1 - share)
            else:
                left = (PASSED_SHARE if self._lanes is None else 1.0) * (1 - share)
                increment = left * a, left * b, left * d, left * x, left * y
            if len(rows) < LEAST_LISTERS and rows[0] >= first_hand:
                by_few[len(records)] = rows
            records.append(record)
            origins.append(code)
            increments.append(increment)
        if not origins or not self._options.defence:
            return increments, records
        codes = self._judged_as(origins, increments, by_few, [0] * first_hand + [*heard.codes])
        x, y, p, q, r = self.own.plain_moments
        used = self._shares_used(codes, increments, ((x, y), (p, q, r)), True, {origins[n] for n in by_few})
        increments = scaled_down(increments, self._largest_increment)
        if min(used) < 1:
            self._reject("passed", sum(share < COUNTED_SHARE for share in used))
            increments = [scaled_by(increment, share) for increment, share in zip(increments, used, strict=True)]
            records = [record for record, share in zip(records, used, strict=True) if share >= COUNTED_SHARE]
        return increments, records

    def _judged_as(
        self,
        origins: Sequence[int],
        increments: list[Five],
        by_few: Mapping[int, Sequence[int]],
        senders: Sequence[int],
    ) -> list[int]:
        """Return the codes (n,) of `Origins` by which increments (n,) of the period before are judged.

        Origins can be invented in any number. So what few list (`by_few`: the rows of their `senders`, by number of
        the increment) is cut to `SENDER_FACTOR` times the largest increment a sender, and all of it whose origin is
        unknown is judged as one; of two senders by the one that lists less.
        """
        traces: dict[int, float] = {}
        for trace, rows in zip(traces_of([increments[n] for n in by_few]), by_few.values(), strict=True):
            for row in rows:
                traces[row] = traces.get(row, 0.0) + trace
        limit, known, codes = SENDER_FACTOR * self._largest_increment, self._origins.known, [*origins]
        for n, rows in by_few.items():
            row = min(rows, key=traces.__getitem__) if len(rows) > 1 else rows[0]
            if traces[row] > limit:
                increments[n] = scaled_by(increments[n], limit / traces[row])
            if origins[n] not in known:
                codes[n] = all_of(senders[row])
        return codes

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


MAX_FORGED_SHARE = 0.5
"""Share of the increments that are known first-hand, beyond which a frame that passes on others is forged."""

Records = Sequence[bytes]
"""Different records, as a frame lists them."""


class Passing:
    """The increments that a vehicle has used, as records of `PASSED`, and which of them it passes on.

    A vehicle remembers them for `periods` at least, and twice as many at most.
    """

    def __init__(self, own: bytes, periods: int = 1) -> None:
        self._heard = self._told = [own]
        self._onward: Sequence[bytes] = ()
        self._listed: Sequence[bytes] = ()
        # Those of the latest period, most of what is heard of; of some periods; and of as many before.
        self._known: tuple[set[bytes], ...] = {own}, set(), set()
        self._periods, self._since = periods, 1

    def use(self, heard: list[bytes], told: list[bytes], onward: Sequence[bytes] = ()) -> None:
        """Take the increments of a period: those heard, and the ones that are `told`, the vehicle's own first.

        `onward` are those that others have passed on and that go further.
        """
        self._heard, self._told, self._onward = heard, told, onward
        latest = {*heard, *self._listed}
        _, recent, before = self._known
        if self._periods > 1:
            if self._since == self._periods:
                recent, before, self._since = set(), recent, 0
            self._since += 1
            recent |= latest
        self._known = latest, recent, before

    def to_send(self, limit: int, period: int) -> NDArray[np.void]:
        """Return at most `limit` records: the vehicle's own, then those heard, then others, each in turns."""
        own, *others = self._told
        sent = [own][:limit]
        for group in others, self._onward:
            sent += _in_turns(group, limit - len(sent), period * limit)
        return np.frombuffer(b"".join(sent), dtype=PASSED)

    def new(self, listed: Sequence[Records], defence: bool) -> tuple[dict[bytes, list[int]], int]:
        """Return the records of `listed` that are not used yet, each with the rows of the frames that list it.

        With `defence` what forged frames list is not counted; the second value is their number.
        """
        latest, *earlier = self._known
        unknown: list[Records] = [list(filterfalse(latest.__contains__, records)) for records in listed]
        listers = _listers(unknown)
        if self._periods > 1:
            for old in [record for record in listers if any(record in known for known in earlier)]:
                del listers[old]
            self._listed = list(listers)
        heard, new = {record[:NAME_BYTES] for record in self._heard}, {record[:NAME_BYTES] for record in listers}
        # Of who is not heard a vehicle that remembers gets increments of several periods.
        if heard.isdisjoint(new) and (self._periods > 1 or len(new) == len(listers)):
            return listers, 0
        unknown = [[record for record in records if record in listers] for records in unknown]
        forged = _forged(heard, listed, unknown) if defence else set()
        kept, unknown = _one_an_origin(self._heard, unknown, forged)
        return {record: rows for record, rows in _listers(unknown).items() if record in kept}, len(forged)


def _in_turns(records: Sequence[bytes], count: int, first: int) -> Sequence[bytes]:
    """Return all records, or `count` of them from number `first` on, round and round."""
    if len(records) <= count:
        return records
    return [records[(first + turn) % len(records)] for turn in range(count)]


def _listers(listed: Sequence[Records]) -> dict[bytes, list[int]]:
    """Return the rows of the frames that list each record."""
    listers: dict[bytes, list[int]] = {}
    for row, records in enumerate(listed):
        for record in records:
            if record in listers:
                listers[record].append(row)
            else:
                listers[record] = [row]
    return listers


def _forged(heard: Set[bytes], listed: Sequence[Records], unknown: Sequence[Records]) -> set[int]:
    """Return the indices of the frames that forge: most that they list of origins that are `heard` is `unknown`."""
    forged = set()
    for index, (all_records, records) in enumerate(zip(listed, unknown, strict=True)):
        known, false = (sum(r[:NAME_BYTES] in heard for r in some) for some in (all_records, records))
        if false > MAX_FORGED_SHARE * known:
            forged.add(index)
    return forged


def _one_an_origin(
    used: Sequence[bytes], listed: Sequence[Records], forged: set[int]
) -> tuple[set[bytes], list[Records]]:
    """Return the records that are new, the first of each origin, and what each frame lists in terms of these.

    An origin that a forged frame lists first is not used, and a forged frame lists nothing.
    """
    first: dict[bytes, bytes] = {record[:NAME_BYTES]: record for record in used}
    new: set[bytes] = set()
    for index, records in enumerate(listed):
        for record in records:
            if record[:NAME_BYTES] not in first:
                first[record[:NAME_BYTES]] = record
                new.update([record] if index not in forged else [])
    of_origins: list[Records] = [
        [] if index in forged else list(dict.fromkeys(first[record[:NAME_BYTES]] for record in records))
        for index, records in enumerate(listed)
    ]
    return new, of_origins
