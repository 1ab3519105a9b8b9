"""The world: truth and fixes have the statistics that the scenario asks for, and every vehicle its own streams."""

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from emulator.scenario.scenario import Scenario
from emulator.world.neighbours import Links, components_of_links, links_within
from emulator.world.world import World, build_world, components
from vnet.errors import ScenarioError
from vnet.roads.lanes import LaneMap
from vnet.types import Mask

HALF_WIDTH_M = 0.85


def scenario(**sections: dict[str, Any]) -> Scenario:
    return Scenario.model_validate({"network": {"vehicles": 10}, **sections})


def lateral_m(world: World) -> np.ndarray:
    """(K, N): signed offsets of all vehicles from their lanes' centre lines, from the truth alone."""
    lanes = world.lane_map
    assert isinstance(lanes, LaneMap)
    return np.array([lanes.signed_offset_m(world.at(k).position_m, world.lane_of) for k in range(world.periods)])


def correlation(series: np.ndarray, lag: int) -> float:
    """Correlation of a series of mean 0 with itself `lag` rows later."""
    return float(np.mean(series[lag:] * series[:-lag]) / np.mean(series**2))


# The common error.


def common_error_m(sigma_m: float, tau_s: float, duration_s: float, seed: int = 1) -> np.ndarray:
    world = build_world(
        scenario(
            run={"duration_s": duration_s, "seed": seed},
            network={"vehicles": 1},
            world={"common_error": {"sigma_m": sigma_m, "tau_s": tau_s}},
        )
    )
    return np.array([world.at(k).common_error_m for k in range(world.periods)])


@pytest.mark.slow
def test_the_common_error_has_its_deviation_and_forgets_at_its_rate() -> None:
    error_m = common_error_m(sigma_m=2.0, tau_s=5.0, duration_s=4000)
    assert error_m.std(axis=0) == pytest.approx([2.0, 2.0], rel=0.1)
    for after_s in (1, 5, 10):
        assert correlation(error_m, after_s * 10) == pytest.approx(math.exp(-after_s / 5), abs=0.06)
    east, north = error_m.T
    assert abs(np.mean(east * north)) < 0.1 * 4, "east and north are independent"


@pytest.mark.slow
def test_the_common_error_is_stationary_from_the_first_period_on() -> None:
    """Over many seeds the first period is spread like the last, even where the run is short against tau."""
    ends = np.array([common_error_m(3.0, 600.0, 1.0, seed)[[0, -1]] for seed in range(150)])
    assert ends.std(axis=(0, 2)) == pytest.approx([3.0, 3.0], rel=0.15)
    drift_m = ends[:, 1] - ends[:, 0]
    assert drift_m.std() == pytest.approx(3 * math.sqrt(2 * (1 - math.exp(-1 / 600))), rel=0.15)


def test_all_vehicles_share_the_common_error() -> None:
    world = build_world(scenario(world={"gnss": {"sigma_m": 0}}))
    for period in (0, 10, 100):
        instant = world.at(period)
        assert instant.fix_m - instant.position_m == pytest.approx(np.tile(instant.common_error_m, (10, 1)))
        assert np.abs(instant.common_error_m).max() > 0


# The receivers' noise.


@pytest.mark.slow
def test_receiver_noise_is_white_and_each_vehicles_own() -> None:
    world = build_world(scenario(run={"duration_s": 500}, world={"gnss": {"sigma_m": 0.5}}))
    instants = [world.at(k) for k in range(world.periods)]
    noise_m = np.array([i.fix_m - i.position_m - i.common_error_m for i in instants]).reshape(len(instants), 20)
    assert noise_m.std(axis=0) == pytest.approx(np.full(20, 0.5), rel=0.06)
    assert np.abs(noise_m.mean(axis=0)).max() < 0.035
    assert np.abs(np.corrcoef(noise_m.T) - np.eye(20)).max() < 0.075, "vehicles and axes are independent"
    assert abs(correlation(noise_m, 1)) < 0.02, "periods are independent"


