"""Roadside units in the world: they stand behind all vehicles, and change nothing for these."""

from typing import Any

import numpy as np
import pytest

from emulator.scenario.scenario import Scenario
from emulator.world.world import World, build_world
from vnet.errors import ScenarioError

UNITS: list[dict[str, Any]] = [{"position_m": [10.0, -20.0]}, {"position_m": [900.0, 5.0], "id": "gate"}]


def world_of(network: dict[str, Any], units: list[dict[str, Any]]) -> World:
    run = {"duration_s": 2.0, "settle_s": 0.0}
    return build_world(Scenario.model_validate({"run": run, "network": network, "roadside": units}))


@pytest.mark.slow
@pytest.mark.parametrize(
    "network", [{"vehicles": 4}, {"kind": "city", "vehicles": 3}, {"kind": "driven", "vehicles": 3}]
)
def test_units_are_the_last_nodes_and_leave_vehicles_as_they_were(network: dict[str, Any]) -> None:
    alone, world = world_of(network, []), world_of(network, UNITS)
    vehicles = len(alone.node_ids)
    assert world.node_ids == (*alone.node_ids, "rsu01", "gate")
    with_units, without = world.at(0), alone.at(0)
    assert np.array_equal(with_units.position_m[:vehicles], without.position_m)
    assert np.array_equal(with_units.fix_m[:vehicles], without.fix_m)
    assert with_units.position_m[vehicles:].tolist() == [[10.0, -20.0], [900.0, 5.0]]
    fix = world.fix(0, vehicles)
    assert fix.heading_rad is None and fix.speed_m_s is not None and fix.speed_m_s < 1
    error_m = fix.position_m - with_units.position_m[vehicles] - with_units.common_error_m
    assert 0 < np.linalg.norm(error_m) < 6


def test_a_unit_has_no_vehicles_name() -> None:
    with pytest.raises(ScenarioError, match=r"roadside.0.id = 'v01': a vehicle has this name"):
        world_of({"vehicles": 2}, [{"position_m": [0, 0], "id": "v01"}])
