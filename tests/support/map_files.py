"""Small maps in metres, for tests of vehicles that drive on them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from emulator.world.maps.roads import NAMES, Roads, RoadsBuilder

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
    """Write a map as edges: roads end where others cross, and a reader calls them `edge N` by their first edge."""
    made = roads_of(*((str(n), *road) for n, road in enumerate(roads)))
    start, end, road = made.node[made.segment], made.node[made.segment + 1], made.road_of[made.segment]
    ahead, back = made.forward[road] > 0, made.backward[road] > 0
    number = np.concatenate([road[ahead], road[back]])
    x_m, y_m = made.node_m.T
    np.savez(
        folder / "roads.npz",
        node_x_m=x_m,
        node_y_m=y_m,
        edges=np.concatenate([np.column_stack([start, end])[ahead], np.column_stack([end, start])[back]]),
        edge_class=np.array(NAMES)[made.kind[number]],
        edge_lanes=np.concatenate([made.forward[road[ahead]], made.backward[road[back]]]),
        edge_lane_width_m=made.lane_width_m[number],
    )
    return folder / "roads.npz"


CROSS: tuple[tuple[Sequence[Point], tuple[int, int]], ...] = (
    ([(-200.0, 0.0), (0.0, 0.0), (200.0, 0.0)], (1, 0)),
    ([(0.0, -200.0), (0.0, 0.0), (0.0, 200.0)], (1, 0)),
)
"""Two one-way roads, to the east and to the north, that cross at the origin."""