def test_headings_are_noisy_by_what_the_scenario_says() -> None:
    world = build_world(scenario(run={"duration_s": 300}, world={"gnss": {"heading_sigma_rad": 0.05}}))
    instants = [world.at(k) for k in range(world.periods)]
    headings = np.array([i.fix_heading_rad for i in instants])
    assert headings.min() >= 0
    assert headings.max() <= 2 * np.pi
    error = np.mod(headings - np.array([i.heading_rad for i in instants]) + np.pi, 2 * np.pi) - np.pi
    assert error.std(axis=0) == pytest.approx(np.full(10, 0.05), rel=0.1)
    assert np.abs(error.mean(axis=0)).max() < 0.005
    assert abs(correlation(error, 1)) < 0.05


def test_without_a_heading_there_is_none() -> None:
    world = build_world(scenario(world={"gnss": {"heading": False}}))
    assert world.fix(0, 0).heading_rad is None
    assert np.isnan(world.at(0).fix_heading_rad).all()
    assert np.isfinite(world.at(0).heading_rad).all(), "the truth has one all the same"


@pytest.mark.parametrize("heading", [True, False])
def test_a_fix_is_what_the_instant_says_to_the_last_bit(heading: bool) -> None:
    world = build_world(scenario(world={"gnss": {"sigma_m": 0.7, "heading": heading}}))
    for period in (0, 7, world.periods - 1):
        instant = world.at(period)
        assert instant.period == period
        assert instant.time_ns == period * world.period_ns
        for node in range(10):
            fix = world.fix(period, node)
            assert np.array_equal(fix.position_m, instant.fix_m[node])
            assert fix.time_ns == instant.time_ns
            assert fix.covariance_m2 == pytest.approx(0.49 * np.eye(2))
            assert (fix.heading_rad == instant.fix_heading_rad[node]) == heading


# The lateral offset.


@pytest.mark.slow
def test_vehicles_stay_inside_their_lanes() -> None:
    offsets_m = lateral_m(build_world(scenario(run={"duration_s": 300})))
    assert np.abs(offsets_m).max() <= HALF_WIDTH_M + 1e-6
    assert 0.3 < offsets_m.std() < 0.4, "0.4 m, less what the reflection takes"
    assert np.abs(np.diff(offsets_m, axis=0)).max() < 0.25, "no jumps"


@pytest.mark.slow
def test_vehicles_are_reflected_and_do_not_stick() -> None:
    """The offset is uniform over a narrow lane, up to its edge, if the process is wide."""
    narrow = {"lateral": {"half_width_m": 0.5, "sigma_m": 5.0, "tau_s": 10.0}}
    offsets_m = lateral_m(build_world(scenario(run={"duration_s": 300}, world=narrow)))
    assert np.abs(offsets_m).max() <= 0.5 + 1e-6
    shares = np.histogram(offsets_m, bins=10, range=(-0.5, 0.5))[0] / offsets_m.size
    assert shares == pytest.approx(np.full(10, 0.1), abs=0.02)
    assert np.mean(np.abs(offsets_m) > 0.5 - 1e-6) < 1e-3, "a clipped process would sit at the edge"


@pytest.mark.slow
def test_in_a_wide_lane_the_offset_is_stationary_and_forgets_at_its_rate() -> None:
    wide = {"lateral": {"half_width_m": 50.0, "sigma_m": 0.4, "tau_s": 4.0}}
    offsets_m = lateral_m(build_world(scenario(run={"duration_s": 1000}, world=wide)))
    assert offsets_m.std(axis=0).mean() == pytest.approx(0.4, rel=0.05)
    assert correlation(offsets_m, 40) == pytest.approx(math.exp(-1), abs=0.06)
    assert np.abs(np.corrcoef(offsets_m.T) - np.eye(10)).max() < 0.4, "each vehicle strays by itself"


