"""Decentralized cooperative map matching: what a vehicle does each period, and what it sends.

At each fix: wait for one's slot and broadcast once, with what one knows by then, so that a fix may be passed on
several times within the period; listen until the period is nearly over; then filter all fixes that have come, do
one round of mean consensus, come together with the neighbours, and report. The mathematics is `vnet.cmm`'s.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from agents.cooperative.admission import Admission
from agents.cooperative.fix_table import FixTable
from agents.cooperative.frame import (
    NAME_BYTES,
    POSITION_LIMIT_M,
    RELAY_LIMIT,
    RELAYED,
    CooperativeFrame,
    centimetres,
    encode,
    name_of_code,
    room,
    short_name,
)
from agents.cooperative.options import Options
from vnet import Fix, Node, Packet
from vnet.cmm.consensus import (
    AveragingConsensus,
    Consensus,
    ConsensusConfig,
    DirectMean,
    RatioConsensus,
    Share,
)
from vnet.cmm.fusion import Cloud, fuse, shift
from vnet.cmm.rbpf import Observation, Rbpf
from vnet.cmm.robust import near_the_median
from vnet.cmm.weights import (
    OptimizedWeights,
    constant_weights,
    max_degree_weights,
    metropolis_weights,
    no_fusion_weights,
    random_weights,
)
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array
from vnet.units import NS_PER_S

SUMS_GATE_SIGMAS = 5.0
"""Sums of the consensus that are further from one's own estimate, in deviations of the common error, are false."""
CLOUD_REPORT_PARTICLES = 50
CLOCK_FIXES = 10
"""So many fixes a clock is judged by: after it has jumped ahead it is wrong for so long."""
SENDING_SHARE, LISTENING_SHARE, TURNS_SHARE, REPORTING_SHARE = 0.7, 0.7, 0.9, 0.97
"""Shares of the period: within the first every vehicle sends; from the second, or `GRACE_SHARE` after the last
slot, until the third they compute in turn. Many on one processor must be done by the next fix, and not keep each
other from hearing until then."""
GRACE_SHARE = 0.15
TURNS = 4


