"""From `[network]` to motion: which reader reads the file, and what of it the run takes."""

from __future__ import annotations

from pathlib import Path

from emulator.world.trips.clean import Rules
from emulator.world.trips.fcd import drive_sumo, read_fcd
from emulator.world.trips.matrices import read_npz
from emulator.world.trips.motion import Frame, Motion, motion_of
from emulator.world.trips.samples import Samples
from emulator.world.trips.tables import read_csv, read_parquet
from vnet.errors import ScenarioError
from vnet.scenario import NS_PER_S, Network
from vnet.sumo import read_begin_s

READERS = {".csv": read_csv, ".parquet": read_parquet, ".npz": read_npz, ".xml": read_fcd}
"""By the ending of the file's name."""


def drive(network: Network, periods: int, period_ns: int) -> Motion:
    """How the vehicles of a network drive over so many periods. Raises ScenarioError, naming file and place."""
    path = network.path
    assert path is not None
    rules = Rules(network.fastest_mps, network.longest_gap_s)
    duration_s = (periods - 1) * period_ns / NS_PER_S
    start_s = network.start_s
    if network.kind == "sumo":
        start_s = read_begin_s(path) if start_s is None else start_s
        samples = drive_sumo(path, network.seed, start_s + duration_s)
    else:
        window_s = None
        if start_s is not None:
            window_s = start_s - rules.longest_gap_s, start_s + duration_s + rules.longest_gap_s
        samples = _read(path, window_s)
    trips = samples.trips(network.origin_deg)
    if start_s is None:
        start_s = min(float(trip.time_s[0]) for trip in trips)
    try:
        return motion_of(trips, Frame(start_s, periods, period_ns, network.disc, network.max_vehicles), rules)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from None


def _read(path: Path, window_s: tuple[float, float] | None) -> Samples:
    if path.suffix.lower() not in READERS:
        raise ScenarioError(f"{path}: trips are read from {', '.join(READERS)} (SUMO's FCD), not {path.suffix!r}")
    return READERS[path.suffix.lower()](path, window_s)
