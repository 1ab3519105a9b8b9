"""An attacker: a vehicle that cooperates honestly inside, and broadcasts false frames, which others must withstand.

`[[program.exceptions]]` makes some vehicles attackers. Their options are those of `agents.cooperative`, and
those of `attack`, which says what is false.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agents.cooperative.attack import EPOCH_LEAP, NOT_FINITE, Attack, shifted_sum
from agents.cooperative.estimator import Estimator
from agents.cooperative.frame import CooperativeFrame, encode
from agents.cooperative.information_attacker import InformationAttacker
from agents.cooperative.program import cooperate
from vnet import Fix, Node
from vnet.units import NS_PER_S

DECLARES = "agents.cooperative.declared"
_ABSURD = ((1e30, 1.0, 0), (0.0, -1.0, 0), (0.0, 1e30, 0), (0.0, 1.0, 2_000_000_000))
"""Absurd frames, in turns: estimate in metres, variance in m², and position of the fix in centimetres."""


class Attacker(Estimator):
    """An estimator whose frames are false. `attack` is set once it has been made."""

    attack = Attack()
    sent = 0

    def frame(self, fix: Fix, max_payload: int) -> bytes:
        """Return the bytes to broadcast with the newest fix, at most `max_payload`."""
        honest = self.compose(fix, max_payload)
        if fix.time_ns < self.attack.from_s * NS_PER_S:
            return encode(honest)
        self.sent += 1
        if self.attack.lie == "random":
            return self._rng.bytes(len(encode(honest)))
        return encode(self.falsify(honest))

    def falsify(self, frame: CooperativeFrame) -> CooperativeFrame:
        """Return the frame as the attack changes it."""
        offset_m = np.array(self.attack.offset_m)
        match self.attack.lie:
            case "offset":
                return replace(
                    frame,
                    fix_m=frame.fix_m + offset_m,
                    estimate_m=frame.estimate_m + offset_m,
                    running_sum=shifted_sum(frame.running_sum, offset_m),
                )
            case "overconfident":
                return replace(frame, estimate_m=frame.estimate_m + offset_m, covariance_m2=1e-6 * np.eye(2))
            case "sums":
                return replace(frame, running_sum=shifted_sum(frame.running_sum, offset_m))
            case "relay":
                relayed = frame.relayed.copy()
                relayed["x_cm"] += round(100 * offset_m[0])
                relayed["y_cm"] += round(100 * offset_m[1])
                relayed["age"] = 0
                return replace(frame, relayed=relayed)
            case "epoch":
                return replace(frame, epoch=frame.epoch + EPOCH_LEAP)
            case "non_finite":
                wrong = NOT_FINITE[self.sent % 3]
                return replace(frame, estimate_m=np.full(2, wrong), covariance_m2=np.full((2, 2), wrong))
            case _:
                estimate, variance, far_cm = _ABSURD[self.sent % len(_ABSURD)]
                fix_m = np.full(2, far_cm / 100) if far_cm else frame.fix_m
                covariance = variance * np.eye(2)
                return replace(frame, fix_m=fix_m, estimate_m=np.full(2, estimate), covariance_m2=covariance)


async def main(node: Node) -> None:
    """Cooperate inside, and broadcast false frames, until the run ends."""
    attack, options = Attack.split(node.options)
    kind = InformationAttacker if options.exchange == "information" else Attacker
    attacker = kind(node.id, options, node.map, node.rng, node.period_ns)
    attacker.attack = attack
    await cooperate(node, options, attacker)
