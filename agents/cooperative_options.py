"""`[program.options]` of the cooperative programs: what may be chosen, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from agents.cooperative_frame import COMMON_LIMIT_M
from vnet.cmm.consensus import AVERAGING_RULES
from vnet.cmm.rbpf import RbpfConfig
from vnet.errors import ProgramError

FUSIONS = ("optimized", "random", "metropolis", "max-degree", "constant", "none")
EXCHANGES = ("estimates", "particles")
CONSENSUSES = ("ratio", *AVERAGING_RULES, "exact")
LEAST_LOG_ROAD = -6.0
"""What a road says at worst against a hypothesis, so that one vehicle cannot outvote all others."""
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
        "roads_apart": True,
        "two_frames": True,
        "fusion_interval_s": 0.1,
        "ridge_m2": 1e-4,
        "start_sigma_m": 0.1,
        "defence": False,
    },
}


@dataclass(frozen=True)
class Options:
    """What a cooperative vehicle does; lengths in metres, times in seconds. Defaults fit the default world.

    `profile` chooses other defaults. `fusion` is the rule of the weights (`constant` gives `alpha` to the vehicle
    itself); `exchange` whether estimates are pulled together or particles are mixed; `relay` whether fixes are
    passed on. `consensus` is how the network's mean is found; `exact` takes it from everybody's frame, so that
    everybody must hear everybody, and `hears` (ids by id) then says whose frames count as a neighbour's.
    `self_floor` is the least weight of the vehicle itself under `optimized`; `ridge_m2` > 0 is the same ridge for
    all in place of each estimate's variance. `common_walk_m` > 0 is a random walk of so much a √s in place of the
    Gauss-Markov process. `start_m` and `start_sigma_m` (if positive) say where the cloud starts. The paper's are
    `one_sided`, `roads_apart` (roads weigh the particles after stacking, all and each time anew) and `two_frames`
    (estimates follow in a frame of their own, once the fixes have been filtered). `defence`: what contradicts the
    majority is left out (docs/estimator.md).
    """

    profile: str = "default"
    fusion: str = "optimized"
    exchange: str = "estimates"
    relay: bool = True
    consensus: str = "ratio"
    alpha: float = 0.5
    self_floor: float = 0.0
    ridge_m2: float = 0.0
    fusion_interval_s: float = 0.2
    particles: int = 200
    common_sigma_m: float = 3.0
    common_tau_s: float = 600.0
    common_walk_m: float = 0.0
    lateral_tau_s: float = 20.0
    start_m: list[float] = field(default_factory=lambda: [0.0, 0.0])
    start_sigma_m: float = 0.0
    one_sided: bool = False
    roads_apart: bool = False
    two_frames: bool = False
    hears: dict[str, list[str]] = field(default_factory=dict)
    slots: int = 2
    defence: bool = True

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
            ("ridge_m2", 0, 1e6),
            ("common_sigma_m", 0, COMMON_LIMIT_M),
            ("common_walk_m", 0, COMMON_LIMIT_M),
            ("start_sigma_m", 0, COMMON_LIMIT_M),
        ):
            if not low <= getattr(self, key) <= high:
                raise _wrong(key, getattr(self, key), f"{low} to {high} allowed")
        for key in ("common_tau_s", "lateral_tau_s", "fusion_interval_s"):
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
            start_m=(self.start_m[0], self.start_m[1]),
            start_sigma_m=self.start_sigma_m or None,
            one_sided=self.one_sided,
            roads_apart=self.roads_apart,
            least_log_road=LEAST_LOG_ROAD if self.defence else -math.inf,
        )


def _wrong(key: str, value: object, allowed: str) -> ProgramError:
    return ProgramError(f"program.options.{key} = {value!r}: {allowed}")