@pytest.mark.slow
def test_the_offset_is_stationary_from_the_first_period_on() -> None:
    world = build_world(scenario(run={"duration_s": 0.5}, network={"vehicles": 1000}))
    offsets_m = lateral_m(world)
    assert offsets_m[0].std() == pytest.approx(offsets_m[-1].std(), rel=0.05)
    assert 0.34 < offsets_m[0].std() < 0.4
    assert np.abs(offsets_m[-1] - offsets_m[0]).max() < 0.6


def test_vehicles_stand_on_their_lanes_but_for_the_offset() -> None:
    world = build_world(scenario(run={"duration_s": 5}))
    point_m, heading = world.lane_map.point_m[world.lane_of], world.lane_map.heading_rad[world.lane_of]
    direction = np.column_stack([np.cos(heading), np.sin(heading)])
    for period in (0, 20, 50):
        along_m = np.sum((world.at(period).position_m - point_m) * direction, axis=1)
        assert along_m == pytest.approx(np.zeros(10), abs=1e-6)
        assert np.array_equal(world.at(period).heading_rad, heading)


# Streams.


def from_rows(folder: Path, count: int, **sections: dict[str, Any]) -> World:
    """A world of the first `count` of six vehicles, from a file."""
    rows = [f"v{i},{i * 100},0,0.5" for i in range(6)]
    path = folder / f"{count}.csv"
    path.write_text("id,x_m,y_m,heading_rad\n" + "\n".join(rows[:count]) + "\n")
    return build_world(scenario(network={"kind": "file", "path": str(path)}, **sections))


def test_one_more_vehicle_changes_no_errors_of_others(tmp_path: Path) -> None:
    few_world, many_world = from_rows(tmp_path, 5), from_rows(tmp_path, 6)
    for period in (0, 50, 200):
        few, many = few_world.at(period), many_world.at(period)
        assert np.array_equal(few.position_m, many.position_m[:5])
        assert np.array_equal(few.fix_m, many.fix_m[:5])
        assert np.array_equal(few.fix_heading_rad, many.fix_heading_rad[:5])
        assert np.array_equal(few.common_error_m, many.common_error_m)


def test_a_longer_run_begins_like_a_shorter_one(tmp_path: Path) -> None:
    short, long = (from_rows(tmp_path, 6, run={"duration_s": seconds}) for seconds in (2, 4))
    for period in range(short.periods):
        assert np.array_equal(short.at(period).fix_m, long.at(period).fix_m)


def test_the_same_seed_gives_the_same_world_and_another_one_shares_nothing() -> None:
    one, same, other = (build_world(scenario(run={"seed": seed})).at(5) for seed in (3, 3, 4))
    assert np.array_equal(one.fix_m, same.fix_m)
    assert np.array_equal(one.fix_heading_rad, same.fix_heading_rad)
    assert not np.isclose(one.common_error_m, other.common_error_m).any()
    assert not np.isclose(one.position_m, other.position_m, rtol=0, atol=1e-9).all(axis=1).any()
    assert np.array_equal(one.heading_rad, other.heading_rad), "the network has a seed of its own"


@pytest.mark.parametrize(
    ("duration_s", "rate_hz", "periods"), [(10, 10, 101), (0.25, 10, 4), (0.05, 10, 2), (1, 3, 5)]
)
def test_periods_cover_the_run_and_its_end(duration_s: float, rate_hz: float, periods: int) -> None:
    """The last period starts at the end of the run or after it; a third of a second is rounded down."""
    world = build_world(scenario(run={"duration_s": duration_s}, world={"gnss": {"rate_hz": rate_hz}}))
    assert world.periods == periods
    assert world.at(periods - 2).time_ns < duration_s * 1e9 <= world.at(periods - 1).time_ns


# The map.


