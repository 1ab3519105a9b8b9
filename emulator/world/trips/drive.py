"""Trips of a scenario, from files, SUMO, a city, or a function of the user's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from emulator.scenario.network import Map, Network, read_begin_s
from emulator.scenario.own_functions import in_words, line_of, load_function, outside
from emulator.scenario.program import Program
from emulator.scenario.sections import DAY_S
from emulator.world.maps.city import city_roads
from emulator.world.maps.files import lanes_around, notes_of, read_roads
from emulator.world.projection import CoordinateFrame
from emulator.world.trips.files import drive_sumo, read_csv, read_fcd, read_npz, read_parquet
from emulator.world.trips.generate import RIGHT, Side, generate_motion
from emulator.world.trips.motion import MOST_SAMPLES, Motion, Rules, Samples, Selection, motion_of
from vnet.errors import ScenarioError, shown
from vnet.roads.road_map import RoadMap
from vnet.runtime.programs import search_programs_in
from vnet.units import NS_PER_S

USAGE = "def {}(seed, vehicles, duration_s)"
COLUMNS = ("time_s", "x_m", "y_m", "heading_rad")
"""Numbers of a sample; the heading may be missing."""
READERS = {".csv": read_csv, ".parquet": read_parquet, ".npz": read_npz, ".xml": read_fcd}
"""Readers of trips by the ending of the file's name."""


def own_samples(network: Network, program: Program, duration_s: float) -> Samples:
    """Return the samples of the vehicles of a network of the user's own, of a run of `duration_s`.

    The function gets the network's seed and number of vehicles, and the run's length. It returns a mapping from ids
    to samples (n, 3) or (n, 4): time from the run's beginning in s, x and y in m, and the heading in rad. Raise
    ScenarioError, with the function's line, if it raises, and for an answer that is none.
    """
    assert network.function is not None
    problem = f"network.kind = {network.function!r}"
    search_programs_in(program.folders)
    function = load_function("network.kind", network.function, program, USAGE)
    try:
        answer = function(network.seed, network.vehicles, duration_s)
    except (Exception, SystemExit) as error:
        where = line_of(outside(error, __file__))
        raise ScenarioError(f"{problem}: {in_words(error)}{f' ({where})' if where else ''}") from error
    if not isinstance(answer, Mapping) or not answer:
        raise ScenarioError(f"{problem}: returns {shown(answer)}: a dict from ids to samples is needed")
    samples, first = Samples(Path(problem), "sample"), 1
    tables = {name: _table(problem, name, rows) for name, rows in answer.items()}
    width = min(table.shape[1] for table in tables.values())
    if sum(map(len, tables.values())) > MOST_SAMPLES:
        raise ScenarioError(f"{problem}: more than {MOST_SAMPLES:,} samples")
    for name, table in tables.items():
        lines = np.arange(first, first + len(table))
        columns = dict(zip(COLUMNS[:width], table.T, strict=False))
        samples.add(pa.array([str(name)] * len(table)), lines, columns)
        first += len(table)
    return samples


def _table(problem: str, name: object, rows: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    try:
        table = np.asarray(rows, dtype=np.float64)
    except (TypeError, ValueError):
        table = np.zeros(0)
    if table.ndim != 2 or table.shape[1] not in (3, 4) or not len(table):
        needed = "rows of time_s, x_m, y_m and, if you like, heading_rad are needed"
        raise ScenarioError(f"{problem}: {shown(name)}: {shown(rows)}: {needed}")
    return table


def drive(network: Network, program: Program, periods: int, period_ns: int) -> Motion:
    """Return the motion of a network's vehicles over `periods`; `program` has the folders of their functions.

    Raise ScenarioError, naming the file and the line or row, for a bad file.
    """
    path = network.path or Path(f"network.kind = {network.function!r}")
    rules = Rules(
        fastest_mps=network.fastest_mps,
        longest_gap_s=DAY_S if network.kind == "own" else network.longest_gap_s,
        leaves_out=network.impossible_trips == "leave_out",
        hardest_mps2=network.max_acceleration_mps2,
    )
    duration_s = (periods - 1) * period_ns / NS_PER_S
    start_s = network.start_s
    if network.kind == "sumo":
        start_s = read_begin_s(path) if start_s is None else start_s
        samples = drive_sumo(path, network.seed, start_s + duration_s)
    elif network.kind == "own":
        start_s = start_s or 0.0
        samples = own_samples(network, program, duration_s)
    else:
        window_s = None
        if start_s is not None:
            window_s = start_s - rules.longest_gap_s, start_s + duration_s + rules.longest_gap_s
        samples = _read(path, window_s)
    trips = samples.trips(network.origin_deg)
    if start_s is None:
        start_s = min(float(trip.time_s[0]) for trip in trips)
    selection = Selection(
        start_s=start_s,
        periods=periods,
        period_ns=period_ns,
        disc=network.disc,
        most=network.max_vehicles,
    )
    try:
        motion = motion_of(trips, selection, rules)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from None
    notes = tuple(f"{path}: {note}" for note in (*samples.notes, *motion.notes))
    return replace(motion, origin_deg=samples.origin_deg, notes=notes)


def whole_motion(path: Path, origin_deg: tuple[float, float] | None, rate_hz: float, rules: Rules) -> Motion:
    """Return all trips of a file, from the first sample to the last.

    Raise ScenarioError, naming the file and the line or row, for a bad file.
    """
    samples = _read(path, None)
    trips = samples.trips(origin_deg)
    start_s = min(float(trip.time_s[0]) for trip in trips)
    seconds = max(float(trip.time_s[-1]) for trip in trips) - start_s
    selection = Selection(start_s, round(seconds * rate_hz) + 1, round(NS_PER_S / rate_hz))
    try:
        motion = motion_of(trips, selection, rules)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from None
    return replace(motion, origin_deg=samples.origin_deg)


def drive_through_city(
    network: Network, section: Map | None, periods: int, period_ns: int
) -> tuple[Motion, RoadMap, CoordinateFrame | None]:
    """Return generated trips through a generated city, or through the map of `section`, and its lanes and frame.

    Raise ScenarioError if the map cannot be read, or no vehicle can drive on it.
    """
    if section is None:
        source: object = "the generated city"
        roads, side = city_roads(network.seed, network.size_m), RIGHT
    else:
        source, side = section.path, Side(1.0 if section.drive_on == "right" else -1.0, section.aside_m)
        roads = read_roads(section.path, section.origin_deg)
    motion = generate_motion(source, roads, network.vehicles, network.seed, periods, period_ns, side)
    if section is not None:
        motion = replace(motion, notes=notes_of(section.path, roads))
    lanes = roads.lane_map() if section is None else lanes_around(roads, section, motion.position_m)
    return motion, lanes, roads.frame


def _read(path: Path, window_s: tuple[float, float] | None) -> Samples:
    if path.suffix.lower() not in READERS:
        raise ScenarioError(f"{path}: trips are read from {', '.join(READERS)} (SUMO's FCD), not {path.suffix!r}")
    return READERS[path.suffix.lower()](path, window_s)
