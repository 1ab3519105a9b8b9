"""The attack of an attacker: the lie in its frames, its size, and the time from which on it lies.

`lie`: what is false in the frames.
    `offset`: the own fix, estimate and running sums are shifted by `offset_m`.
    `overconfident`: the estimate is shifted by `offset_m`, with a deviation of a millimetre.
    `sums`: the running sums alone are shifted by `offset_m`.
    `relay`: relayed fixes are shifted by `offset_m`, and claim to be new; so are increments that are passed on.
    `epoch`: each frame starts a new epoch of the consensus, `EPOCH_LEAP` ahead of the last.
    `non_finite`: estimate and covariance are NaN and infinite in turns.
    `absurd`: huge estimates, negative covariances, and fixes 20 000 km away, in turns.
    `random`: random bytes, as long as a frame.
    `drift`: as `offset`, but it grows to `offset_m` in a minute, and further; with `exchange = "information"` only.
    `gates`: a shift in the direction of `offset_m` that is just too small to be rejected; likewise.
`offset_m`: [east, north] in metres.
`from_s`: time of the run before which the frames are honest.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from agents import options as parsing
from agents.cooperative.frame import COMMON_LIMIT_M
from agents.cooperative.options import Options
from vnet.types import Array

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
