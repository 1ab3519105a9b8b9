"""Trips of a scenario, from files (which are written as well), SUMO, a city, or a function of the user's own.

Tables (CSV, Parquet) have the columns id, time_s and x_m, y_m or lat_deg, lon_deg; `heading_rad` and `speed_mps`
are optional, and not known of a vehicle with a NaN there; others are ignored. Files are read in batches.

In SUMO's floating car data (`--fcd-output`) an element `timestep` with `time` holds elements `vehicle` with `id`,
`x`, `y`, `angle` (degrees clockwise from north) and `speed`. Positions are metres of SUMO's network, or degrees
with `--fcd-output.geo`, which the header states. They are those of the middle of the front bumper.

Arrays (NPZ) are `lat_deg`, `lon_deg` or `x_m`, `y_m` (N, K), a row for each vehicle, and `rate_hz`. Column k is the
time k / rate_hz. A vehicle is absent where both coordinates are NaN. `id` (N,), `heading_rad` and `speed_mps` (N,
K) are optional; without ids vehicles are v1, v2, …, padded with zeros so that they sort.
"""

from __future__ import annotations

import csv
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.parsers import expat

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from emulator.scenario.network import Map, Network, read_begin_s
from emulator.scenario.own_functions import in_words, line_of, load_function, outside
from emulator.scenario.program import Program
from emulator.scenario.sections import DAY_S
from emulator.world.input_files import open_csv, read_arrays
from emulator.world.maps.files import lanes_around, notes_of, roads_of
from emulator.world.projection import CoordinateFrame
from emulator.world.trips.generate import RIGHT, Side, generate_motion
from emulator.world.trips.motion import (
    DEGREES,
    METRES,
    MOST_SAMPLES,
    OPTIONAL,
    Motion,
    Rules,
    Samples,
    Selection,
    motion_of,
)
from vnet.errors import ScenarioError, printable, shown
from vnet.roads.road_map import RoadMap
from vnet.runtime.programs import search_programs_in
from vnet.types import Array
from vnet.units import NS_PER_S

_LONGEST_LINE = 100_000
"""Characters of the header line."""
BATCH_ROWS = 1 << 16
"""Rows that are read at once."""
_CHUNK_BYTES = 1 << 20
"""Bytes that are parsed at once."""
_GEO = re.compile(r'<fcd-output\.geo\s+value="(?i:true|1|t|yes|on|x)"')
_EXPLAIN_LINES = 3
"""Lines of SUMO's errors that are shown."""
_LARGEST_BYTES = 8 * MOST_SAMPLES + (1 << 20)
"""Largest array that is read."""
ENDINGS = (".csv", ".parquet")
USAGE = "def {}(seed, vehicles, duration_s)"
COLUMNS = ("time_s", "x_m", "y_m", "heading_rad")
"""Numbers of a sample; the heading may be missing."""


def read_csv(path: Path, window_s: tuple[float, float] | None) -> Samples:
    """Return the samples of a CSV file. Raise ScenarioError, naming the row (the header is 1), for a bad file."""
    with open_csv(path, _LONGEST_LINE) as lines:
        names = next(csv.reader(lines), [])
        columns = choose_columns(path, names)
    types = {name: pa.string() if name == "id" else pa.float64() for name in columns}
    convert = pacsv.ConvertOptions(
        column_types=types, include_columns=columns, null_values=[""], strings_can_be_null=False
    )
    try:
        # With one thread pyarrow's errors name the row.
        reader = pacsv.open_csv(path, pacsv.ReadOptions(use_threads=False), convert_options=convert)
        return _collect(path, reader, columns, first_row=2, window_s=window_s)
    except (OSError, pa.ArrowInvalid) as error:
        problem = re.sub(r"^In CSV column #(\d+): ", lambda found: f"{names[int(found[1])]}: ", str(error))
        raise ScenarioError(f"{path}: not a CSV file of trips: {printable(problem, 300)}") from None


