"""An attacker: a vehicle that cooperates honestly inside, and broadcasts false frames, which others must withstand.

`[[program.exceptions]]` makes some vehicles attackers. Their options are those of `agents.cooperative`, and
those of `attack`, which says what is false.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from agents import options as parsing
from agents.cooperative.cmm.information import Five, Information
from agents.cooperative.cmm.lane_memory import information_of
from agents.cooperative.cmm.plausibility import COMPARED_GATE, PRIOR_GATE, SUM_MEMORY_S, moved, scaled_by
from agents.cooperative.estimator import Estimator
from agents.cooperative.frame import COMMON_LIMIT_M, CooperativeFrame, encode
from agents.cooperative.information_estimator import InformationEstimator
from agents.cooperative.information_frame import InformationFrame
from agents.cooperative.information_frame import encode as encode_information
from agents.cooperative.options import Options
from agents.cooperative.program import cooperate
from vnet import Fix, Node
from vnet.types import Array
from vnet.units import NS_PER_S

DECLARES = "agents.cooperative.declared"
Finite = Annotated[float, Meta(ge=-1e9, le=1e9)]
Lie = Literal[
    "offset", "overconfident", "sums", "relay", "epoch", "non_finite", "absurd", "random", "drift", "gates"
]
INFORMATION_LIES = ("drift", "gates")
"""Lies about information only."""

NOT_FINITE = (float("nan"), float("inf"), float("-inf"))
"""Values of an estimate, a covariance or a prior that is not finite, in turns."""
EPOCH_LEAP = 20
"""Number of epochs by which each frame of the lie `epoch` is ahead: more than a leap's largest penalty."""


class Attack(msgspec.Struct, frozen=True, kw_only=True):
    """The attacker's own options."""

    lie: Lie = "offset"
    """The fields that are false; see the module's text."""
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
        attack, program = parsing.parse(own, cls), Options.parse(others)
        if attack.lie in INFORMATION_LIES and program.exchange != "information":
            raise parsing.refuse("lie", attack.lie, 'allowed with exchange = "information" only')
        return attack, program


def shifted_sum(running_sum: tuple[float, float, float], offset_m: Array) -> tuple[float, float, float]:
    """Return sums whose ratio is off by `offset_m`, within the bounds of a frame."""
    s_x, s_y, w = running_sum
    s_x, s_y = np.clip([s_x + w * offset_m[0], s_y + w * offset_m[1]], -COMMON_LIMIT_M * w, COMMON_LIMIT_M * w)
    return float(s_x), float(s_y), w


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


DRIFT_S = 60.0
"""Time (s) in which the lie `drift` grows to the attack's offset."""
EXAGGERATION = 100.0
"""Factor by which an overconfident prior and increment claim more information than they have."""
BELOW_GATE = 0.9
"""Share of the deviation that a gate lets through which the lie `gates` makes use of."""


class InformationAttacker(InformationEstimator):
    """An estimator whose frames are false. `attack` is set once it has been made."""

    attack = Attack()
    sent = 0

    def frame(self, fix: Fix, max_payload: int) -> bytes:
        """Return the bytes to broadcast with the newest fix, at most `max_payload`."""
        self.observe(fix)
        honest = self.compose(fix, max_payload)
        since_s = fix.time_ns / NS_PER_S - self.attack.from_s
        if since_s < 0:
            return encode_information(honest)
        self.sent += 1
        if self.attack.lie == "random":
            return self.rng.bytes(len(encode_information(honest)))
        return encode_information(self.falsify(honest, since_s))

    def falsify(self, frame: InformationFrame, since_s: float) -> InformationFrame:
        """Return the frame as the attack changes it, `since_s` after its beginning."""
        offset_m = np.array(self.attack.offset_m)
        match self.attack.lie:
            case "offset":
                return _moved(frame, offset_m, offset_m)
            case "drift":
                return _moved(frame, offset_m * since_s / DRIFT_S, offset_m * since_s / DRIFT_S)
            case "gates":
                return _moved(frame, *_undetected(frame, offset_m, self.period_s, self.limit_m))
            case "overconfident":
                moved = _moved(frame, offset_m, offset_m)
                return replace(moved, prior=_louder(moved.prior), increment=_louder(moved.increment))
            case "sums":
                return replace(frame, running_sum=shifted_sum(frame.running_sum, offset_m))
            case "relay":
                passed = frame.passed.copy()
                for row, information in zip(passed, frame.passed_numbers.tolist(), strict=True):
                    row["information"] = np.clip(_shifted(information, offset_m), -6e4, 6e4)
                return replace(frame, passed=passed)
            case "epoch":
                return replace(frame, epoch=frame.epoch + EPOCH_LEAP)
            case "non_finite":
                return replace(frame, prior=(NOT_FINITE[self.sent % 3],) * 5)
            case _:
                return replace(frame, prior=(*frame.prior[:3], 1e30, -1e30))


def _louder(information: Five) -> Five:
    """Return what claims `EXAGGERATION` times as much information with the same mean."""
    return scaled_by(information, EXAGGERATION)


def _shifted(information: Five, by_m: Array) -> Five:
    """Return information whose mean is off by (2,)."""
    east, north = by_m.tolist()
    return moved(information, east, north)


def _moved(frame: InformationFrame, prior_by_m: Array, increment_by_m: Array) -> InformationFrame:
    """Return a frame whose prior, running sums and increment are off."""
    return replace(
        frame,
        prior=_shifted(frame.prior, prior_by_m),
        increment=_shifted(frame.increment, increment_by_m),
        running_sum=shifted_sum(frame.running_sum, prior_by_m),
    )


def _undetected(frame: InformationFrame, direction: Array, period_s: float, limit_m: float) -> tuple[Array, Array]:
    """Return the shifts (2,) of prior and increment that the gates just let through, if receivers know as much.

    `limit_m` is the distance from the median that its own neighbours are allowed.
    """
    unit = direction / max(float(np.hypot(*direction)), 1e-9)
    variance_m2 = float(unit @ np.linalg.inv(Information(frame.prior).matrix) @ unit)
    prior_m = min(limit_m, math.sqrt(PRIOR_GATE * 2 * variance_m2))
    said = float(unit @ Information(information_of(frame.increment)).matrix @ unit) * SUM_MEMORY_S / period_s
    increment_m = math.sqrt(COMPARED_GATE * 0.5 / max(said, 1e-6))
    return BELOW_GATE * prior_m * unit, BELOW_GATE * min(increment_m, 10.0) * unit
