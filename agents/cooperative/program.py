"""Decentralized cooperative map matching: the periods of a vehicle.

At each fix a vehicle

1. waits for its slot and broadcasts once, with what it knows by then: so a fix may be relayed several times within
   the period;
2. listens until the period is nearly over;
3. filters all fixes that have come, does one round of mean consensus, fuses with its neighbours, and reports.

`estimator` is what it knows and computes.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from typing import Any

import numpy as np

from agents.cooperative.estimator import Estimator, usable
from agents.cooperative.frame import NAME_BYTES
from agents.cooperative.information_estimator import InformationEstimator
from agents.cooperative.options import Options
from vnet import Fix, Node
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array
from vnet.units import NS_PER_S

SENDING_SHARE = 0.7
"""Share of the period in which the slots are."""
LISTENING_SHARE = 0.7
"""Share of the period before which nobody computes: frames take less time than the rest of it."""
GRACE_SHARE = 0.15
"""Share of the period between the last slot and the first computation, if there are many slots."""
TURNS_SHARE = 0.9
"""Share of the period by which the last turn computes: many on one processor must be done by the next fix."""
TURNS = 4
"""Number of turns in which vehicles compute, so that many on one processor do not delay each other's reception."""
REPORTING_SHARE = 0.97
"""Share of the period at which a vehicle reads the second frames, with `two_frames`."""
CLOUD_REPORT_PARTICLES = 50
"""Number of particles in a report: enough to draw a cloud."""


async def main(node: Node) -> None:
    """Cooperate until the run ends."""
    options = Options.parse(node.options)
    kind = InformationEstimator if options.exchange == "information" else Estimator
    await cooperate(node, options, kind(node.id, options, node.map, node.rng, node.period_ns))


async def cooperate(node: Node, options: Options, estimator: Estimator | InformationEstimator) -> None:
    """Run the vehicle's loop around its `estimator`, until the run ends."""
    slot = int(node.rng.integers(options.slots))
    slot_ns = slot * round(SENDING_SHARE * node.period_ns) // options.slots
    listening_ns = round(listening_share(estimator.name, options) * node.period_ns)
    clock = GnssClock(node)
    async for fix in node.gnss:
        # After a pause a vehicle goes on from the newest fix: nobody needs what it saw meanwhile.
        fix = (node.gnss.drain() or [fix])[-1]
        clock.set_by(fix)

        await clock.sleep_until(fix.time_ns + slot_ns)
        if options.exchange == "particles":  # whose frames have what the vehicle has just heard
            estimator.read(node.radio.drain(), clock.now_ns)
        payload_bytes = await _broadcast(node, estimator, fix)

        await clock.sleep_until(fix.time_ns + listening_ns)
        packets = node.radio.drain()
        estimator.read(packets, clock.now_ns)

        estimator.filter(fix)
        if options.sends_twice and await _broadcast(node, estimator, fix):
            await clock.sleep_until(fix.time_ns + round(REPORTING_SHARE * node.period_ns))
            estimator.read(node.radio.drain(), clock.now_ns)
        estimator.agree()
        _report(node, estimator, fix, {"heard": len(packets), "bytes": payload_bytes})


async def _broadcast(node: Node, estimator: Estimator | InformationEstimator, fix: Fix) -> int:
    """Broadcast the estimator's frame; returns its size in bytes, 0 if the fix cannot be sent."""
    if not usable(fix):
        return 0
    payload = estimator.frame(fix, node.radio.max_payload)
    await node.radio.broadcast(payload)
    return len(payload)


def listening_share(name: str, options: Options) -> float:
    """Share of the period at which a vehicle stops listening and computes, by its short name.

    A few turns and no more: in lockstep the vehicles of one turn compute side by side, one turn after the other.
    With `two_frames` all compute at once, because they are then to send again.
    """
    last_slot_share = SENDING_SHARE * (options.slots - 1) / options.slots
    first_share = max(LISTENING_SHARE, last_slot_share + GRACE_SHARE)
    turn = 0.0 if options.sends_twice else int(name, 16) * TURNS // 256**NAME_BYTES / TURNS
    return first_share + turn * (TURNS_SHARE - first_share)


def map_shift_m2(lanes: LaneMap | RoadMap) -> Array:
    """Return the covariance (2, 2) in m² of a shift of the whole map, which moves all that is found with it."""
    sigma_m = lanes.datum_sigma_m if isinstance(lanes, RoadMap) else 0.0
    return sigma_m**2 * np.eye(2)


def _report(node: Node, estimator: Estimator | InformationEstimator, fix: Fix, counts: dict[str, int]) -> None:
    """Report the position, the common error, and `counts` of the period.

    Once a second also the cloud, the fusion weights, and the number of rejections by reason.
    """
    position_m, covariance_m2 = estimator.position(fix)
    common_m, common_covariance_m2 = estimator.common_error
    if isinstance(node.map, RoadMap):
        # Nobody can tell a shift of the map from the common error: it is stated, and not exchanged.
        shift_m2 = map_shift_m2(node.map)
        covariance_m2, common_covariance_m2 = covariance_m2 + shift_m2, common_covariance_m2 + shift_m2
    values: dict[str, Any] = {
        "common_error_m": common_m,
        "common_error_covariance_m2": common_covariance_m2,
        "stacked_common_error_m": estimator.fused_m,
        "heard": counts["heard"],
        "imported": estimator.imported,
        "bytes": counts["bytes"],
        "rejected": estimator.rejected.total(),
    }
    mean_m = estimator.mean_m
    if mean_m is not None:
        values["mean_m"] = mean_m
    if (fix.time_ns // node.period_ns) % max(1, NS_PER_S // node.period_ns) == 0:
        values["cloud_m"] = estimator.sample(CLOUD_REPORT_PARTICLES)
        values |= {f"weight.{other}": weight for other, weight in estimator.weights.items()}
        values |= {f"rejected.{reason}": count for reason, count in estimator.rejected.items()}
    if math.isfinite(sum(position_m.tolist())):
        node.report(position_m, covariance_m2, **values)
    else:
        node.report(**values)


CLOCK_FIXES = 10
"""Number of fixes by which the clock is judged: after it has jumped ahead it is wrong for so long."""


class GnssClock:
    """GNSS time of a node.

    A fix is received at its time or later: the least that the clock was ahead of the last fixes is its error.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._ahead_ns: deque[int] = deque(maxlen=CLOCK_FIXES)

    def set_by(self, fix: Fix) -> None:
        """Take note of a fix that has just come."""
        self._ahead_ns.append(self._node.now_ns - fix.time_ns)

    @property
    def now_ns(self) -> int:
        """GNSS time in nanoseconds."""
        return self._node.now_ns - min(self._ahead_ns)

    async def sleep_until(self, time_ns: int) -> None:
        """Sleep until this GNSS time."""
        if (left_ns := time_ns - self.now_ns) > 0:
            await asyncio.sleep(left_ns / NS_PER_S)
