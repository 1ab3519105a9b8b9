"""Choices of a program for a frame: power, bit rate and addressee."""

from __future__ import annotations

import math
from typing import NamedTuple

from emulator.radio.frames import BROADCAST
from emulator.radio.propagation import DIGITS
from emulator.scenario.radio import RATES_MBPS
from emulator.scenario.scenario import Radio
from vnet.radio import MIN_POWER_DBM, SendOptions


class Choices(NamedTuple):
    """Power of a frame above its sender's largest in dB, bit rate in Mbit/s, addressee, and the sender's ticket."""

    gain_db: float
    bitrate_mbps: float
    to: int = BROADCAST
    ticket: int = 0


def allowed_choices(radio: Radio, options: SendOptions, largest_dbm: float | None) -> Choices:
    """Return the power and the bit rate that a program has chosen for a frame, as far as the radio has them.

    `largest_dbm` is the sender's largest power, None without a path loss.
    """
    gain_db, bitrate_mbps = 0.0, radio.bitrate_mbps
    if options.power_dbm is not None and largest_dbm is not None and math.isfinite(options.power_dbm):
        power_dbm = max(options.power_dbm, MIN_POWER_DBM)
        gain_db = round(min(power_dbm - largest_dbm, 0.0), DIGITS)
    if radio.is_physical and options.rate_mbps in RATES_MBPS:
        bitrate_mbps = float(options.rate_mbps or bitrate_mbps)
    return Choices(gain_db, bitrate_mbps)
