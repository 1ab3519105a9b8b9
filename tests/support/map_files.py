"""Small maps in metres, for tests of vehicles that drive on them."""

from collections.abc import Sequence
from pathlib import Path

from emulator.world.maps.formats import write_graph
from emulator.world.maps.roads import Roads, RoadsBuilder

Point = tuple[float, float]


def roads_of(*roads: tuple[str, Sequence[Point], tuple[int, int]], lane_width_m: float = 3.5) -> Roads:
    """Return roads, given as name, points in metres, and lanes in and against their direction.

    Roads that share a point meet there.
    """
    builder = RoadsBuilder("test")
    for name, points, lanes in roads:
        builder.add(name, [(point, point) for point in points], 2, lanes, lane_width_m)
    return builder.build(builder.coordinates(), None)


def write_map(folder: Path, *roads: tuple[Sequence[Point], tuple[int, int]]) -> Path:
    """Write a map of roads, which a reader calls `edge N`, N being the number of a road's first edge."""
    path = folder / "roads.npz"
    write_graph(roads_of(*((str(n), *road) for n, road in enumerate(roads))), path)
    return path


CROSS: tuple[tuple[Sequence[Point], tuple[int, int]], ...] = (
    ([(-200.0, 0.0), (0.0, 0.0), (200.0, 0.0)], (1, 0)),
    ([(0.0, -200.0), (0.0, 0.0), (0.0, 200.0)], (1, 0)),
)
"""Two one-way roads, to the east and to the north, that cross at the origin."""
