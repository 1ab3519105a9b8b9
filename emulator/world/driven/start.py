"""Start of driven vehicles: their road, positions along it, and lanes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from emulator.scenario.network import Driven
from emulator.world.driven.road import Ints, Road, SingleRoad
from vnet.counted import counted
from vnet.errors import ScenarioError
from vnet.types import Array


@dataclass(frozen=True)
class Start:
    """The roads, and the position (N,) along its way and the lane (N,) of each vehicle at time 0."""

    road: Road
    along_m: Array
    lane: Ints


def start_on_single_road(driven: Driven, count: int) -> Start:
    """Return where `count` vehicles are on a straight road or a ring. Raise ScenarioError if there is no room."""
    lane = start_lanes(driven, count)
    along_m = start_positions_m(driven, lane)
    road = SingleRoad(driven.length_m, driven.lanes, driven.lane_width_m, driven.road == "ring")
    return Start(road, along_m, lane)


def start_lanes(driven: Driven, count: int) -> Ints:
    """Return the lane (N,) of each vehicle on a single road. Raise ScenarioError unless each has one."""
    if driven.start_lanes is None:
        return np.arange(count) % driven.lanes
    return np.array(one_each("start_lanes", driven.start_lanes, count), dtype=np.intp)


def start_positions_m(driven: Driven, lane: Ints) -> Array:
    """Return the positions (N,) along the road at the start, in m. Raise ScenarioError if there is no room."""
    if driven.start_m is not None:
        return np.array(one_each("start_m", driven.start_m, len(lane)))
    check_room(driven, lane, driven.length_m, f"the road has length_m = {driven.length_m:g}")
    return queue_m(driven, lane)


def check_room(driven: Driven, lane: Ints, length_m: float, has: str) -> None:
    """Raise ScenarioError, which says what the road `has`, if a queue in these lanes is longer than the road."""
    rows = int(np.bincount(lane).max())
    needed_m = rows * (driven.gap_m + driven.vehicle_length_m)
    if needed_m > length_m:
        raise ScenarioError(
            f"network.driven: {rows} vehicles a lane with gap_m = {driven.gap_m:g} take {needed_m:g} m: {has}"
        )


def queue_m(driven: Driven, lane: Ints) -> Array:
    """Return positions (N,) in m of vehicles one behind the other in their lanes (N,), the first ahead."""
    row = np.zeros(len(lane), dtype=np.int64)
    for each in range(int(lane.max()) + 1):
        row[lane == each] = np.arange(int((lane == each).sum()))
    step_m = driven.gap_m + driven.vehicle_length_m
    return np.asarray((int(row.max()) - row) * step_m + driven.vehicle_length_m / 2)


def one_each(name: str, values: Sequence[Any], count: int) -> Sequence[Any]:
    """Return `values`. Raise ScenarioError, naming the key, unless there are `count` of them."""
    if len(values) != count:
        numbers = f"{counted(len(values), 'value')} for {counted(count, 'vehicle')}"
        raise ScenarioError(f"network.driven.{name}: {numbers}: give one each")
    return values