class Estimator:
    """The state of one vehicle's cooperation, without any input or output of its own."""

    def __init__(
        self, node_id: str, options: Options, lanes: LaneMap | RoadMap, rng: np.random.Generator, period_ns: int
    ) -> None:
        self.name = short_name(node_id)
        self._admission = Admission(self.name, period_ns, options.two_frames)
        self.rbpf = Rbpf(options.filter_config(), lanes, rng)
        self.consensus = _consensus(options, self.name, self.rejected)
        self.stacked_m = self.rbpf.estimate_m
        self.weights: dict[str, float] = {}
        """The latest fusion weights by node id, its own included."""
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
        self._optimized = OptimizedWeights(options.self_floor, options.ridge_m2 or None)
        self._share = Share(0, (0.0, 0.0, 0.0), frozenset(), frozenset())
        self._largest_degree = 0
        self._said = self._estimate()
        self._neighbours = frozenset(map(short_name, options.hears.get(node_id, []))) if options.hears else None

    @property
    def rejected(self) -> Counter[str]:
        """What was not used of what others said, by reason."""
        return self._admission.rejected

    def read(self, packets: Iterable[Packet], now_ns: int) -> None:
        """Take in what the radio brought; what is not usable is counted by reason."""
        admitted = dict(self._admission.admit(packets, now_ns))
        heard = [(int(sender, 16), frame) for sender, frame in admitted.items() if self._is_neighbour(sender)]
        forged = self._fixes.learn(heard)
        for code in forged:
            self.rejected["forged"] += 1
            del admitted[name_of_code(code)]
        self._frames |= admitted

    def _is_neighbour(self, sender: str) -> bool:
        return self._neighbours is None or sender in self._neighbours

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
        """The vehicle's position (2,) and its covariance (2, 2); NaN as long as there is no fix to tell it from."""
        if self.name in self.rbpf.vehicles:
            return self.rbpf.position_m(self.name)
        # The filter has forgotten a vehicle whose own fixes have been outliers for seconds.
        return own.position_m - self.rbpf.estimate_m, own.covariance_m2 + self.rbpf.estimate_covariance_m2

    def agree(self) -> None:
        """A round of consensus, and of coming together, with those whose frames have come since the last."""
        # After standing still there are frames of before that: of senders that have been forgotten since.
        fresh = {sender: frame for sender, frame in sorted(self._frames.items()) if sender in self._admission.ids}
        everybody, self._frames = self._plausible(fresh), {}
        frames = {sender: frame for sender, frame in everybody.items() if self._is_neighbour(sender)}
        shares = everybody if self._options.consensus == "exact" else frames
        self._share = self.consensus.round(self.rbpf.estimate_m, {s: _share(f) for s, f in shares.items()})
        degrees = [frame.largest_degree for frame in frames.values()]
        self._largest_degree = max([self._largest_degree, len(self._share.heard), *degrees])
        self.imported = 0
        half_period_s = self._period_ns / 2 / NS_PER_S
        if frames and self._since_fusion_s >= self._options.fusion_interval_s - half_period_s:
            self._since_fusion_s = 0.0
            self.stacked_m = self._come_together(frames)
        else:
            self.stacked_m = self.rbpf.estimate_m
        if self._options.separate_map_update:
            self.rbpf.update_from_map()

    def _plausible(self, frames: dict[str, CooperativeFrame]) -> dict[str, CooperativeFrame]:
        """Without those whose estimate is not where most are; who they are is decided anew each period."""
        if not frames or not self._options.defence:
            return frames
        inside = near_the_median(*self._said_by_all(frames), self._options.common_sigma_m)[1:].tolist()
        if all(inside):
            return frames
        self.rejected["outlier"] += inside.count(False)
        return {sender: frame for (sender, frame), good in zip(frames.items(), inside, strict=True) if good}

    def _said_by_all(self, frames: Mapping[str, CooperativeFrame]) -> tuple[Array, Array]:
        """Estimates (1 + n, 2) and covariances (1 + n, 2, 2) as they were said, the vehicle's own first."""
        estimates = np.array([self._said[0], *(frame.estimate_m for frame in frames.values())])
        return estimates, np.array([self._said[1], *(frame.covariance_m2 for frame in frames.values())])

    def _come_together(self, frames: Mapping[str, CooperativeFrame]) -> Array:
        """Fuse with the neighbours; returns the estimate (2,) right afterwards.

        What they say is a period old, and is held against what this vehicle said then.
        """
        weights = self._weigh(frames)
        self.weights = dict(
            zip([self._node_id, *(self._admission.ids[s] for s in frames)], weights.tolist(), strict=True)
        )
        if self._options.exchange == "particles":
            known = [
                frame.names_heard | {sender} | {name_of_code(code) for code in frame.relayed["name"].tolist()}
                for sender, frame in frames.items()
            ]
            clouds = [Cloud(f.cloud_m, names) for f, names in zip(frames.values(), known, strict=True)]
            stacked, self.imported = fuse(self.rbpf, clouds, weights, self._rng)
            return stacked
        offset = np.array([frame.estimate_m for frame in frames.values()]) - self._said[0]
        shift(self.rbpf, weights[1:] @ offset)
        return self.rbpf.estimate_m

    def _weigh(self, frames: Mapping[str, CooperativeFrame]) -> Array:
        """Fusion weights (1 + n,) of this vehicle and its neighbours, by the rule of the options."""
        count = 1 + len(frames)
        match self._options.fusion:
            case "none":
                return no_fusion_weights(count)
            case "random":
                return random_weights(count, self._rng)
            case "constant":
                return constant_weights(count, self._options.alpha)
            case "metropolis":
                return metropolis_weights(len(frames), [len(frame.heard) for frame in frames.values()])
            case "max-degree":
                return max_degree_weights(count, max(self._largest_degree, len(frames)))
            case _:
                return self._optimize(frames)

    def _optimize(self, frames: Mapping[str, CooperativeFrame]) -> Array:
        estimates, covariances = self._said_by_all(frames)
        mean = self.consensus.mean_m
        return self._optimized.solve(estimates, covariances, estimates.mean(axis=0) if mean is None else mean)

    def _estimate(self) -> tuple[Array, Array]:
        # A collapsed cloud is still a cloud: its covariance must stay positive definite.
        return self.rbpf.estimate_m, self.rbpf.estimate_covariance_m2 + 1e-6 * np.eye(2)

    def frame(self, fix: Fix, max_payload: int) -> bytes:
        """What to broadcast together with the newest fix."""
        frame = self.compose(fix, max_payload)
        self._admission.claim(self.name, fix.time_ns, np.array(centimetres(frame.fix_m)) / 100)
        return encode(frame)

    def compose(self, fix: Fix, max_payload: int) -> CooperativeFrame:
        """The frame with the newest fix, as long as `max_payload` bytes allow."""
        share = self._share
        self._said = self._estimate()
        heard = {name: name in share.out_neighbours for name in sorted(share.heard)[:255]}
        left = room(len(heard), max_payload)
        mixes = self._options.exchange == "particles" and self._options.fusion != "none"
        count = min(self._options.particles, left // 4) if mixes else 0
        most = min(RELAY_LIMIT, (left - 4 * count) // RELAYED.itemsize) if self._options.relay else 0
        return CooperativeFrame(
            fix.time_ns,
            fix.position_m,
            fix.heading_rad,
            *self._said,
            share.epoch,
            share.running_sum,
            heard,
            self.rbpf.sample(count),
            self._fixes.freshest(fix.time_ns, most),
            min(self._largest_degree, 255),
            self.name,
        )


def _consensus(options: Options, name: str, rejected: Counter[str]) -> Consensus:
    gate_m = SUMS_GATE_SIGMAS * max(1.0, options.common_sigma_m) if options.defence else np.inf
    config = ConsensusConfig(gate_m=gate_m)
    match options.consensus:
        case "ratio":
            return RatioConsensus(name, config, rejected)
        case "exact":
            return DirectMean(current=options.two_frames)
        case rule:
            return AveragingConsensus(name, rule, config, rejected)


def usable(fix: Fix) -> bool:
    """Whether a fix can be filtered, and said in a frame: receivers fail, too."""
    numbers = [*fix.position_m, *fix.covariance_m2.ravel(), fix.heading_rad or 0.0]
    return bool(np.isfinite(numbers).all() and np.abs(fix.position_m).max() <= POSITION_LIMIT_M)


def _share(frame: CooperativeFrame) -> Share:
    return Share(frame.epoch, frame.running_sum, frame.out_neighbours, frame.names_heard)


async def main(node: Node) -> None:
    """Cooperate until the run ends."""
    options = Options.parse(node.options)
    await cooperate(node, options, Estimator(node.id, options, node.map, node.rng, node.period_ns))


async def cooperate(node: Node, options: Options, estimator: Estimator) -> None:
    """The vehicle's loop around its `estimator`, until the run ends."""
    periods_a_second = max(1, NS_PER_S // node.period_ns)
    slot = int(node.rng.integers(options.slots))
    slot_ns = slot * round(SENDING_SHARE * node.period_ns) // options.slots
    listening_ns = round(listening_share(estimator.name, options) * node.period_ns)
    clock = _GnssClock(node)
    async for fix in node.gnss:
        # After standing still a vehicle goes on from the newest fix: nobody wants what it saw meanwhile.
        fix = (node.gnss.drain() or [fix])[-1]
        clock.set_by(fix)
        await clock.sleep_until(fix.time_ns + slot_ns)
        estimator.read(node.radio.drain(), clock.now_ns)
        payload = b""
        if usable(fix):
            payload = estimator.frame(fix, node.radio.max_payload)
            await node.radio.broadcast(payload)
        await clock.sleep_until(fix.time_ns + listening_ns)
        packets = node.radio.drain()
        estimator.read(packets, clock.now_ns)
        estimator.filter(fix)
        if options.two_frames and usable(fix):
            await node.radio.broadcast(estimator.frame(fix, node.radio.max_payload))
            await clock.sleep_until(fix.time_ns + round(REPORTING_SHARE * node.period_ns))
            estimator.read(node.radio.drain(), clock.now_ns)
        estimator.agree()
        in_full = (fix.time_ns // node.period_ns) % periods_a_second == 0
        _report(node, estimator, fix, len(packets), len(payload), in_full)


def listening_share(name: str, options: Options) -> float:
    """When in the period a vehicle stops listening and computes; at once with all if it is then to send again."""
    last_slot_share = SENDING_SHARE * (options.slots - 1) / options.slots
    first_share = max(LISTENING_SHARE, last_slot_share + GRACE_SHARE)
    # A few turns and no more: in lockstep those of one turn compute side by side, one turn after the other.
    turn = 0.0 if options.two_frames else int(name, 16) * TURNS // 256**NAME_BYTES / TURNS
    return first_share + turn * (TURNS_SHARE - first_share)


class _GnssClock:
    """GNSS time, kept by the vehicle's own clock, which may be wrong.

    A fix is met at its time or later: the least that the clock was ahead of the last fixes is its error.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._ahead_ns: deque[int] = deque(maxlen=CLOCK_FIXES)

    def set_by(self, fix: Fix) -> None:
        """Take note of a fix that has just come."""
        self._ahead_ns.append(self._node.now_ns - fix.time_ns)

    @property
    def now_ns(self) -> int:
        """GNSS time in nanoseconds."""
        return self._node.now_ns - min(self._ahead_ns)

    async def sleep_until(self, time_ns: int) -> None:
        """Sleep until this GNSS time."""
        if time_ns > self.now_ns:
            await asyncio.sleep((time_ns - self.now_ns) / NS_PER_S)


def _report(node: Node, estimator: Estimator, fix: Fix, heard: int, size: int, in_full: bool) -> None:
    """Report the position, and what the metrics know of the common error.

    Once a second also the cloud, the weights, and what has been rejected so far by reason.
    """
    rbpf = estimator.rbpf
    position_m, covariance_m2 = estimator.position(fix)
    values: dict[str, Any] = {
        "common_error_m": rbpf.estimate_m,
        "common_error_covariance_m2": rbpf.estimate_covariance_m2,
        "stacked_common_error_m": estimator.stacked_m,
        "heard": heard,
        "imported": estimator.imported,
        "bytes": size,
        "rejected": estimator.rejected.total(),
    }
    mean_m = estimator.consensus.mean_m
    if mean_m is not None:
        values["mean_m"] = mean_m
    if in_full:
        values["cloud_m"] = rbpf.sample(min(CLOUD_REPORT_PARTICLES, rbpf.config.particles))
        values |= {f"weight.{other}": weight for other, weight in estimator.weights.items()}
        values |= {f"rejected.{reason}": count for reason, count in estimator.rejected.items()}
    if np.isfinite(position_m).all():
        node.report(position_m, covariance_m2, **values)
    else:
        node.report(**values)
