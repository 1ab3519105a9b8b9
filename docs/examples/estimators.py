"""The estimators of the cooperative positioning program by themselves: no emulator, no event loop, no files.

    python -m docs.examples.estimators

A filter finds the GNSS error that two vehicles share, because each of them must be on its road; consensus finds the
mean of four values over a ring that loses frames; and weights say how to fuse three estimates.
"""

from __future__ import annotations

import numpy as np

from agents.cooperative.cmm import Observation, OptimizedWeights, RatioConsensus, Rbpf, RbpfConfig, Share
from vnet.roads.lanes import LaneMap
from vnet.types import Array

COMMON_ERROR_M = np.array([4.0, -2.0])
NOISE_M = 0.5
PERIOD_S = 0.1
LOSS = 0.3


def find_common_error(periods: int = 100) -> Array:
    """Return the estimate (2,) of the common error in m from fixes of two vehicles on crossing roads."""
    rng = np.random.default_rng(1)
    # Two straight roads through the origin: one to the east, one to the north.
    roads = LaneMap(np.zeros((2, 2)), np.array([0.0, np.pi / 2]), 0.85)
    position_m = {"east": np.array([100.0, 0.0]), "north": np.array([0.0, 50.0])}
    heading_rad = {"east": 0.0, "north": np.pi / 2}
    own = Rbpf(RbpfConfig(particles=400), roads, rng)
    for _ in range(periods):
        fixes = {
            name: Observation(
                true_m + COMMON_ERROR_M + rng.normal(0, NOISE_M, 2), np.eye(2) * NOISE_M**2, heading_rad[name]
            )
            for name, true_m in position_m.items()
        }
        own.step(PERIOD_S, fixes)
    return own.estimate_m


def find_mean(rounds: int = 200) -> Array:
    """Return the mean (2,) that the first of four nodes on a ring knows, though three frames in ten are lost."""
    rng = np.random.default_rng(2)
    values = {f"v{i}": np.array([i, 10.0 * i]) for i in range(4)}
    names = list(values)
    nodes = {name: RatioConsensus(name) for name in names}
    shares: dict[str, Share] = {}
    for _ in range(rounds):
        said = {}
        for i, name in enumerate(names):
            neighbours = (names[i - 1], names[(i + 1) % len(names)])
            heard = {peer: shares[peer] for peer in neighbours if peer in shares and rng.random() > LOSS}
            said[name] = nodes[name].round(values[name], heard)
        shares = said
    mean_m = nodes["v0"].mean_m
    assert mean_m is not None
    return mean_m


def fuse_three() -> Array:
    """Return the weights (3,) of a vehicle's own estimate and of two neighbours', one of which knows little."""
    estimates_m = np.array([[4.2, -2.1], [3.7, -1.8], [9.0, 3.0]])
    covariances_m2 = np.array([1.0, 1.0, 25.0])[:, None, None] * np.eye(2)
    return OptimizedWeights().solve(estimates_m, covariances_m2, mean_m=COMMON_ERROR_M)


def main() -> None:
    """Print the three results."""
    east_m, north_m = find_common_error()
    print(f"common error: {east_m:.1f} m east, {north_m:.1f} m north")
    print("mean of the ring:", np.round(find_mean(), 2).tolist())
    print("fusion weights:", np.round(fuse_three(), 2).tolist())


if __name__ == "__main__":
    main()
