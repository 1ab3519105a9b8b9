"""`[program.options]` of the cooperative programs: what may be chosen, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from agents.cooperative.frame import COMMON_LIMIT_M
from vnet.cmm.consensus import AVERAGING_RULES
from vnet.cmm.map_matching import MIN_MAP_LOG_LIKELIHOOD
from vnet.cmm.rbpf import RbpfConfig
from vnet.errors import ProgramError

FUSIONS = ("optimized", "random", "metropolis", "max-degree", "constant", "none")
EXCHANGES = ("estimates", "particles")
CONSENSUSES = ("ratio", *AVERAGING_RULES, "exact")
PROFILES: dict[str, dict[str, Any]] = {
    "default": {},
    # The paper's, from its published runs (MODEL 7): a loose random walk, its 0.5 m a step of 0.1 s read as uniform
    # in ±0.5 m (docs/paper.md says why), lanes bounded on one side and counted anew each step, after the particles
    # of this very step have been stacked.
    "paper": {
        "particles": 50,
        "exchange": "particles",
        "relay": False,
        "consensus": "exact",
        "common_walk_m": 0.5 / math.sqrt(3) / math.sqrt(0.1),
        "one_sided": True,
        "separate_map_update": True,
        "two_frames": True,
        "fusion_interval_s": 0.1,
        "ridge_m2": 1e-4,
        "start_sigma_m": 0.1,
        "defence": False,
    },
}


@dataclass(frozen=True)
class Options:
    """What a cooperative vehicle does; lengths in metres, times in seconds. Defaults fit the default world."""

    profile: str = "default"
    """`paper` gives many other keys the paper's values as defaults; what is named besides still counts."""
    fusion: str = "optimized"
    """The rule of the fusion weights; `none` fuses nothing."""
    exchange: str = "estimates"
    """Whether estimates are pulled together, or particles mixed, as the paper does."""
    relay: bool = True
    """Whether a frame passes on the newest fixes of others."""
    consensus: str = "ratio"
    """How the network's mean is found. `exact` takes it from everybody's frame, so that all must hear all."""
    alpha: float = 0.5
    """Weight of the vehicle itself, if `fusion = "constant"`; 0 to 1."""
    self_floor: float = 0.0
    """Least weight of the vehicle itself, if `fusion = "optimized"`; 0 to 1."""
    ridge_m2: float = 0.0
    """If positive, the ridge of the weights' quadratic program, in place of each estimate's own variance."""
    fusion_interval_s: float = 0.2
    """Time between two fusions."""
    particles: int = 200
    """How many hypotheses of the common error a vehicle keeps; 1 to 100 000."""
    common_sigma_m: float = 3.0
    """Standard deviation of the common error, as the vehicle takes it to be."""
    common_tau_s: float = 600.0
    """Correlation time of the common error, as the vehicle takes it to be."""
    common_walk_m: float = 0.0
    """If positive, the common error is a random walk of so much a √s, in place of the Gauss-Markov process."""
    lateral_tau_s: float = 20.0
    """How long a vehicle keeps its offset in the lane: a road counts anew so often."""
    lateral_m: float = 500.0
    """On the map of a city: over how much road a vehicle keeps its offset in the lane."""
    off_road: float = 0.1
    """On the map of a city: the share of vehicles that are on no road."""
    start_m: list[float] = field(default_factory=lambda: [0.0, 0.0])
    """Where the cloud starts."""
    start_sigma_m: float = 0.0
    """How wide it starts; 0 means as wide as `common_sigma_m`."""
    one_sided: bool = False
    """Whether lanes are bounded on their right only, as the paper's."""
    separate_map_update: bool = False
    """Whether roads weigh the particles after stacking, all and each time anew, as the paper's."""
    two_frames: bool = False
    """Whether estimates follow in a frame of their own, once the fixes have been filtered, as the paper's."""
    hears: dict[str, list[str]] = field(default_factory=dict)
    """Whose frames count as a neighbour's (ids by id), if `consensus = "exact"`."""
    slots: int = 2
    """In how many slots of the period vehicles send; each draws one for good. 1 to 1000."""
    defence: bool = True
    """Whether what contradicts the majority is left out."""

    @classmethod
    def parse(cls, options: Mapping[str, Any]) -> Options:
        """Options from a scenario. Raises ProgramError that names the key, the value and what is allowed."""
        profile = options.get("profile", "default")
        if profile not in PROFILES:
            raise _wrong("profile", profile, f"allowed: {', '.join(PROFILES)}")
        default = cls()
        for key, value in options.items():
            if key not in {f.name for f in fields(cls)}:
                allowed = ", ".join(sorted(f.name for f in fields(cls)))
                raise ProgramError(f"program.options.{key}: unknown; allowed: {allowed}")
            kind = type(getattr(default, key))
            allowed_kinds = (int, float) if kind is float else kind
            if not isinstance(value, allowed_kinds) or isinstance(value, bool) != (kind is bool):
                raise _wrong(key, value, f"{kind.__name__} expected")
        parsed = cls(**{**PROFILES[profile], **options})
        parsed._check_choices()
        parsed._check_numbers()
        parsed._check_structure()
        return parsed

    def _check_choices(self) -> None:
        for key, allowed in (("fusion", FUSIONS), ("exchange", EXCHANGES), ("consensus", CONSENSUSES)):
            if getattr(self, key) not in allowed:
                raise _wrong(key, getattr(self, key), f"allowed: {', '.join(allowed)}")

    def _check_numbers(self) -> None:
        for key, low, high in (
            ("particles", 1, 100_000),
            ("slots", 1, 1000),
            ("alpha", 0, 1),
            ("self_floor", 0, 1),
            ("off_road", 0.001, 0.99),
            ("ridge_m2", 0, 1e6),
            ("common_sigma_m", 0, COMMON_LIMIT_M),
            ("common_walk_m", 0, COMMON_LIMIT_M),
            ("start_sigma_m", 0, COMMON_LIMIT_M),
        ):
            if not low <= getattr(self, key) <= high:
                raise _wrong(key, getattr(self, key), f"{low} to {high} allowed")
        for key in ("common_tau_s", "lateral_tau_s", "lateral_m", "fusion_interval_s"):
            if not getattr(self, key) > 0:
                raise _wrong(key, getattr(self, key), "must be positive")

    def _check_structure(self) -> None:
        good = len(self.start_m) == 2 and all(
            isinstance(x, (int, float)) and abs(x) <= COMMON_LIMIT_M for x in self.start_m
        )
        if not good:
            raise _wrong("start_m", self.start_m, f"two numbers within ±{COMMON_LIMIT_M} expected")
        for node, heard in self.hears.items():
            if not isinstance(heard, list) or not all(isinstance(other, str) for other in heard):
                raise _wrong(f"hears.{node}", heard, "a list of node ids expected")
        if self.hears and self.consensus != "exact":
            raise _wrong("hears", "…", 'only with consensus = "exact"')

    def filter_config(self) -> RbpfConfig:
        """The constants of the vehicle's particle filter."""
        return RbpfConfig(
            self.particles,
            self.common_sigma_m,
            self.common_tau_s,
            common_walk_m=self.common_walk_m or None,
            lateral_tau_s=self.lateral_tau_s,
            lateral_m=self.lateral_m,
            off_road=self.off_road,
            start_m=(self.start_m[0], self.start_m[1]),
            start_sigma_m=self.start_sigma_m or None,
            one_sided=self.one_sided,
            separate_map_update=self.separate_map_update,
            min_map_log_likelihood=MIN_MAP_LOG_LIKELIHOOD if self.defence else -math.inf,
        )


def _wrong(key: str, value: object, allowed: str) -> ProgramError:
    return ProgramError(f"program.options.{key} = {value!r}: {allowed}")
