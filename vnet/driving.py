"""Driving: what a program asks its vehicle to do."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec

from vnet.errors import shown
from vnet.radio import number_or_nan

LARGEST_M_S2 = 1e6
"""Largest acceleration that can be asked for; what vehicles can do is far below it."""


class Action(msgspec.Struct, frozen=True, array_like=True):
    """Request of the program of `node`: an acceleration, or a change by `lane` lanes, 1 to the left.

    `release` leaves the speed to the vehicle: to SUMO's driver where there is one, else it is kept.
    """

    node: str
    acceleration_m_s2: Annotated[float, msgspec.Meta(ge=-LARGEST_M_S2, le=LARGEST_M_S2)] | None = None
    lane: Annotated[int, msgspec.Meta(ge=-1, le=1)] = 0
    release: bool = False

    @property
    def is_sound(self) -> bool:
        """True unless its acceleration is no number, which no bound of a message excludes."""
        return self.acceleration_m_s2 is None or math.isfinite(self.acceleration_m_s2)


def checked_action(
    node: str, can_drive: bool, acceleration_m_s2: float | None, lane: int, release: bool = False
) -> Action:
    """Return an action of `node`. Raise ValueError for one that is none, and if programs do not drive."""
    if not can_drive:
        raise ValueError('drive(…): programs drive only with [network] kind = "driven", or with step = true')
    asked = acceleration_m_s2
    if asked is not None:
        asked = number_or_nan(asked)
        if not abs(asked) <= LARGEST_M_S2:
            text = f"a finite number within ±{LARGEST_M_S2:g} is needed"
            raise ValueError(f"drive(acceleration_m_s2={shown(acceleration_m_s2)}): {text}")
    if lane not in (-1, 0, 1):
        raise ValueError(f"drive(lane={shown(lane)}): allowed are -1 (right), 1 (left) and 0 (stay)")
    if not isinstance(release, bool):
        raise ValueError(f"drive(release={shown(release)}): True or False is needed")
    if asked is not None and release:
        raise ValueError("drive(…, release=True): gives the speed back, and takes no acceleration_m_s2")
    if asked is None and lane == 0 and not release:
        raise ValueError("drive(): give acceleration_m_s2, lane or both")
    return Action(node, asked, int(lane), release)
