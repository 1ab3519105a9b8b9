"""`[program.options]` of the cooperative positioning program and of its bound: values and ranges."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from agents import options as parsing
from agents.cooperative.cmm.consensus import AveragingRule
from agents.cooperative.cmm.map_matching import MIN_MAP_LOG_LIKELIHOOD
from agents.cooperative.cmm.own_vehicle import OwnConfig
from agents.cooperative.cmm.rbpf import RbpfConfig
from agents.cooperative.frame import COMMON_LIMIT_M

Share = Annotated[float, Meta(ge=0, le=1)]
Deviation = Annotated[float, Meta(ge=0, le=COMMON_LIMIT_M)]
Offset = Annotated[float, Meta(ge=-COMMON_LIMIT_M, le=COMMON_LIMIT_M)]
Positive = Annotated[float, Meta(gt=0)]

RENAMED = {"roads_apart": "separate_map_update"}
"""New names of options, by the old."""

OWN_PARTICLES, SHARED_PARTICLES = 1000, 200
"""Numbers of particles of a filter of a vehicle's own fixes, and of one of the fixes of all."""

PAPER_STEP_S = 0.1
"""The paper's period (s)."""
PAPER_STEP_M = 0.5 / math.sqrt(3)
"""Deviation (m) of the paper's common error in a step: its 0.5 m, read as uniform in ±0.5 m (docs/paper.md)."""

PROFILES: dict[str, dict[str, Any]] = {
    "default": {},
    "paper": {  # the constants of the paper's published runs (MODEL 7)
        "particles": 50,  # fewer than ours: the filter starts where the common error is
        "start_sigma_m": 0.1,  # m
        "common_walk_m": PAPER_STEP_M / math.sqrt(PAPER_STEP_S),  # m/√s, a loose random walk
        "one_sided": True,  # lanes are bounded on the right only
        "separate_map_update": True,  # the map counts in full in each step, after the particles have been fused
        "exchange": "particles",
        "fusion_interval_s": PAPER_STEP_S,  # s: fusion in each step
        "ridge_m2": 1e-4,  # m²: the paper has no ridge, and a small one stands for that
        "consensus": "exact",  # everybody's estimate is known to everybody
        "two_frames": True,  # estimates of this very step are fused
        "relay": False,
        "defence": False,
    },
}