def read_parquet(path: Path, window_s: tuple[float, float] | None) -> Samples:
    """Return the samples of a Parquet file. Raise ScenarioError, naming the row (from 1), for a bad file."""
    try:
        with pq.ParquetFile(path.absolute()) as file:
            columns = choose_columns(path, file.schema_arrow.names)
            batches = file.iter_batches(BATCH_ROWS, columns=columns)
            return _collect(path, batches, columns, first_row=1, window_s=window_s)
    except (OSError, pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise ScenarioError(f"{path}: not a Parquet file of trips: {printable(str(error), 300)}") from None


def choose_columns(path: Path, names: Sequence[str]) -> list[str]:
    """Return the columns of a file that are read: id, time_s, positions in metres or degrees, and optional ones.

    Raise ScenarioError if one is missing, or appears twice.
    """
    metres, degrees = set(METRES) & set(names), set(DEGREES) & set(names)
    where = METRES if len(metres) > len(degrees) or len(metres) == len(METRES) else DEGREES
    for name in ("id", "time_s", *where):
        if name not in names:
            raise ScenarioError(
                f"{path}: no column {name!r}; needed are id, time_s, and x_m, y_m or lat_deg, lon_deg"
            )
    columns = ["id", "time_s", *where, *(name for name in OPTIONAL if name in names)]
    for name in columns:
        if list(names).count(name) > 1:
            raise ScenarioError(f"{path}: two columns {name!r}")
    return columns


def _collect(
    path: Path,
    batches: Iterable[pa.RecordBatch],
    columns: Sequence[str],
    first_row: int,
    window_s: tuple[float, float] | None,
) -> Samples:
    samples = Samples(path, "row", window_s)
    for batch in batches:
        numbers = {name: _numbers(path, name, batch[name]) for name in columns[1:]}
        row = first_row + samples.taken + np.arange(len(batch), dtype=np.int64)
        values = {name: np.asarray(column.to_numpy(zero_copy_only=False)) for name, column in numbers.items()}
        samples.add(batch["id"].cast(pa.string()), row, values)
    return samples


def _numbers(path: Path, name: str, column: pa.Array) -> pa.Array:
    try:
        return column.cast(pa.float64())
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise ScenarioError(f"{path}: {name} holds {column.type}: {printable(str(error), 300)}") from None


def read_fcd(path: Path, window_s: tuple[float, float] | None) -> Samples:
    """Return the samples of an FCD file. Raise ScenarioError, naming the line, for a bad file."""
    return _Reader(path, window_s).read()


class _Reader:
    """Handlers for expat, which add the samples in batches."""

    def __init__(self, path: Path, window_s: tuple[float, float] | None) -> None:
        self._path = path
        self._samples = Samples(path, "line", window_s)
        self._where = METRES
        self._time_s: float | None = None
        self._ids: list[str] = []
        self._rows: list[tuple[int, float, float, float, float, float]] = []
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._start
        self._parser.CommentHandler = self._comment
        self._parser.StartDoctypeDeclHandler = self._doctype
        self._is_fcd = False

    def read(self) -> Samples:
        """Read the file to its end."""
        try:
            with self._path.open("rb") as file:
                while chunk := file.read(_CHUNK_BYTES):
                    self._parser.Parse(chunk, False)
                self._parser.Parse(b"", True)
        except OSError as error:
            raise ScenarioError(f"{self._path}: cannot be read: {error.strerror}") from None
        except (expat.ExpatError, LookupError, ValueError) as error:  # the latter two for encodings
            raise ScenarioError(f"{self._path}: not an XML file: {error}") from None
        self._flush()
        return self._samples

    def _problem(self, text: str) -> ScenarioError:
        return ScenarioError(f"{self._path}: line {self._parser.CurrentLineNumber}: {text}")

    def _comment(self, text: str) -> None:
        if _GEO.search(text):
            self._where = (DEGREES[1], DEGREES[0])  # x is the longitude

    def _doctype(self, *_: object) -> None:
        raise self._problem("a document type; SUMO writes none")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        if not self._is_fcd:
            if name != "fcd-export":
                raise self._problem(f"element {printable(name)!r}: fcd-export, as SUMO writes it, is needed")
            self._is_fcd = True
        elif name == "timestep":
            self._time_s = self._number(attributes, "time")
        elif name == "vehicle":
            self._vehicle(attributes)

    def _vehicle(self, attributes: dict[str, str]) -> None:
        if self._time_s is None:
            raise self._problem("a vehicle outside every timestep")
        if "id" not in attributes:
            raise self._problem("a vehicle without id")
        told = {"angle": "nan", "speed": "nan"} | attributes
        numbers = [self._number(told, name) for name in ("x", "y", "angle", "speed")]
        self._ids.append(attributes["id"])
        self._rows.append((self._parser.CurrentLineNumber, self._time_s, *numbers))  # type: ignore[arg-type]
        if len(self._rows) >= BATCH_ROWS:
            self._flush()

    def _number(self, attributes: dict[str, str], name: str) -> float:
        try:
            return float(attributes[name])
        except KeyError:
            raise self._problem(f"no {name}") from None
        except ValueError:
            raise self._problem(f"{name} = {shown(attributes[name])}: a number is needed") from None

    def _flush(self) -> None:
        if not self._rows:
            return
        line, time_s, x, y, angle_deg, speed_mps = np.array(self._rows).T
        heading_rad = np.radians(90.0 - angle_deg)
        columns = {"time_s": time_s, self._where[0]: x, self._where[1]: y, "heading_rad": heading_rad}
        self._samples.add(pa.array(self._ids), line.astype(np.int64), columns | {"speed_mps": speed_mps})
        self._ids, self._rows = [], []


_READABLE = {"fcd-output.geo": "false", "fcd-output.attributes": "x,y,angle,speed", "human-readable-time": "false"}
_READABLE |= {"precision": "6", "output-prefix": "", "no-step-log": "true"}
"""Options with which SUMO's floating car data can be read, whatever its configuration says."""
_READABLE_IF_NAMED = {"fcd-output.utm": "false", "output.format": "xml"}
"""Likewise, but only of a configuration that names them: SUMO before 1.24 has none."""


def drive_sumo(path: Path, seed: int, end_s: float | None) -> Samples:
    """Run SUMO on a configuration from its beginning, at most until `end_s`, and return the samples.

    The same files and seed give the same trips. Raise ScenarioError if SUMO is not installed, or fails.
    """
    with TemporaryDirectory(prefix="vnet-sumo-") as folder:
        output = Path(folder) / "fcd.xml"
        command = [_sumo(path), "-c", str(path), "--seed", str(seed), "--fcd-output", str(output)]
        named = path.read_text(errors="replace")
        options = _READABLE | {name: value for name, value in _READABLE_IF_NAMED.items() if f"<{name} " in named}
        command += [part for name, value in options.items() for part in (f"--{name}", value)]
        command += [] if end_s is None else ["--end", str(end_s)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        except OSError as error:
            raise ScenarioError(f"{path}: cannot start {command[0]}: {error.strerror}") from None
        if done.returncode or not output.exists():
            lines = [line for line in done.stderr.splitlines() if line.startswith("Error")] or [done.stderr.strip()]
            reason = " ".join(lines[:_EXPLAIN_LINES])
            raise ScenarioError(f"{path}: SUMO failed (exit status {done.returncode}): {reason}")
        try:
            return read_fcd(output, None)
        except ScenarioError as error:
            raise ScenarioError(f"{path}: output of SUMO: {error}") from None


def _sumo(path: Path) -> str:
    """Return the path of SUMO, found on the PATH, beside this Python (the extra `sumo`), or in SUMO_HOME."""
    folders = [os.environ.get("PATH", ""), str(Path(sys.executable).parent)]
    if home := os.environ.get("SUMO_HOME"):
        folders.append(str(Path(home) / "bin"))
    found = shutil.which("sumo", path=os.pathsep.join(folders))
    if found is None:
        raise ScenarioError(
            f"{path}: SUMO is not installed: pip install 'vnet-emulator[sumo]', or apt-get install sumo"
        )
    return found


def read_npz(path: Path, window_s: tuple[float, float] | None) -> Samples:
    """Return the samples of an NPZ file. Raise ScenarioError, naming the array or the row, for a bad file."""
    arrays = _load(path)
    where = METRES if set(METRES) <= arrays.keys() else DEGREES
    for name in (*where, "rate_hz"):
        if name not in arrays:
            raise ScenarioError(f"{path}: no array {name!r}; needed are rate_hz, and lat_deg, lon_deg or x_m, y_m")
    first, second = (arrays[name] for name in where)
    count, length = _shape(path, where, first, second)
    rate_hz = arrays["rate_hz"]
    if rate_hz.ndim or not 0 < rate_hz <= 10_000:
        raise ScenarioError(f"{path}: rate_hz = {printable(str(rate_hz))}: a number in (0, 10000] is needed")
    time_s = np.arange(length) / float(rate_hz)
    columns = [*where, *(name for name in OPTIONAL if name in arrays)]
    for name in columns:
        if arrays[name].shape != (count, length):
            raise ScenarioError(f"{path}: {name} is {arrays[name].shape}, and {where[0]} {(count, length)}")
    samples = Samples(path, "row", window_s)
    for row, node_id in enumerate(_ids(path, arrays, count)):
        present = ~(np.isnan(first[row]) & np.isnan(second[row]))
        if not present.any():
            continue
        values = {"time_s": time_s[present], **{name: arrays[name][row, present] for name in columns}}
        row_number = np.full(int(present.sum()), row + 1)
        samples.add(pa.array([node_id]).take(pa.array(np.zeros(len(row_number), np.int64))), row_number, values)
    return samples


def _load(path: Path) -> dict[str, NDArray[Any]]:
    arrays = read_arrays(path, (*METRES, *DEGREES, *OPTIONAL, "rate_hz", "id"), _LARGEST_BYTES)
    for name, array in arrays.items():
        if name != "id":
            if array.dtype.kind not in "fiu":
                raise ScenarioError(f"{path}: {name} holds {array.dtype}: numbers are needed")
            arrays[name] = array.astype(float)
    return arrays


def _shape(path: Path, where: tuple[str, str], first: Array, second: Array) -> tuple[int, int]:
    if first.ndim != 2 or first.shape != second.shape or not first.size:
        shapes = f"{where[0]} is {first.shape}, {where[1]} {second.shape}"
        raise ScenarioError(f"{path}: {shapes}: matrices of one shape are needed, a row for each vehicle")
    return first.shape


def _ids(path: Path, arrays: dict[str, NDArray[Any]], count: int) -> list[str]:
    if "id" not in arrays:
        width = len(str(count))
        return [f"v{number:0{width}d}" for number in range(1, count + 1)]
    if arrays["id"].dtype.kind not in "Uiu":
        raise ScenarioError(f"{path}: id holds {arrays['id'].dtype}: texts (str) or integers are needed")
    ids = [str(name) for name in arrays["id"].ravel()]
    if len(ids) != count:
        raise ScenarioError(f"{path}: {len(ids)} ids for {count} rows")
    if len(set(ids)) != count:
        twice = next(name for number, name in enumerate(ids) if name in ids[:number])
        raise ScenarioError(f"{path}: id = {printable(twice)} appears twice; ids must differ")
    return ids


def check_trips_name(path: Path) -> None:
    """Raise ScenarioError unless trips can be written in the format of this name."""
    if path.suffix.lower() not in ENDINGS:
        raise ScenarioError(f"{path}: trips are written as {' or '.join('*' + ending for ending in ENDINGS)}")


def write_trips(motion: Motion, path: Path, rate_hz: float) -> int:
    """Write the positions of each vehicle while it is present, in metres, by vehicle; return the number of samples.

    Raise ScenarioError if the file cannot be written.
    """
    vehicle, period = np.nonzero(np.isfinite(motion.position_m[..., 0]).T)
    position_m = motion.position_m[period, vehicle]
    table = pa.table(
        {
            "id": pa.array(motion.node_ids).take(pa.array(vehicle)),
            "time_s": period / rate_hz,
            "x_m": np.round(position_m[:, 0], 3),
            "y_m": np.round(position_m[:, 1], 3),
            "heading_rad": np.round(motion.heading_rad[period, vehicle], 5),
        }
    )
    try:
        if path.suffix.lower() == ".csv":
            pacsv.write_csv(table, path)
        else:
            pq.write_table(table, path.absolute())  # a colon would make it an address
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be written: {error.strerror or error}") from None
    return len(table)


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
    width = max(table.shape[1] for table in tables.values())
    if sum(map(len, tables.values())) > MOST_SAMPLES:
        raise ScenarioError(f"{problem}: more than {MOST_SAMPLES:,} samples")
    for name, table in tables.items():
        lines = np.arange(first, first + len(table))
        headed = np.pad(table, ((0, 0), (0, width - table.shape[1])), constant_values=np.nan)
        columns = dict(zip(COLUMNS, headed.T, strict=False))
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
    source, roads = roads_of(network, section)
    side = RIGHT if section is None else Side(section.side, section.aside_m)
    motion = generate_motion(source, roads, network.vehicles, network.seed, periods, period_ns, side)
    if section is None:
        return motion, roads.lane_map(), roads.frame
    motion = replace(motion, notes=notes_of(section.path, roads))
    return motion, lanes_around(roads, section, motion.position_m), roads.frame


def _read(path: Path, window_s: tuple[float, float] | None) -> Samples:
    if path.suffix.lower() not in READERS:
        raise ScenarioError(f"{path}: trips are read from {', '.join(READERS)} (SUMO's FCD), not {path.suffix!r}")
    return READERS[path.suffix.lower()](path, window_s)
