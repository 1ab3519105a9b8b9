"""Roadside units in the truth of a run: nodes that stand, behind all vehicles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from emulator.scenario.program import RoadsideUnit
from emulator.world.trips.motion import Motion
from vnet.errors import ScenarioError, shown


def with_units(motion: Motion, units: Sequence[RoadsideUnit]) -> Motion:
    """Return the motion of vehicles and units. Raise ScenarioError for a unit that has a vehicle's name."""
    if not units:
        return motion
    names = tuple(unit.name for unit in units)
    for number, name in enumerate(names):
        if name in motion.node_ids:
            raise ScenarioError(f"roadside.{number}.id = {shown(name)}: a vehicle has this name")
    periods = len(motion.position_m)
    position_m = np.tile([unit.position_m for unit in units], (periods, 1, 1))
    return replace(
        motion,
        node_ids=(*motion.node_ids, *names),
        position_m=np.concatenate([motion.position_m, position_m], axis=1),
        heading_rad=np.concatenate([motion.heading_rad, np.full((periods, len(units)), np.nan)], axis=1),
    )
