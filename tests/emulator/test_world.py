"""The world: networks like the published ones, and errors with the statistics that the scenario asks for."""

from pathlib import Path

import numpy as np
import pytest

from emulator.world.networks import generate_network, load_network
from emulator.world.world import build_world, components
from vnet.errors import ScenarioError
from vnet.scenario import Scenario, load_scenario

ROOT = Path(__file__).parents[2]
RANGE_M = 3000.0

# Sorted degrees and component sizes of the published networks at 3 km (zhao-lab/network-propagation, MIT).
PUBLISHED = {
    50: ("2 2 3 4 4 5 7 7 7 8 9 9 10 10 10 10 11 11 11 11 12 12 12 12 13 13 13 14 14 15 15 15 16 16 16 16 16 16 17 "
         "17 17 18 18 18 18 18 20 21 21 22", [50]),
    38: ("2 2 3 3 4 4 5 5 5 6 6 6 7 7 7 7 7 7 7 8 8 9 9 9 9 9 9 10 10 10 10 10 10 10 10 12 12 12", [38]),
    24: ("2 2 2 2 2 2 2 2 3 3 3 3 3 4 4 5 5 7 7 7 7 8 8 9", [3, 6, 15]),
}  # fmt: skip


def degrees(position_m: np.ndarray) -> np.ndarray:
    distance = np.linalg.norm(position_m[:, None] - position_m[None], axis=2)
    return (distance <= RANGE_M).sum(axis=0) - 1


@pytest.mark.parametrize("vehicles", [50, 38, 24])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_generated_networks_match_the_published_ones(vehicles: int, seed: int) -> None:
    network = generate_network("urban", vehicles, seed)
    published, sizes = PUBLISHED[vehicles]
    assert len(network.node_ids) == vehicles
    found = np.sort(degrees(network.position_m))
    assert np.abs(found - np.array(published.split(), dtype=int)).sum() <= 2
    assert sorted(np.bincount(components(network.position_m, RANGE_M)).tolist()) == sizes


def test_the_same_seed_gives_the_same_network_and_another_one_does_not() -> None:
    one, same, other = (generate_network("urban", 24, seed) for seed in (5, 5, 6))
    assert np.array_equal(one.position_m, same.position_m)
    assert np.array_equal(one.heading_rad, same.heading_rad)
    assert not np.array_equal(one.position_m, other.position_m)


@pytest.mark.parametrize("vehicles", [1, 2, 3, 10, 12, 70, 300])
def test_any_number_of_vehicles_can_be_had(vehicles: int) -> None:
    network = generate_network("urban", vehicles, 1)
    assert len(set(network.node_ids)) == vehicles
    assert network.position_m.shape == (vehicles, 2)
    if vehicles <= 70:
        assert len(np.unique(components(network.position_m, RANGE_M))) == 1


def test_the_dense_scenario_exercises_the_cap() -> None:
    world = build_world(load_scenario(ROOT / "scenarios" / "dense.toml"))
    assert (degrees(world.at(0).position_m) > 30).mean() > 0.5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no column 'id'"),
        ("id,x_m,y_m\na,0,0\n", "no column 'heading_rad'"),
        ("id,x_m,y_m,heading_rad\n", "no vehicles"),
        ("id,x_m,y_m,heading_rad\na,0,0,0\na,1,1,1\n", "line 3: id = 'a' appears twice"),
        ("id,x_m,y_m,heading_rad\na/b,0,0,0\n", "line 2: id = 'a/b'"),
        ("id,x_m,y_m,heading_rad\na,zero,0,0\n", "line 2: x_m = 'zero': a finite number is needed"),
        ("id,x_m,y_m,heading_rad\na,0,inf,0\n", "line 2: y_m = 'inf'"),
        ("id,x_m,y_m,heading_rad\na,0,0\n", "line 2: heading_rad = None"),
    ],
)
def test_a_wrong_network_file_names_its_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "n.csv"
    path.write_text(text)
    with pytest.raises(ScenarioError) as caught:
        load_network(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)


def scenario(**sections: dict) -> Scenario:
    return Scenario.model_validate({"network": {"vehicles": 10}, **sections})


def test_the_statistics_are_those_of_the_scenario() -> None:
    world = build_world(
        scenario(
            run={"duration_s": 2000}, world={"common_error": {"sigma_m": 2, "tau_s": 5}, "gnss": {"sigma_m": 0.5}}
        )
    )
    instants = [world.at(k) for k in range(0, world.periods, 3)]
    common = np.array([i.common_error_m for i in instants])
    assert common.std() == pytest.approx(2.0, rel=0.1)
    lag = round(5 / 0.3)
    correlation = np.mean(common[lag:] * common[:-lag]) / np.mean(common**2)
    assert correlation == pytest.approx(np.exp(-1), abs=0.08)
    noise = np.array([i.fix_m - i.position_m - i.common_error_m for i in instants])
    assert noise.std() == pytest.approx(0.5, rel=0.02)
    assert abs(noise.mean()) < 0.01


def test_vehicles_stay_inside_their_lanes() -> None:
    world = build_world(scenario(run={"duration_s": 300}))
    offsets = np.array(
        [world.lane_map.signed_offset_m(world.at(k).position_m, world.lane_of) for k in range(world.periods)]
    )
    assert np.abs(offsets).max() <= 0.85 + 1e-6
    assert 0.3 < offsets.std() < 0.4, "0.4 m, less what the reflection takes"
    assert np.abs(np.diff(offsets, axis=0)).max() < 0.25, "no jumps"


def test_a_fix_is_what_the_instant_says() -> None:
    world = build_world(scenario())
    for period in (0, 7):
        instant = world.at(period)
        for node in range(10):
            fix = world.fix(period, node)
            assert fix.position_m == pytest.approx(instant.fix_m[node], abs=1e-9)
            assert fix.heading_rad == pytest.approx(instant.fix_heading_rad[node])
            assert fix.time_ns == instant.time_ns


def test_without_a_heading_there_is_none() -> None:
    world = build_world(scenario(world={"gnss": {"heading": False}}))
    assert world.fix(0, 0).heading_rad is None
    assert np.isnan(world.at(0).fix_heading_rad).all()


def test_one_more_vehicle_changes_nobodys_errors(tmp_path: Path) -> None:
    rows = [f"v{i},{i * 100},0,0.5" for i in range(6)]
    worlds = []
    for count in (5, 6):
        path = tmp_path / f"{count}.csv"
        path.write_text("id,x_m,y_m,heading_rad\n" + "\n".join(rows[:count]) + "\n")
        worlds.append(build_world(scenario(network={"kind": "file", "path": str(path)})))
    for period in (0, 50, 200):
        few, many = (world.at(period) for world in worlds)
        assert np.array_equal(few.fix_m, many.fix_m[:5])
        assert np.array_equal(few.common_error_m, many.common_error_m)


def test_the_map_holds_every_lane_and_no_label() -> None:
    world = build_world(scenario(network={"vehicles": 38}))
    assert len(world.lane_map) == 38
    assert sorted(world.lane_of.tolist()) == list(range(38))
    assert world.lane_of.tolist() != list(range(38))
