"""An attacker among vehicles that exchange information: honest inside, with false frames."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from agents.cooperative.attack import EPOCH_LEAP, NOT_FINITE, Attack, shifted_sum
from agents.cooperative.cmm.information import Five, Information
from agents.cooperative.cmm.plausibility import MEMORY_S, PRIOR_GATE, SUM_GATE, moved, scaled_by
from agents.cooperative.information_estimator import InformationEstimator
from agents.cooperative.information_frame import InformationFrame, encode
from vnet import Fix
from vnet.types import Array
from vnet.units import NS_PER_S

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
            return encode(honest)
        self.sent += 1
        if self.attack.lie == "random":
            return self.rng.bytes(len(encode(honest)))
        return encode(self.falsify(honest, since_s))

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
    said = float(unit @ Information(frame.increment).matrix @ unit) * MEMORY_S / period_s
    increment_m = math.sqrt(SUM_GATE * (0.5 / max(said, 1e-6) + variance_m2))
    return BELOW_GATE * prior_m * unit, BELOW_GATE * min(increment_m, 10.0) * unit
