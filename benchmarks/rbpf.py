"""The filter's step, and a whole period of a cooperative vehicle: what fifty of them cost on two cores."""

import statistics
import time

import numpy as np

from agents.cooperative import Estimator, Options
from vnet import Fix, Packet
from vnet.cmm.rbpf import Observation, Rbpf, RbpfConfig
from vnet.roads.lanes import LaneMap

PERIOD_NS = 100_000_000
COMMON_M = np.array([2.0, -1.0])


def bench() -> dict[str, float]:
    """Medians in microseconds of CPU time, with all fixes present."""
    period_us, fusing_us = period()
    return {"step_us": step(), "period_us": period_us, "fusing_period_us": fusing_us}


def lanes_of(vehicles: int) -> LaneMap:
    """Roads of random directions, a vehicle each, on 3 km × 3 km."""
    rng = np.random.default_rng(0)
    return LaneMap(rng.uniform(0, 3000, (vehicles, 2)), rng.uniform(0, 2 * np.pi, vehicles), 0.85)


def step(particles: int = 500, vehicles: int = 10, steps: int = 400) -> float:
    """Predict, update, map matching, estimate and, where it is due, resampling."""
    rng = np.random.default_rng(0)
    lanes = lanes_of(vehicles)
    rbpf = Rbpf(RbpfConfig(particles=particles), lanes, np.random.default_rng(1))
    times_s = []
    for _ in range(steps):
        fixes = {
            f"v{j}": Observation(
                lanes.point_m[j] + COMMON_M + rng.normal(size=2), np.eye(2), float(lanes.heading_rad[j])
            )
            for j in range(vehicles)
        }
        started = time.process_time()
        rbpf.step(0.1, fixes)
        _ = rbpf.estimate_m, rbpf.estimate_covariance_m2
        times_s.append(time.process_time() - started)
    return statistics.median(times_s) * 1e6


def period(particles: int = 200, vehicles: int = 15, periods: int = 200) -> tuple[float, float]:
    """One vehicle with 14 neighbours: decode, filter, consensus, encode; and the periods that fuse as well."""
    rng = np.random.default_rng(0)
    lanes = lanes_of(vehicles)
    options = Options(particles=particles)
    crowd = [Estimator(f"v{i}", options, lanes, np.random.default_rng(i)) for i in range(vehicles)]
    air: list[Packet] = []
    previous: list[Fix] = []
    times_s = []
    for number in range(periods):
        now_ns = number * PERIOD_NS
        noisy = lanes.point_m + COMMON_M + rng.normal(size=lanes.point_m.shape)
        fixes = [Fix(now_ns, noisy[i], np.eye(2), float(lanes.heading_rad[i])) for i in range(vehicles)]
        frames = []
        for i, vehicle in enumerate(crowd):
            heard = [packet for packet in air if packet.sender != f"v{i}"]
            started = time.process_time()
            read = vehicle.read(heard, now_ns, PERIOD_NS)
            if previous:
                vehicle.step(0.1, previous[i], read)
            frames.append(vehicle.frame(fixes[i], 1400))
            if i == 0:
                times_s.append(time.process_time() - started)
        air = [Packet(f"v{i}", now_ns, now_ns, frame) for i, frame in enumerate(frames)]
        previous = fixes
    settled = times_s[periods // 4 :]
    # At 10 Hz and the default interval of half a second every fifth period fuses: the slowest fifth.
    return statistics.median(settled) * 1e6, statistics.median(sorted(settled)[-len(settled) // 5 :]) * 1e6