class Options(msgspec.Struct, frozen=True, kw_only=True):
    """Options of a cooperative vehicle; lengths in metres, times in seconds. Defaults fit the default world."""

    profile: Literal["default", "paper"] = "default"
    """`paper` gives many other keys the paper's values as defaults; keys that are set besides still count."""
    fusion: Literal["optimized", "random", "metropolis", "max-degree", "constant", "none"] = "optimized"
    """Rule of the fusion weights; `none` fuses nothing."""
    exchange: Literal["information", "particles"] = "information"
    """With `information` a vehicle filters itself alone and exchanges what it knows of the common error, not fixes.
    With `particles` it filters all fixes that it hears of, and fusion mixes the neighbours' particles, as in the
    paper."""
    relay: bool = True
    """If true, a frame relays the newest fixes of others; not with `exchange = "information"`."""
    relay_increments: Annotated[int, Meta(ge=0, le=255)] = 30
    """Number of increments that a frame passes on, with `exchange = "information"`."""
    lateral_sigma_m: Deviation = 0.0
    """Deviation of the offset in a straight lane, with `exchange = "information"`; 0 means 0.45 half-widths."""
    consensus: Literal["ratio", AveragingRule, "exact"] = "ratio"
    """Algorithm that finds the mean of all estimates. `exact` averages all frames, so that all must hear all."""
    alpha: Share = 0.5
    """Weight of the vehicle itself, if `fusion = "constant"`."""
    self_floor: Share = 0.0
    """Least weight of the vehicle itself, if `fusion = "optimized"`."""
    ridge_m2: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    """If positive, the ridge of the weights' quadratic program, in place of each estimate's own variance."""
    solver: Literal["auto", "exact", "osqp"] = "auto"
    """Solver of the weights' quadratic program; `auto` is `exact` with `exchange = "information"` and OSQP else."""
    fusion_interval_s: Positive = 0.2
    """Time between two fusions; not with `exchange = "information"`, which fuses in each period."""
    particles: Annotated[int, Meta(ge=0, le=100_000)] = 0
    """Number of hypotheses of the common error that a vehicle keeps; 0 means 200. With `exchange = "information"`
    there are four times as many while lanes compete, and none once one is left; 0 means 1000 there."""
    least_particles: Annotated[int, Meta(ge=0, le=100_000)] = 0
    """With `exchange = "information"` on straight lanes, while several compete: the number of particles goes down
    to it as their spread does, by KLD sampling (Fox 2003); 0 keeps their number."""
    common_sigma_m: Deviation = 3.0
    """Standard deviation of the common error, as the vehicle assumes it."""
    common_tau_s: Positive = 600.0
    """Correlation time of the common error, as the vehicle assumes it."""
    common_walk_m: Deviation = 0.0
    """If positive, the common error is a random walk of so much a √s, in place of the Gauss-Markov process."""
    lateral_tau_s: Positive = 20.0
    """Time for which a vehicle keeps its offset in the lane: after it a road is new evidence."""
    lateral_m: Positive = 500.0
    """On the map of a city: way for which a vehicle keeps its offset in the lane."""
    off_road: Annotated[float, Meta(ge=0.001, le=0.99)] = 0.1
    """On the map of a city: share of the vehicles that are on no road."""
    start_m: tuple[Offset, Offset] = (0.0, 0.0)
    """Mean of the first particles."""
    start_sigma_m: Deviation = 0.0
    """Standard deviation of the first particles; 0 means `common_sigma_m`."""
    one_sided: bool = False
    """If true, lanes are bounded on their right only, as in the paper; not with `exchange = "information"`."""
    separate_map_update: bool = False
    """If true, the map weights the particles after fusion, for all vehicles and in full, as in the paper;
    not with `exchange = "information"`."""
    two_frames: bool = False
    """If true, estimates follow in a frame of their own, once the fixes have been filtered, as in the paper; not
    with `exchange = "information"`."""
    hears: dict[str, list[str]] = {}
    """Neighbours of each vehicle (ids by id), if `consensus = "exact"`: only their frames are fused."""
    slots: Annotated[int, Meta(ge=1, le=1000)] = 2
    """Number of slots of the period in which vehicles send; each draws one for good."""
    defence: bool = True
    """If true, frames and estimates that contradict the majority are rejected."""

    @classmethod
    def parse(cls, options: Mapping[str, Any]) -> Options:
        """Convert the options of a scenario. Raises ProgramError with the key, the value and what is allowed."""
        chosen = parsing.parse(options, cls, RENAMED)
        parsed = parsing.parse({**PROFILES[chosen.profile], **options}, cls)
        if parsed.hears and parsed.consensus != "exact":
            raise parsing.refuse("hears", parsed.hears, 'allowed with consensus = "exact" only')
        return parsed

    @property
    def sends_twice(self) -> bool:
        """True if estimates follow in a second frame: with `exchange = "information"` all is in the first."""
        return self.two_frames and self.exchange != "information"

    @property
    def chosen_solver(self) -> Literal["exact", "osqp"]:
        """The solver of the weights: for `auto`, the faster one where results need not be those of before."""
        if self.solver != "auto":
            return self.solver
        return "exact" if self.exchange == "information" else "osqp"

    def own_config(self) -> OwnConfig:
        """Return the constants of the filter of a vehicle that exchanges information."""
        return OwnConfig(self.filter_config(OWN_PARTICLES), self.lateral_sigma_m, self.least_particles)

    def filter_config(self, particles: int = SHARED_PARTICLES) -> RbpfConfig:
        """Return the constants of the vehicle's particle filter, of so many particles if the options do not say."""
        return RbpfConfig(
            particles=self.particles or particles,
            common_sigma_m=self.common_sigma_m,
            common_tau_s=self.common_tau_s,
            common_walk_m=self.common_walk_m or None,
            lateral_tau_s=self.lateral_tau_s,
            lateral_m=self.lateral_m,
            off_road=self.off_road,
            start_m=self.start_m,
            start_sigma_m=self.start_sigma_m or None,
            one_sided=self.one_sided,
            separate_map_update=self.separate_map_update,
            min_map_log_likelihood=MIN_MAP_LOG_LIKELIHOOD if self.defence else -math.inf,
        )
