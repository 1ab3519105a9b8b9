"""Inputs of the radio besides positions: links and buildings from files, antennas of roadside units."""

from __future__ import annotations

from dataclasses import dataclass

from emulator.scenario.program import RoadsideUnit
from emulator.scenario.scenario import Scenario
from emulator.world.buildings import Buildings
from emulator.world.link_table import LinkTable
from emulator.world.projection import Frame
from vnet.errors import ScenarioError
from vnet.types import Array, Mask


@dataclass(frozen=True, eq=False)
class RadioInputs:
    """Inputs of the radio; None where a scenario has none.

    `links` is `radio.links`: a table, or a matrix (N, N) whose entry (i, j) is true if i receives j. `buildings`
    are those of `[radio.buildings]`, as far as they are near nodes. `units` are the last nodes.
    """

    links: Mask | LinkTable | None = None
    buildings: Buildings | None = None
    units: tuple[RoadsideUnit, ...] = ()


def load_buildings(scenario: Scenario, frame: Frame | None, area_m: Array) -> Buildings | None:
    """Return the buildings of a scenario that touch the box `area_m` (2, 2) of all vehicles; None without any.

    `frame` is that of the map's or the trips' metres, if it is known. Raise ScenarioError if they cannot be read.
    """
    section, roads = scenario.radio.buildings, scenario.map
    if section is None:
        return None
    from emulator.world.maps.outlines import read_buildings  # maps need much of scipy and are slow to import

    path = section.path if roads is None else section.path or roads.path
    assert path is not None

    def of_degrees() -> Frame:
        if section.origin_deg is not None:
            return Frame.around(*section.origin_deg)
        if frame is None:
            raise ScenarioError(
                f"{path}: in degrees, but nothing says where x = y = 0 m is: set radio.buildings.origin_deg"
            )
        return frame

    buildings = read_buildings(path, of_degrees)
    if roads is not None and path == roads.path:
        buildings = buildings.moved(roads.datum_m)
    return buildings.touching(*area_m)
