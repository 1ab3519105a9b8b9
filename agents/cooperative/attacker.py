"""A vehicle that cooperates honestly inside, and lies in what it broadcasts: what the others must withstand.

`[[program.exceptions]]` makes one of some vehicles. Its options are those of `agents.cooperative`, and

`lie`: what is said.
    `offset`: its own fix, its estimate and its running sums are shifted by `offset_m`.
    `overconfident`: its estimate is shifted by `offset_m`, and said to be known to the millimetre.
    `sums`: its running sums alone are shifted by `offset_m`.
    `relay`: fixes of others that it passes on are shifted by `offset_m`, and said to be brand new.
    `epoch`: each frame starts a new epoch of the consensus, `EPOCH_LEAP` ahead of the last.
    `non_finite`: its estimate and covariance are NaN and infinite in turns.
    `absurd`: huge estimates, negative covariances, and fixes at the end of the world, in turns.
    `random`: bytes drawn at random, as long as a frame.
`offset_m`: [east, north] in metres.
`from_s`: honest before that time of the run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from agents import options as parsing
from agents.cooperative.frame import COMMON_LIMIT_M, CooperativeFrame, encode
from agents.cooperative.options import Options
from agents.cooperative.program import Estimator, cooperate
from vnet import Fix, Node
from vnet.types import Array
from vnet.units import NS_PER_S

Finite = Annotated[float, Meta(ge=-1e9, le=1e9)]

EPOCH_LEAP = 20
"""Epochs between two frames of an attack on the epochs: more than honest vehicles start in seconds."""
_NOT_FINITE = (float("nan"), float("inf"), float("-inf"))
_ABSURD = ((1e30, 1.0, 0), (0.0, -1.0, 0), (0.0, 1e30, 0), (0.0, 1.0, 2_000_000_000))
"""Estimate in metres, variance in m², and shift of the fix in centimetres."""


class Attack(msgspec.Struct, frozen=True, kw_only=True):
    """The attacker's own options."""

    lie: Literal["offset", "overconfident", "sums", "relay", "epoch", "non_finite", "absurd", "random"] = "offset"
    """What is false in its frames; see the module's text."""
    offset_m: tuple[Finite, Finite] = (50.0, 0.0)
    """Shift (east, north) of what is false."""
    from_s: Finite = 0.0
    """Time of the run from which on frames are false."""

    @classmethod
    def split(cls, options: Mapping[str, Any]) -> tuple[Attack, Options]:
        """Convert the options of a scenario into those of the attack, and those of the program that it extends.

        Raises ProgramError with the key, the value and what is allowed.
        """
        own = {key: value for key, value in options.items() if key in cls.__struct_fields__}
        others = {key: value for key, value in options.items() if key not in own}
        return parsing.parse(own, cls), Options.parse(others)


class Attacker(Estimator):
    """An estimator whose frames are false. `attack` is set once it has been made."""

    attack = Attack()
    sent = 0

    def frame(self, fix: Fix, max_payload: int) -> bytes:
        """What to broadcast together with the newest fix."""
        honest = self.compose(fix, max_payload)
        if fix.time_ns < self.attack.from_s * NS_PER_S:
            return encode(honest)
        self.sent += 1
        if self.attack.lie == "random":
            return self._rng.bytes(len(encode(honest)))
        return encode(self.falsify(honest))

    def falsify(self, frame: CooperativeFrame) -> CooperativeFrame:
        """The frame, as the lie has it."""
        offset_m = np.array(self.attack.offset_m)
        match self.attack.lie:
            case "offset":
                return replace(
                    frame,
                    fix_m=frame.fix_m + offset_m,
                    estimate_m=frame.estimate_m + offset_m,
                    running_sum=_shifted(frame.running_sum, offset_m),
                )
            case "overconfident":
                return replace(frame, estimate_m=frame.estimate_m + offset_m, covariance_m2=1e-6 * np.eye(2))
            case "sums":
                return replace(frame, running_sum=_shifted(frame.running_sum, offset_m))
            case "relay":
                relayed = frame.relayed.copy()
                relayed["x_cm"] += round(100 * offset_m[0])
                relayed["y_cm"] += round(100 * offset_m[1])
                relayed["age"] = 0
                return replace(frame, relayed=relayed)
            case "epoch":
                return replace(frame, epoch=frame.epoch + EPOCH_LEAP)
            case "non_finite":
                wrong = _NOT_FINITE[self.sent % 3]
                return replace(frame, estimate_m=np.full(2, wrong), covariance_m2=np.full((2, 2), wrong))
            case _:
                estimate, variance, far_cm = _ABSURD[self.sent % len(_ABSURD)]
                fix_m = np.full(2, far_cm / 100) if far_cm else frame.fix_m
                covariance = variance * np.eye(2)
                return replace(frame, fix_m=fix_m, estimate_m=np.full(2, estimate), covariance_m2=covariance)


def _shifted(running_sum: tuple[float, float, float], offset_m: Array) -> tuple[float, float, float]:
    """Sums whose ratio is off by `offset_m`, as far as that may be said at all."""
    s_x, s_y, w = running_sum
    s_x, s_y = np.clip([s_x + w * offset_m[0], s_y + w * offset_m[1]], -COMMON_LIMIT_M * w, COMMON_LIMIT_M * w)
    return float(s_x), float(s_y), w


async def main(node: Node) -> None:
    """Cooperate inside, and broadcast false frames, until the run ends."""
    attack, options = Attack.split(node.options)
    attacker = Attacker(node.id, options, node.map, node.rng, node.period_ns)
    attacker.attack = attack
    await cooperate(node, options, attacker)
