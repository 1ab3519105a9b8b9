"""Decentralized cooperative map matching: what a vehicle does each period, and what it sends.

At each fix: take what neighbours broadcast a period ago; filter everybody's fixes of that period; one round of mean
consensus; mix neighbours' particles into one's own; predict to now; broadcast once; report. The filter runs one
period behind, because a neighbour's fix reaches it one period late or not at all. The mathematics is `vnet.cmm`'s.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from agents.cooperative_frame import (
    COMMON_LIMIT_M,
    CooperativeFrame,
    FrameError,
    decode,
    encode,
    room_for_particles,
    short_name,
)
from vnet import Fix, Node, Packet
from vnet.cmm.consensus import AVERAGING_RULES, AveragingConsensus, Consensus, RatioConsensus, Share
from vnet.cmm.fusion import Cloud, fuse
from vnet.cmm.rbpf import Observation, Rbpf, RbpfConfig
from vnet.cmm.weights import OptimizedWeights, random_weights
from vnet.errors import ProgramError
from vnet.roads.lanes import Array, LaneMap

NS_PER_S = 1_000_000_000
STALE_PERIODS = 3
EPOCHS_PER_PERIOD = 100
"""More than a whole network could ever start in a period: a frame that claims it is absurd, and would spread."""
CLOUD_REPORT_PARTICLES = 50
FUSIONS = ("optimized", "random", "none")
CONSENSUSES = ("ratio", *AVERAGING_RULES)


@dataclass(frozen=True)
class Options:
    """`[program.options]`. Defaults fit the default world; lengths in metres, times in seconds."""

    fusion: str = "optimized"
    consensus: str = "ratio"
    particles: int = 200
    common_sigma_m: float = 3.0
    common_tau_s: float = 600.0
    lateral_tau_s: float = 20.0
    self_floor: float = 0.0
    fusion_interval_s: float = 0.5

    @classmethod
    def parse(cls, options: Mapping[str, Any]) -> Options:
        """Options from a scenario. Raises ProgramError that names the key, the value and what is allowed."""
        kinds = {field.name: type(field.default) for field in fields(cls)}
        for key, value in options.items():
            if key not in kinds:
                raise ProgramError(f"program.options.{key}: unknown; allowed: {', '.join(sorted(kinds))}")
            if not isinstance(value, (int, float) if kinds[key] is float else kinds[key]) or isinstance(
                value, bool
            ):
                raise ProgramError(f"program.options.{key} = {value!r}: {kinds[key].__name__} expected")
        parsed = cls(**options)
        if parsed.fusion not in FUSIONS:
            raise ProgramError(f"program.options.fusion = {parsed.fusion!r}: allowed: {', '.join(FUSIONS)}")
        if parsed.consensus not in CONSENSUSES:
            raise ProgramError(
                f"program.options.consensus = {parsed.consensus!r}: allowed: {', '.join(CONSENSUSES)}"
            )
        if not 2 <= parsed.particles <= 100_000:
            raise ProgramError(f"program.options.particles = {parsed.particles}: 2 to 100000 allowed")
        for key in ("common_tau_s", "lateral_tau_s", "fusion_interval_s"):
            if not getattr(parsed, key) > 0:
                raise ProgramError(f"program.options.{key} = {getattr(parsed, key)}: must be positive")
        if not 0 <= parsed.self_floor <= 1:
            raise ProgramError(f"program.options.self_floor = {parsed.self_floor}: 0 to 1 allowed")
        if not 0 <= parsed.common_sigma_m <= COMMON_LIMIT_M:
            raise ProgramError(
                f"program.options.common_sigma_m = {parsed.common_sigma_m}: 0 to {COMMON_LIMIT_M} allowed"
            )
        return parsed


class Estimator:
    """The state of one vehicle's cooperation, without any input or output of its own."""

    def __init__(self, node_id: str, options: Options, lanes: LaneMap, rng: np.random.Generator) -> None:
        self.name = short_name(node_id)
        self.rejected: Counter[str] = Counter()
        self.stacked_m: Array | None = None
        self._since_fusion_s = 0.0
        self._options = options
        self._rng = rng
        config = RbpfConfig(
            options.particles,
            options.common_sigma_m,
            options.common_tau_s,
            lateral_tau_s=options.lateral_tau_s,
        )
        self.rbpf = Rbpf(config, lanes, rng)
        self.consensus: Consensus = _consensus(options.consensus, self.name)
        self._early: list[tuple[str, CooperativeFrame]] = []
        self._weights = OptimizedWeights(options.self_floor)
        self._share = Share(0, (0.0, 0.0, 0.0), frozenset(), frozenset())

    def read(self, packets: Iterable[Packet], now_ns: int, period_ns: int) -> dict[str, CooperativeFrame]:
        """The newest usable frame of each neighbour, by short name; what is not usable is counted by reason.

        The filter runs one period behind. A vehicle that is late with its work, as in real time it may be, finds
        frames of this very period: they are kept until it is their turn.
        """
        newest: dict[str, CooperativeFrame] = {}
        waiting, self._early = self._early, []
        for sender, frame in [*waiting, *self._decoded(packets)]:
            age_ns = now_ns - frame.fix_time_ns
            if abs(age_ns) > STALE_PERIODS * period_ns:
                self.rejected["stale"] += 1
            elif frame.epoch > EPOCHS_PER_PERIOD * (1 + now_ns // period_ns):
                self.rejected["absurd"] += 1
            elif age_ns <= 0:
                self._early.append((sender, frame))
            elif sender not in newest or frame.fix_time_ns > newest[sender].fix_time_ns:
                newest[sender] = frame
        return dict(sorted(newest.items()))

    def _decoded(self, packets: Iterable[Packet]) -> Iterator[tuple[str, CooperativeFrame]]:
        for packet in packets:
            try:
                yield short_name(packet.sender), decode(packet.payload)
            except FrameError as error:
                self.rejected[str(error)] += 1

    def step(self, dt_s: float, own: Fix, frames: Mapping[str, CooperativeFrame]) -> None:
        """One period, up to the time of the fix `own`, which is the one before the latest."""
        observations = {self.name: Observation(own.position_m, own.covariance_m2, own.heading_rad)}
        for sender, frame in frames.items():
            if frame.fix_time_ns == own.time_ns:
                observations[sender] = Observation(frame.fix_m, own.covariance_m2, frame.heading_rad)
        self.rbpf.step(dt_s, observations)
        self._share = self.consensus.round(self.rbpf.estimate_m, {s: _share(f) for s, f in frames.items()})
        self._since_fusion_s += dt_s
        due = self._since_fusion_s >= self._options.fusion_interval_s - dt_s / 2
        if due and frames and self._options.fusion != "none":
            self._since_fusion_s = 0.0
            self.stacked_m = self._fuse(frames)
        else:
            self.stacked_m = self.rbpf.estimate_m

    def _fuse(self, frames: Mapping[str, CooperativeFrame]) -> Array:
        rbpf = self.rbpf
        estimates = np.array([rbpf.estimate_m, *(frame.estimate_m for frame in frames.values())])
        if self._options.fusion == "random":
            weights = random_weights(len(estimates), self._rng)
        else:
            mean = self.consensus.mean_m
            own_covariance = rbpf.estimate_covariance_m2 + 1e-9 * np.eye(2)  # a collapsed cloud is still a cloud
            covariances = np.array([own_covariance, *(frame.covariance_m2 for frame in frames.values())])
            weights = self._weights.solve(estimates, covariances, estimates.mean(axis=0) if mean is None else mean)
        clouds = [Cloud(frame.cloud_m, frozenset(frame.heard) | {sender}) for sender, frame in frames.items()]
        return fuse(rbpf, clouds, weights, self._rng)

    def frame(self, fix: Fix, max_payload: int) -> bytes:
        """What to broadcast together with the newest fix."""
        share = self._share
        heard = {name: name in share.takers for name in sorted(share.heard)[:255]}
        count = min(self._options.particles, room_for_particles(len(heard), max_payload))
        frame = CooperativeFrame(
            fix.time_ns,
            fix.position_m,
            fix.heading_rad,
            self.rbpf.estimate_m,
            self.rbpf.estimate_covariance_m2 + 1e-6 * np.eye(2),
            share.epoch,
            share.running_sum,
            heard,
            self.rbpf.sample(count),
        )
        return encode(frame)


def _consensus(rule: str, name: str) -> Consensus:
    return RatioConsensus(name) if rule == "ratio" else AveragingConsensus(name, rule)


def _share(frame: CooperativeFrame) -> Share:
    takers = frozenset(name for name, takes in frame.heard.items() if takes)
    return Share(frame.epoch, frame.running_sum, takers, frozenset(frame.heard))


async def main(node: Node) -> None:
    """Cooperate until the run ends."""
    estimator = Estimator(node.id, Options.parse(node.options), node.map, node.rng)
    periods_a_second = max(1, NS_PER_S // node.period_ns)
    previous: Fix | None = None
    async for fix in node.gnss:
        frames = estimator.read(node.radio.drain(), fix.time_ns, node.period_ns)
        if previous is not None:
            dt_s = (fix.time_ns - previous.time_ns) / NS_PER_S
            estimator.step(dt_s, previous, frames)
        payload = estimator.frame(fix, node.radio.max_payload)
        await node.radio.broadcast(payload)
        if previous is not None:
            with_cloud = (fix.time_ns // node.period_ns) % periods_a_second == 0
            _report(node, estimator, dt_s, len(frames), len(payload), with_cloud)
        previous = fix


def _report(node: Node, estimator: Estimator, dt_s: float, heard: int, size: int, with_cloud: bool) -> None:
    """Report the position predicted to now, and what the metrics know of the common error."""
    rbpf = estimator.rbpf
    position_m, covariance_m2 = rbpf.position_m(estimator.name)
    values: dict[str, Any] = {
        "common_error_m": rbpf.estimate_m,
        "common_error_covariance_m2": rbpf.estimate_covariance_m2,
        "stacked_common_error_m": estimator.stacked_m,
        "heard": heard,
        "bytes": size,
        "rejected": estimator.rejected.total(),
    }
    mean_m = estimator.consensus.mean_m
    if mean_m is not None:
        values["mean_m"] = mean_m
    if with_cloud:
        values["cloud_m"] = rbpf.sample(min(CLOUD_REPORT_PARTICLES, rbpf.config.particles))
    node.report(position_m + dt_s * rbpf.velocity_m_s(estimator.name), covariance_m2, **values)
