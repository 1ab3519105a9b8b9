"""Cooperative adaptive cruise control (CACC) of a platoon: docs/how-to/platoon.md.

The control law is that of Ploeg et al., Design and experimental evaluation of cooperative adaptive cruise control
(ITSC 2011): a vehicle keeps the gap `standstill_m` + `headway_s` · speed by its radar, and adds what it hears that
the vehicle ahead has asked of itself.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from vnet import Node
from vnet.node import Fix
from vnet.units import NS_PER_S


@dataclass(frozen=True)
class Options:
    """Options of the program: gains and headway, the vehicle's lag, and how long an old packet is of use."""

    headway_s: float = 0.5
    standstill_m: float = 5.0
    gap_gain: float = 0.2
    rate_gain: float = 0.7
    lag_s: float = 0.1
    forget_s: float = 1.0
    cruise_m_s: float = 20.0


class Controller:
    """The law of a follower: `acceleration` is what it asks for, in m/s²."""

    def __init__(self, options: Options, step_s: float) -> None:
        self._options = options
        self._step_s = step_s
        self._own_m_s2 = 0.0  # of the vehicle, as its lag makes it of what was asked for
        self.acceleration = 0.0

    def step(self, fix: Fix, ahead_m_s2: float) -> None:
        """Take a fix, and what the vehicle ahead asks of itself."""
        options = self._options
        if fix.gap_m is None or fix.gap_rate_m_s is None or fix.speed_m_s is None:
            return
        error_m = fix.gap_m - options.standstill_m - options.headway_s * fix.speed_m_s
        rate_m_s = fix.gap_rate_m_s - options.headway_s * self._own_m_s2
        wished = options.gap_gain * error_m + options.rate_gain * rate_m_s + ahead_m_s2
        keep = math.exp(-self._step_s / options.headway_s)
        self.acceleration = keep * self.acceleration + (1 - keep) * wished
        own = math.exp(-self._step_s / options.lag_s)
        self._own_m_s2 = own * self._own_m_s2 + (1 - own) * self.acceleration


async def main(node: Node) -> None:
    """Drive: the first vehicle brakes and accelerates again, the others follow."""
    options = Options(**node.options)
    controller = Controller(options, node.period_ns / NS_PER_S)
    width = len(node.id) - 1
    first, ahead = f"v{1:0{width}d}", f"v{int(node.id[1:]) - 1:0{width}d}"
    heard_m_s2, heard_ns = 0.0, -NS_PER_S * 3600
    async for fix in node.gnss:
        for packet in node.radio.drain():
            if packet.sender == ahead:
                (heard_m_s2,), heard_ns = struct.unpack("d", packet.payload), packet.sent_ns
        is_fresh = node.now_ns - heard_ns < options.forget_s * NS_PER_S
        if node.id == first:
            controller.acceleration = disturbance(fix, options)
        else:
            controller.step(fix, heard_m_s2 if is_fresh else 0.0)
        node.drive(controller.acceleration)
        await node.radio.broadcast(struct.pack("d", controller.acceleration))
        if fix.gap_m is not None:
            node.report(gap_m=fix.gap_m, is_fresh=is_fresh)


def disturbance(fix: Fix, options: Options) -> float:
    """Return what the first vehicle asks for: it brakes for 2 s, goes on so for 2 s, and accelerates for 2 s."""
    time_s = fix.time_ns / NS_PER_S - 10
    if 0 <= time_s < 2:
        return -2.0
    if 4 <= time_s < 6:
        return 2.0
    return 0.0
