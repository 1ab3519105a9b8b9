"""Compare the rays that buildings cut in ns-3 and in vnet. `python -m benchmarks.ns3.buildings`

Status 0 if both agree about every ray, 1 if not, 2 if ns-3 is not there.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.ns3.simulators import MissingError, build
from emulator.radio.propagation import Obstacles
from emulator.scenario.radio import Buildings as Section
from emulator.world.buildings import Buildings
from vnet.types import Array

PROGRAM = Path(__file__).with_name("buildings.cc")
MODULES = ("core", "mobility", "buildings")
SIDE_M = 1000.0
BUILDINGS, ANTENNAS = 50, 200
SEED = 5
MOST_DB = 1e9
"""More than any ray loses."""


def main() -> int:
    """Compare the rays between all antennas, and print how many are cut."""
    rng = np.random.default_rng(SEED)
    low_m = rng.uniform(0, SIDE_M, (BUILDINGS, 2))
    boxes_m = np.hstack([low_m, low_m + rng.uniform(5, 60, (BUILDINGS, 2))])
    antenna_m = rng.uniform(0, SIDE_M, (ANTENNAS, 2))
    one, other = np.triu_indices(ANTENNAS, 1)
    try:
        theirs = cut_in_ns3(boxes_m, np.hstack([antenna_m[one], antenna_m[other]]))
    except MissingError as error:
        print(error, file=sys.stderr)
        return 2
    rings = [[np.array([(w, s), (e, s), (e, n), (w, n)])] for w, s, e, n in boxes_m.tolist()]
    obstacles = Obstacles(Buildings.of(rings), Section(path=Path("none")))
    ours = obstacles.loss_db(antenna_m, np.full((ANTENNAS, ANTENNAS), MOST_DB))[one, other] > 0
    differ = int((theirs != ours).sum())
    print(f"{len(one):,} rays: {int(theirs.sum()):,} cut in ns-3, {int(ours.sum()):,} in vnet; {differ} differ")
    return int(differ > 0)


def cut_in_ns3(boxes_m: Array, rays_m: Array) -> Array:
    """Return whether boxes (b, 4) cut rays (n, 4), west, south, east and north each. Raises MissingError."""
    lines = [str(len(boxes_m)), *map(_line, boxes_m.tolist()), str(len(rays_m)), *map(_line, rays_m.tolist())]
    with tempfile.TemporaryDirectory(prefix="vnet-ns3-") as folder:
        program = build(Path(folder), PROGRAM, MODULES)
        done = subprocess.run([program], input="\n".join(lines), capture_output=True, text=True, check=True)
    return np.array(done.stdout.split(), dtype=int) == 1


def _line(numbers: list[float]) -> str:
    return " ".join(map(repr, numbers))


if __name__ == "__main__":
    sys.exit(main())
