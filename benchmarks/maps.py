"""Cost of finding the lanes near vehicles on a city's streets."""

import statistics
import time

import numpy as np

from emulator.world.maps.roads import NUMBER, Roads, RoadsBuilder

STREETS, BLOCK_M, PIECES = 84, 150.0, 5
"""So many streets each way, so far apart, each block of so many segments: 2 113 km of road."""
VEHICLES, REACH_M, TIMES = 1000, 30.0, 20


def city(seed: int = 0) -> Roads:
    """Streets both ways on a grid, a little bent."""
    rng = np.random.default_rng(seed)
    steps = (STREETS - 1) * PIECES + 1
    bend_m = rng.normal(scale=3.0, size=(steps, steps, 2))
    builder = RoadsBuilder("city")
    for street in range(0, steps, PIECES):
        for cells in ([(k, street) for k in range(steps)], [(street, k) for k in range(steps)]):
            points = [(cell, tuple(np.array(cell) * BLOCK_M / PIECES + bend_m[cell])) for cell in cells]
            builder.add(f"street {street}", points, NUMBER["residential"], (1, 1), 3.0)
    return builder.build(builder.coordinates(), None)


def measure(roads: Roads | None = None) -> dict[str, float]:
    """Nearest lanes of 1000 vehicles that stand somewhere on the roads, the median of 20 times."""
    roads = city() if roads is None else roads
    lanes = roads.lane_map()
    rng = np.random.default_rng(1)
    reach_m = np.full(VEHICLES, REACH_M)
    lanes.near(np.zeros((1, 2)), np.zeros(1), reach_m[:1])  # builds the index
    times_s, cpu_s, found = [], [], 0
    for _ in range(TIMES):
        on = rng.choice(len(lanes), VEHICLES, p=lanes.length_m / lanes.length_m.sum())
        along_m = rng.uniform(0, lanes.length_m[on])
        position_m = lanes.point_m[on] + along_m[:, None] * lanes.direction[on] + rng.normal(0, 3.0, (VEHICLES, 2))
        heading_rad = lanes.heading_rad[on] + rng.normal(0, 0.05, VEHICLES)
        started, worked = time.perf_counter(), time.process_time()
        row, _, _ = lanes.near(position_m, heading_rad, reach_m)
        times_s.append(time.perf_counter() - started)
        cpu_s.append(time.process_time() - worked)
        found += len(row)
    return {
        "road_km": float(roads.length_m.sum()) / 1000,
        "segments": len(lanes),
        "near_1000_ms": statistics.median(times_s) * 1000,
        "near_1000_cpu_ms": statistics.median(cpu_s) * 1000,
        "lanes_a_vehicle": found / TIMES / VEHICLES,
    }
