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
from vnet.cmm.consensus import Share
from vnet.cmm.information import Information
from vnet.cmm.own_vehicle import own_vehicle
from vnet.cmm.plausibility import (
    INCREMENT_FACTOR,
    PRIOR_FACTOR,
    Origins,
    inverses,
    matrices,
    median_belief,
    priors_agree,
    scaled_down,
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
MAX_FORGED_SHARE = 0.5
"""Share of the increments that are known first-hand, beyond which a frame that passes on others is forged."""


def as_sent(information: Information) -> tuple[float, ...]:
    """Return the five numbers of `information` with the precision in which frames carry them."""
    (a, b), (_, d) = information.matrix.tolist()
    return tuple(np.array([a, b, d, *information.vector], dtype="<f4").tolist())


class InformationEstimator:
    """The state of one vehicle's cooperation by information.

    own: what the vehicle knows of itself and of the common error.
    fused_m: (2,), the estimate of the common error right after the latest fusion.
    weights: the latest fusion weights by node id, the vehicle's own included.
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
        self.weights: dict[str, float] = {}
        self.imported = 0
        self._node_id = node_id
        self._options = options
        self._period_ns = period_ns
        self._rule = FusionRule(options, rng)
        self._origins = Origins()
        self._frames: dict[str, InformationFrame] = {}
        self._share = Share(0, (0.0, 0.0, 0.0), frozenset(), frozenset())
        self._now_ns = -period_ns
        self._contradicted = 0
        self._prior = np.array(as_sent(self.own.prior))
        self._increment = np.zeros(5)
        self._largest_increment = 0.0
        self._used_records = _records([self.name], self._increment[None])
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
        names = list(frames)
        heard = np.array([[*frame.prior, *frame.increment] for frame in frames.values()]).reshape(-1, 10)
        believed = self._believed(names, heard)
        names = [name for name, good in zip(names, believed.tolist(), strict=True) if good]
        heard, frames = heard[believed], {name: frames[name] for name in names}
        self._take_round(frames)
        priors, increments = self._limited(heard)
        weights = self._weigh(names, frames, priors)
        pooled = weights @ np.vstack([self._prior, priors]) + self._increment + increments.sum(axis=0)
        passed = self._passed_on(names, frames, weights)
        pooled += passed.sum(axis=0)
        self.imported = len(names) + len(passed)
        self._used_records = _records([self.name, *names], np.vstack([self._increment, heard[:, 5:]]))
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

    def _believed(self, names: list[str], heard: Array) -> NDArray[np.bool_]:
        """Tell which frames, with prior and increment in `heard` (n, 10), are plausible."""
        if not self._options.defence or not names:
            return np.ones(len(names), dtype=np.bool_)
        own = _moments(self._prior)
        covariance = inverses(matrices(heard[:, :5]))
        mean = np.einsum("nij,nj->ni", covariance, heard[:, 3:5])
        near = priors_agree(mean, covariance, *own)
        codes = [int(name, 16) for name in names]
        agrees = self._origins.agree(codes, heard[:, 5:], own, self._now_ns / NS_PER_S)
        self._reject("prior", ~near)
        self._reject("increment", near & ~agrees)
        self._notice_being_lost(near, heard[:, :5])
        return np.asarray(near & agrees)

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
            self.own.restart(median_belief(priors))
            self._prior = np.array(as_sent(self.own.prior))
            self._increment = np.zeros(5)

    def _limited(self, heard: Array) -> tuple[Array, Array]:
        """Return priors and increments (n, 5) each of `heard` (n, 10), none much more certain than one's own."""
        priors, increments = heard[:, :5], heard[:, 5:]
        if not self._options.defence:
            return priors, increments
        traces = sorted([_trace(self._increment), *(increments[:, 0] + increments[:, 2]).tolist()])
        self._largest_increment = INCREMENT_FACTOR * max(_trace(self._increment), traces[len(traces) // 2])
        largest = PRIOR_FACTOR * _trace(self._prior)
        return scaled_down(priors, largest), scaled_down(increments, self._largest_increment)

    def _take_round(self, frames: Mapping[str, InformationFrame]) -> None:
        """Do a round of consensus with the shares in `frames`."""
        shares = {
            sender: Share(frame.epoch, frame.running_sum, frame.out_neighbours, frame.names_heard)
            for sender, frame in frames.items()
        }
        mean_m, _ = _moments(self._prior)
        self._share = self.consensus.round(mean_m, shares)

    def _weigh(self, names: list[str], frames: Mapping[str, InformationFrame], priors: Array) -> Array:
        """Return the weights (1 + n,) of the own prior and those of others (n, 5)."""
        everybody = np.vstack([self._prior, priors])
        covariance = inverses(matrices(everybody))
        mean = np.einsum("nij,nj->ni", covariance, everybody[:, 3:])
        self._rule.notice([frame.largest_degree for frame in frames.values()], len(self._share.heard))
        degrees = [len(frame.heard) for frame in frames.values()]
        weights = self._rule.weights(mean, covariance, self.consensus.mean_m, degrees)
        ids = [self._node_id, *(self._admission.ids[name] for name in names)]
        self.weights = dict(zip(ids, weights.tolist(), strict=True))
        return weights

    # What is passed on.

    def _passed_on(self, names: list[str], frames: Mapping[str, InformationFrame], weights: Array) -> Array:
        """Return the increments (m, 5) of the last period from out of range, less what the pooled priors hold."""
        passed = [self._used_records, *(frames[name].passed for name in names)]
        records = np.concatenate(passed)
        if len(records) == len(self._used_records):
            return np.zeros((0, 5))
        sender = np.repeat(np.arange(len(passed)), [len(part) for part in passed])
        origin, first, index = np.unique(records["name"], return_index=True, return_inverse=True)
        forged = self._forged(records, sender, first[index], len(passed))
        share = np.bincount(index, weights=np.where(forged, 0.0, weights)[sender], minlength=len(origin))
        new = (first >= len(self._used_records)) & (share < 1) & ~forged[sender[first]]
        codes = origin[new].tolist()
        increments = records["information"][first[new]].astype(float)
        increments *= (1 - share[new])[:, None]
        if not self._options.defence or not codes:
            return increments
        agrees = self._origins.agree(codes, increments, self.own.belief, self._now_ns / NS_PER_S)
        self._reject("passed", ~agrees)
        return scaled_down(increments[agrees], self._largest_increment)

    def _forged(
        self, records: NDArray[np.void], sender: NDArray[np.intp], first: NDArray[np.intp], count: int
    ) -> NDArray[np.bool_]:
        """Tell which of `count` senders pass on false increments: most of those that are known first-hand differ.

        `first` (m,) is the first record of each record's origin; the vehicle's own records are the first.
        """
        if not self._options.defence:
            return np.zeros(count, dtype=np.bool_)
        known = first < len(self._used_records)
        information = records["information"]
        differs = known & (information != information[first]).any(axis=1)
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
            passed=_in_turns(self._used_records, limit, fix.time_ns // self._period_ns),
            largest_degree=min(self._rule.largest_degree, MAX_DEGREE),
        )


def _records(names: list[str], increments: Array) -> NDArray[np.void]:
    """Return records (n,) of `PASSED` of the increments (n, 5) that a vehicle has used, its own first."""
    records = np.zeros(len(names), dtype=PASSED)
    records["name"] = [int(name, 16) for name in names]
    records["information"] = increments
    return records


def _in_turns(records: NDArray[np.void], limit: int, period: int) -> NDArray[np.void]:
    """Return at most `limit` records, the first and of the others in turns."""
    if limit >= len(records):
        return records
    turned = 1 + (np.arange(limit - 1) + period * limit) % (len(records) - 1)
    return np.asarray(records[np.append(0, turned)[:limit]])


def _trace(information: Array) -> float:
    """Return the trace of the matrix of information (5,)."""
    return float(information[0] + information[2])


def _moments(information: Array) -> tuple[Array, Array]:
    """Return mean (2,) and covariance (2, 2) of information (5,)."""
    return Information(matrices(information[None])[0], information[3:]).moments()
