"""Trips from SUMO: its floating car data (`--fcd-output`), read as a stream, and runs of SUMO itself.

An element `timestep` with `time` holds elements `vehicle` with `id`, `x`, `y`, `angle` (degrees clockwise from
north) and `speed`. Positions are metres of SUMO's network, or degrees with `--fcd-output.geo`, which the header
states. They are those of the middle of the front bumper.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.parsers import expat

import numpy as np
import pyarrow as pa

from emulator.world.trips.samples import DEGREES, METRES, Samples
from emulator.world.trips.tables import BATCH_ROWS
from vnet.errors import ScenarioError, printable, shown

_CHUNK_BYTES = 1 << 20
"""Bytes that are parsed at once."""
_GEO = re.compile(r'<fcd-output\.geo\s+value="(?:true|1|t)"')
_EXPLAIN_LINES = 3
"""Lines of SUMO's errors that are shown."""


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
        numbers = [self._number(attributes, name) for name in ("x", "y", "angle", "speed")]
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


def drive_sumo(path: Path, seed: int, end_s: float | None) -> Samples:
    """Run SUMO on a configuration from its beginning, at most until `end_s`, and return the samples.

    The same files and seed give the same trips. Raise ScenarioError if SUMO is not installed, or fails.
    """
    with TemporaryDirectory(prefix="vnet-sumo-") as folder:
        output = Path(folder) / "fcd.xml"
        command = [_sumo(path), "-c", str(path), "--seed", str(seed), "--fcd-output", str(output)]
        command += ["--fcd-output.geo", "false", "--no-step-log", "--precision", "6"]
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
