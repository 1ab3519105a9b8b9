"""Networks: the generated ones are like the published ones, and a wrong file is told by its line."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.world.networks import PlacedVehicles, generate_network, load_network
from tests.support.files import write
from vnet.errors import ScenarioError

pytestmark = pytest.mark.slow

RANGE_M = 3000.0
HEADER = "id,x_m,y_m,heading_rad\n"

# Sorted degrees and component sizes of the published networks at 3 km (zhao-lab/network-propagation, MIT).
PUBLISHED = {
    50: ("2 2 3 4 4 5 7 7 7 8 9 9 10 10 10 10 11 11 11 11 12 12 12 12 13 13 13 14 14 15 15 15 16 16 16 16 16 16 17 "
         "17 17 18 18 18 18 18 20 21 21 22", [50]),
    38: ("2 2 3 3 4 4 5 5 5 6 6 6 7 7 7 7 7 7 7 8 8 9 9 9 9 9 9 10 10 10 10 10 10 10 10 12 12 12", [38]),
    24: ("2 2 2 2 2 2 2 2 3 3 3 3 3 4 4 5 5 7 7 7 7 8 8 9", [3, 6, 15]),
}  # fmt: skip


def links(network: PlacedVehicles) -> NDArray[np.bool_]:
    """Return the mask (N, N) of vehicles in range of each other."""
    position_m = network.position_m
    distance_m = np.sqrt(((position_m[:, None] - position_m[None]) ** 2).sum(axis=2))
    return (distance_m <= RANGE_M) & ~np.eye(len(position_m), dtype=bool)


def load(folder: Path, text: str) -> PlacedVehicles:
    return load_network(write(folder, "n.csv", text))


def component_sizes(linked: NDArray[np.bool_]) -> list[int]:
    """Sizes of the connected components, by walking along the links."""
    unseen, sizes = set(range(len(linked))), []
    while unseen:
        waiting, size = [unseen.pop()], 0
        while waiting:
            size += 1
            near = {int(other) for other in np.flatnonzero(linked[waiting.pop()])} & unseen
            unseen -= near
            waiting += near
        sizes.append(size)
    return sorted(sizes)


@pytest.mark.parametrize("vehicles", [50, 38, 24])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_generated_networks_match_the_published_ones(vehicles: int, seed: int) -> None:
    network = generate_network("urban", vehicles, seed)
    linked = links(network)
    degrees, sizes = PUBLISHED[vehicles]
    assert len(set(network.node_ids)) == len(network.position_m) == len(network.heading_rad) == vehicles
    assert component_sizes(linked) == sizes
    assert np.abs(np.sort(linked.sum(axis=0)) - np.array(degrees.split(), dtype=int)).sum() <= 4


@pytest.mark.parametrize("layout", ["urban", "dense"])
def test_the_same_seed_gives_the_same_network_and_another_one_does_not(layout: str) -> None:
    one, same, other = (generate_network(layout, 24, seed) for seed in (5, 5, 6))
    assert one.node_ids == same.node_ids
    assert np.array_equal(one.position_m, same.position_m)
    assert np.array_equal(one.heading_rad, same.heading_rad)
    assert not np.array_equal(one.position_m, other.position_m)
    assert not np.array_equal(one.heading_rad, other.heading_rad)


@pytest.mark.parametrize(
    ("vehicles", "seed", "digest"),
    [(6, 3, "dd06c87e6a727bf5"), (12, 5, "5fe373fcc8d4d990"), (24, 0, "3a766a8fbb5bafd2")],
)
def test_networks_are_those_of_earlier_versions_bit_for_bit(vehicles: int, seed: int, digest: str) -> None:
    position_m = generate_network("urban", vehicles, seed).position_m
    assert hashlib.sha256(position_m.tobytes()).hexdigest()[:16] == digest


@pytest.mark.parametrize("vehicles", [1, 2, 3, 10, 12, 70, 300])
def test_any_number_of_vehicles_can_be_had(vehicles: int) -> None:
    network = generate_network("urban", vehicles, 1)
    assert len(set(network.node_ids)) == vehicles
    assert list(network.node_ids) == sorted(network.node_ids), "numbers are padded"
    assert network.position_m.shape == (vehicles, 2)
    if vehicles <= 70:
        assert component_sizes(links(network)) == [vehicles]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_dense_networks_exceed_the_peer_cap(seed: int) -> None:
    degrees = links(generate_network("dense", 60, seed)).sum(axis=0)
    assert (degrees > 30).mean() > 0.5


def test_headings_are_those_of_a_grid_town() -> None:
    heading_rad = generate_network("dense", 2000, 1).heading_rad
    assert heading_rad.min() >= 0
    assert heading_rad.max() < 2 * np.pi
    from_axis_rad = np.abs((heading_rad + np.pi / 4) % (np.pi / 2) - np.pi / 4)
    assert 0.45 < (from_axis_rad < np.radians(6)).mean() < 0.75, "about half of them; the others go anywhere"
    quarters = np.bincount((heading_rad // (np.pi / 2)).astype(int), minlength=4)
    assert quarters.min() > 200, "all ways are taken"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEADER + "a," + "0" * 10_000 + ",0,0\n", "line 2: longer than 10000 characters"),
        (HEADER + "".join(f"v{i},0,0,0\n" for i in range(10_001)), "more than 10000 rows"),
    ],
)
def test_a_network_file_that_is_too_long_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        load(tmp_path, text)


def test_a_byte_order_mark_is_no_part_of_a_name(tmp_path: Path) -> None:
    assert load(tmp_path, "\ufeff" + HEADER + "a,0,0,0\n").node_ids == ("a",)


def test_columns_go_by_their_names_and_headings_are_brought_into_one_turn(tmp_path: Path) -> None:
    text = "colour,heading_rad,y_m,x_m,id\r\nred,-1.0,2.5,1.5, a \r\nblue,7.0,-4,3,b.2-x_y\r\n"
    network = load(tmp_path, text)
    assert network.node_ids == ("a", "b.2-x_y")
    assert network.position_m.tolist() == [[1.5, 2.5], [3.0, -4.0]]
    assert network.heading_rad == pytest.approx([2 * np.pi - 1, 7 - 2 * np.pi])


def test_a_generated_network_survives_a_file(tmp_path: Path) -> None:
    network = generate_network("dense", 5, 1)
    rows = zip(network.node_ids, network.position_m.tolist(), network.heading_rad.tolist(), strict=True)
    again = load(tmp_path, HEADER + "".join(f"{name},{x!r},{y!r},{angle!r}\n" for name, (x, y), angle in rows))
    assert again.node_ids == network.node_ids
    assert np.array_equal(again.position_m, network.position_m)
    assert np.array_equal(again.heading_rad, network.heading_rad)


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ("a,-83.7412,42.2808,0\nb,-83.7395,42.2811,0\n", True),
        ("a,-83.7412,42.2808,0\n", False),
        ("a,0.123,0.456,0\nb,3000.5,20.125,0\n", False),
        ("a,0,0,0\nb,1,1,0\n", False),
        ("a,5.125,5.125,0\nb,5.125,5.125,0\n", False),
    ],
)
def test_coordinates_that_look_like_degrees_are_told(tmp_path: Path, rows: str, told: bool) -> None:
    notes = load(tmp_path, HEADER + rows).notes
    path = tmp_path / "n.csv"
    said = f"{path}: x_m and y_m look like degrees, and are taken for metres; trips may be in lat_deg and lon_deg"
    assert notes == ((said,) if told else ())
    (turned,) = load(tmp_path, HEADER + "a,0,0,1.5\nb,1,1,270\n").notes
    assert turned == f"{path}: heading_rad looks like degrees, and is taken for radians"
