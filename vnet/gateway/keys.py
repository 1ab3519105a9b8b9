"""Keys of Zenoh that a vehicle's own programs and vnet share, and those that cross the radio."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import zenoh

from vnet.errors import ProgramError, shown
from vnet.node import Fix

OWN_KEYS = "vnet/"
"""Prefix of keys that never cross the radio: what vnet tells the programs of a vehicle, and they it."""
FIX_KEY, REPORT_KEY = f"{OWN_KEYS}fix", f"{OWN_KEYS}report"
RADIO_KEYS = ("**", "**/@adv/**")
"""Key expressions that cross the radio if `radio.keys` is left out: `**` has no keys with a part such as `@adv`."""


def check_keys(keys: Sequence[str]) -> None:
    """Raise ProgramError for a key that cannot cross, and for two of which a sample could be sent twice."""
    for number, key in enumerate(keys):
        try:
            expression = zenoh.KeyExpr(key)
        except zenoh.ZError:
            raise ProgramError(f"{shown(key)} is no key expression of Zenoh") from None
        if key.startswith(OWN_KEYS):
            raise ProgramError(f"{shown(key)} never crosses the radio, as all keys under {OWN_KEYS}")
        for other in keys[:number]:
            if expression.intersects(other):
                raise ProgramError(f"{shown(other)} and {shown(key)} overlap")


def fix_content(fix: Fix) -> bytes:
    """Return what programs are told of a fix, under `FIX_KEY`."""
    return msgspec.msgpack.encode(
        {
            "time_ns": fix.time_ns,
            "position_m": fix.position_m.tolist(),
            "covariance_m2": fix.covariance_m2.tolist(),
            "heading_rad": fix.heading_rad,
            "speed_m_s": fix.speed_m_s,
        }
    )
