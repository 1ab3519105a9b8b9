"""Costs of a run, by vehicle."""

from collections import Counter
from dataclasses import asdict

import numpy as np

from emulator.records.costs import Costs, PayloadSizes, read_cost, run_cost

NODES = ["v01", "v02", "v03"]


def test_the_slowest_vehicle_comes_first() -> None:
    costs = Costs("program", {"v01": 10**9, "v02": 3 * 10**9}, Counter(v01=4, v02=5, v03=6))
    cost = run_cost(costs, NODES, np.array([2, 0, 2]), np.array([10, 300, 30]))
    assert [vehicle.node for vehicle in cost.vehicles] == ["v02", "v01", "v03"]
    assert (cost.measured, cost.cpu_s, cost.wake_ups) == ("program", 4.0, 15)
    assert [vehicle.payload.frames for vehicle in cost.vehicles] == [0, 1, 2]
    assert cost.vehicles[2].payload == PayloadSizes(2, 20.0, 29.0, 30)
    assert cost.vehicles[2].words() == ["v03", "", "6", "2", "20", "29", "30"]
    assert cost.line() == (
        "programs 4.00 s of CPU time, most by v02: 3.00 s; wake-ups 15; payloads 113 bytes (95 %: 273, most: 300)"
    )
    assert read_cost(asdict(cost)) == cost


def test_what_was_not_measured_is_not_told() -> None:
    none = np.array([], dtype=np.int32)
    cost = run_cost(Costs(), NODES, none, none)
    assert (cost.cpu_s, cost.wake_ups, cost.line()) == (None, None, "")
    assert cost.vehicles[0].words() == ["v01", "", "", "0", "", "", ""]


def test_only_the_slowest_are_listed() -> None:
    costs = Costs("process", {"v03": 1})
    none = np.array([], dtype=np.int32)
    cost = run_cost(costs, NODES, none, none, most=1)
    assert [vehicle.node for vehicle in cost.vehicles] == ["v03"]
    assert cost.measured == "process"
