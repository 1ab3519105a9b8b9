"""A simulation's garbage collections grow with its periods, and not with its vehicles besides."""

import gc
from collections import Counter

import pytest

from emulator.drivers.simulate import OBJECTS_A_VEHICLE, rare_collections
from tests.support.multi_loop_driver import run_together, scenario_of


@pytest.mark.parametrize("threshold", [(700, 10, 10), (0, 10, 10), (10**6, 5, 5)])
def test_the_threshold_is_raised_and_put_back(threshold: tuple[int, int, int]) -> None:
    before = gc.get_threshold()
    gc.set_threshold(*threshold)
    try:
        with pytest.raises(KeyError), rare_collections(500):
            raised = OBJECTS_A_VEHICLE * 500 if threshold[0] == 700 else threshold[0]
            assert gc.get_threshold() == (raised, *threshold[1:])
            raise KeyError
        assert gc.get_threshold() == threshold
    finally:
        gc.set_threshold(*before)


@pytest.mark.slow
def test_collections_of_a_period_do_not_grow_with_the_vehicles() -> None:
    counted: Counter[int] = Counter()
    vehicles = 0

    def count(phase: str, info: dict[str, int]) -> None:
        counted[vehicles] += phase == "start"

    gc.callbacks.append(count)
    try:
        for vehicles in (10, 60):
            run_together(scenario_of([], "agents.beacon:main", vehicles, radio={"range_m": 3000.0}))
    finally:
        gc.callbacks.remove(count)
    assert counted[60] < 3 * counted[10] + 10
