"""The world of vehicles that their programs drive on a road or a map of the scenario's."""

from __future__ import annotations

import numpy as np

from emulator.scenario.network import control_step_ns
from emulator.scenario.scenario import Scenario
from emulator.world.driven.start import Start, start_on_single_road
from emulator.world.driven.stepped import SteppedWorld
from emulator.world.driven.vehicles import DrivenVehicles
from emulator.world.projection import Frame
from vnet.errors import ScenarioError
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array


class DrivenWorld(SteppedWorld):
    """A world of `vehicles` on a straight road, a ring or a map, where only programs drive."""

    vehicles: DrivenVehicles

    def __init__(self, scenario: Scenario) -> None:
        node_ids = _node_ids(scenario.network.vehicles)
        start, lanes, frame, notes = _start(scenario, len(node_ids))
        self.vehicles = DrivenVehicles(scenario.driven, node_ids, control_step_ns(scenario.run.control_hz), start)
        self._furthest_m = start.along_m + scenario.driven.max_speed_mps * scenario.run.duration_s
        super().__init__(scenario, node_ids, lanes, notes, frame)
        if scenario.run.nodes_per_process > 1 and self.may_leave:
            raise ScenarioError(
                f"run.nodes_per_process = {scenario.run.nodes_per_process}: must be 1 where vehicles may leave: "
                f"they may come to the end of the road, after {self.vehicles.road.end_m.min():g} m"
            )

    @property
    def may_leave(self) -> bool:
        """True if a vehicle may come to the end of the road."""
        return bool((self._furthest_m > self.vehicles.road.end_m).any())

    @property
    def has_traffic(self) -> bool:
        """True if vehicles may leave during the run."""
        return self.may_leave

    @property
    def vehicle_area_m(self) -> Array:
        """Corners (2, 2) of the box in which vehicles can be during the run."""
        return self.vehicles.road.area_m(self._furthest_m)


def _node_ids(vehicles: int) -> tuple[str, ...]:
    width = max(2, len(str(vehicles)))
    return tuple(f"v{number:0{width}d}" for number in range(1, vehicles + 1))


def _start(scenario: Scenario, count: int) -> tuple[Start, LaneMap | RoadMap, Frame | None, tuple[str, ...]]:
    """Return where vehicles are at the start, the lanes that programs know, their frame, and notes for the user."""
    if scenario.driven.road == "map":
        from emulator.world.driven.map_start import start_on_map  # maps need much of scipy and are slow to import

        found = start_on_map(scenario)
        return found.start, found.lanes, found.frame, found.notes
    start = start_on_single_road(scenario.driven, count)
    return start, _lane_map(scenario), None, ()


def _lane_map(scenario: Scenario) -> LaneMap:
    """Return the lanes that programs know: those of a straight road; of a ring none, as it is not straight."""
    driven, half_width_m = scenario.driven, scenario.world.lateral.half_width_m
    if driven.road == "ring":
        return LaneMap(np.zeros((0, 2)), np.zeros(0), half_width_m)
    point_m = np.column_stack([np.zeros(driven.lanes), np.arange(driven.lanes) * driven.lane_width_m])
    return LaneMap(point_m, np.zeros(driven.lanes), half_width_m)