@pytest.mark.slow
def test_the_map_holds_every_lane_and_no_label() -> None:
    world = build_world(scenario(network={"vehicles": 38}))
    assert len(world.lane_map) == 38
    assert world.lane_map.half_width_m == HALF_WIDTH_M
    assert sorted(world.lane_of.tolist()) == list(range(38)), "to each vehicle a lane"
    assert np.array_equal(world.lane_map.heading_rad[world.lane_of], world.at(0).heading_rad)
    assert np.mean(world.lane_of == np.arange(38)) < 0.2, "the order reveals no lanes"
    names = set(vars(world.lane_map))
    assert names == {"point_m", "heading_rad", "half_width_m"}


def test_another_seed_shuffles_the_map_in_another_way() -> None:
    one, other = (build_world(scenario(run={"seed": seed})).lane_of.tolist() for seed in (1, 2))
    assert one != other


# Components.


def test_components_of_a_chain_and_its_gap() -> None:
    """Links reach `range_m` and no further, and go from one to the next."""
    position_m = np.array([[0, 0], [300, 0], [100, 0], [200, 0], [400.001, 0], [300, 100]])
    labels = components(position_m, links_within(position_m, 100.0))
    assert len(set(labels[[0, 1, 2, 3, 5]])) == 1
    assert labels[4] not in labels[[0, 1, 2, 3, 5]]
    assert len(set(components(position_m, links_within(position_m, 99.9)))) == 6
    assert set(components(position_m, links_within(position_m, 500.0))) == {0}


@pytest.mark.slow
@given(
    cells=st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), min_size=1, max_size=25),
    range_m=st.sampled_from([0.5, 1.0, 1.5, 3.0]),
)
def test_components_are_those_found_by_merging(cells: list[tuple[int, int]], range_m: float) -> None:
    label = list(range(len(cells)))
    for i, one in enumerate(cells):
        for j, other in enumerate(cells):
            if math.dist(one, other) <= range_m:
                old, new = label[i], label[j]
                label = [new if entry == old else entry for entry in label]
    position_m = np.array(cells, dtype=float)
    found = components(position_m, links_within(position_m, range_m))
    assert len(set(zip(label, found.tolist(), strict=True))) == len(set(label)) == len(set(found.tolist()))


def test_components_of_a_matrix_are_connected_by_links_of_either_direction() -> None:
    links = np.zeros((5, 5), dtype=bool)
    links[0, 1] = links[2, 1] = links[3, 4] = True
    labels = components(np.zeros((5, 2)), Links.of_matrix(links, np.zeros((5, 2)))).tolist()
    assert labels[0] == labels[1] == labels[2] != labels[3] == labels[4]


def test_an_exception_for_a_vehicle_that_is_not_there_is_refused() -> None:
    program = {"exceptions": [{"nodes": ["nobody"], "entry": "agents.beacon:main"}]}
    with pytest.raises(ScenarioError, match="'nobody': no such vehicle; the network has "):
        build_world(Scenario.model_validate({"network": {"vehicles": 3}, "program": program}))


def test_the_name_of_a_vehicle_is_one_object_in_the_run_and_at_its_program() -> None:
    assert build_world(scenario()).node_ids[0] is sys.intern("v01")


def numbered(linked: Mask) -> list[int]:
    sender, receiver = np.nonzero(linked)
    return components_of_links(sender, receiver, len(linked)).tolist()


@pytest.mark.parametrize("seed", range(20))
def test_components_of_random_graphs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 60))
    linked = rng.random((count, count)) < rng.choice([0.0, 0.5, 1.0, 2.0]) / count
    assert numbered(linked) == connected_components(linked, directed=False)[1].tolist()


def test_no_nodes_have_no_components() -> None:
    assert numbered(np.zeros((0, 0), dtype=bool)) == []


def test_a_link_in_one_direction_connects() -> None:
    linked = np.zeros((4, 4), dtype=bool)
    linked[2, 0] = linked[3, 2] = True
    assert numbered(linked) == [0, 1, 0, 0]


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
