"""Keys of Zenoh that a vehicle's own programs and vnet share, and those that cross the radio."""

from __future__ import annotations

OWN_KEYS = "vnet/"
"""Prefix of keys that never cross the radio: what vnet tells the programs of a vehicle, and they it."""
FIX_KEY, REPORT_KEY = f"{OWN_KEYS}fix", f"{OWN_KEYS}report"
RADIO_KEYS = ("**", "**/@adv/**")
"""Key expressions that cross the radio if `radio.keys` is left out: `**` has no keys with a part such as `@adv`."""
