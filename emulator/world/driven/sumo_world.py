"""The world of a SUMO that is stepped with the run: some of its vehicles have programs, and the others react."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from emulator.scenario.network import Sumo, control_step_ns, node_id
from emulator.scenario.scenario import Scenario
from emulator.world.driven.background import Background
from emulator.world.driven.stepped import SteppedWorld
from emulator.world.driven.sumo_client import require_libsumo
from emulator.world.driven.sumo_messages import Begun
from emulator.world.driven.sumo_start import start_sumo
from emulator.world.driven.sumo_vehicles import SumoVehicles
from emulator.world.projection import Frame
from vnet.errors import ScenarioError, first_names, shown
from vnet.node import Fix
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array

TRAFFIC_LIGHTS = "traffic_lights"
"""Name of the reading of a node that is told the traffic lights."""


class SumoWorld(SteppedWorld):
    """A world whose `vehicles` drive in SUMO, the rest of whose traffic has no radio and no program."""

    vehicles: SumoVehicles
    background: Background

    def __init__(self, scenario: Scenario) -> None:
        path, sumo = scenario.network.path, scenario.network.sumo or Sumo()
        assert path is not None
        require_libsumo(path)
        step_ns = control_step_ns(scenario.run.control_hz)
        self._process, begun, sumo_ids = start_sumo(scenario, path, step_ns)
        ranging = scenario.world.ranging
        range_m = None if ranging is None else ranging.range_m
        self.vehicles = SumoVehicles(self._process, sumo_ids, step_ns, range_m, bool(sumo.lights_to))
        self.versions = {"sumo": begun.version}
        self._corners_m = np.array(begun.boundary_m)
        self._lights_of: dict[int, dict[str, str]] = {}  # by period
        self.background = Background()
        lanes, frame, notes = _lanes(scenario, begun)
        super().__init__(scenario, tuple(map(node_id, sumo_ids)), lanes, notes, frame)
        self._see_lights = frozenset(sumo.lights_to)
        if unknown := [node for node in sumo.lights_to if node not in self.node_ids]:
            some = first_names(self.node_ids)
            raise ScenarioError(f"network.sumo.lights_to = {shown(unknown[0])}: no such node; there are {some}")
        if scenario.run.nodes_per_process > 1:
            raise ScenarioError(
                f"run.nodes_per_process = {scenario.run.nodes_per_process}: must be 1 with network.step = true, "
                "where vehicles enter and leave"
            )

    @property
    def has_traffic(self) -> bool:
        """True: vehicles enter and leave as SUMO says."""
        return True

    @property
    def vehicle_area_m(self) -> Array:
        """Corners (2, 2) of SUMO's network."""
        return self._corners_m

    def next_control_ns(self) -> int | None:
        """Return the next control instant within the run, or None; none comes once SUMO has failed."""
        return None if self._process.has_failed else super().next_control_ns()

    def traffic_lights(self, period: int) -> dict[str, str]:
        """Return the state of each traffic light at the start of `period`, a letter for each of its links."""
        return dict(self._lights_of[period])

    def fix(self, period: int, node: int) -> Fix:
        """Return the fix of node number `node`, which must be present, with the traffic lights if it sees them."""
        fix = super().fix(period, node)
        if self.node_ids[node] not in self._see_lights:
            return fix
        return replace(fix, sensors={**fix.sensors, TRAFFIC_LIGHTS: self.traffic_lights(period)})

    def close(self) -> None:
        """End SUMO; the run is over."""
        self._process.close()

    def detach(self) -> None:
        """Close the pipes of a forked process, without which SUMO would not see the emulator close its own."""
        self._process.kill()  # in a fork it closes no more than these

    def _fill(self, period: int) -> None:
        super()._fill(period)
        self._lights_of[period] = self.vehicles.lights
        self.background.add(self.vehicles.now_ns, self.vehicles.others, self.vehicles.other_m)


def _lanes(scenario: Scenario, begun: Begun) -> tuple[LaneMap | RoadMap, Frame | None, tuple[str, ...]]:
    """Return the lanes that programs know, their frame, and notes about them: those of `[map]`, or none."""
    section = scenario.map
    if section is None:
        return LaneMap(np.zeros((0, 2)), np.zeros(0), scenario.world.lateral.half_width_m), None, ()
    # Maps need half of scipy, whose import takes longer than many a run.
    from emulator.world.maps.around import lanes_around, notes_of
    from emulator.world.maps.files import read_roads

    roads = read_roads(section.path, section.origin_deg)
    junctions_m = np.array(begun.junctions_m or begun.boundary_m, dtype=float)[None]
    return lanes_around(roads, section, junctions_m), roads.frame, notes_of(section.path, roads)
