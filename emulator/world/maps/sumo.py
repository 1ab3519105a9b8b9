"""SUMO road networks (.net.xml), the lanes that passenger cars may use, each as a road of its own; and polygons.

Files are read by expat as a stream, within bounds. SUMO's own reader (sumolib) cannot name lines in its errors, and
expands all entities that a file declares; here a file that declares any is refused. Coordinates remain SUMO's, so
that they match its trips; its projection, if it states one, becomes the frame.
"""

from __future__ import annotations

import math
import xml.parsers.expat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from emulator.world.buildings import LEAST_CORNERS
from emulator.world.maps.roads import (
    MAX_LANE_WIDTH_M,
    MAX_POINTS,
    MIN_LANE_WIDTH_M,
    NUMBER,
    UNKNOWN,
    Roads,
    RoadsBuilder,
)
from emulator.world.networks import MAX_COORDINATE_M
from emulator.world.projection import CoordinateFrame
from vnet.errors import ScenarioError, printable, shown

LARGEST_BYTES = 2**31
"""Largest file that is read."""
_CHUNK_BYTES = 2**20
"""Bytes that are parsed at once."""
_SUMO_WIDTH_M = 3.2
"""Width of a lane that does not state it: SUMO's default."""
_NO_ROADS = {"crossing", "walkingarea", "connector"}
"""Functions of edges that are not roads."""
_CARS = {"passenger", "all", "private"}
"""SUMO's vehicle classes that include passenger cars."""


@dataclass
class _Lane:
    name: str
    kind: int
    width_m: float
    points: list[tuple[float, float]]
    ends: tuple[str, str] | None


class _Reader:
    """Handlers for expat; they keep the lanes of all edges until the opposite edges are known."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._parser = xml.parsers.expat.ParserCreate()
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.StartDoctypeDeclHandler = self._refuse_doctype
        self._depth = 0
        self._edge: dict[str, str] | None = None
        self.frame: CoordinateFrame | None = None
        self.lanes: list[_Lane] = []
        self._points_left = MAX_POINTS
        self.edge_ends: set[tuple[str, str]] = set()
        self.skipped = 0

    def wrong(self, problem: str) -> ScenarioError:
        """Return an error that names the line being read."""
        return ScenarioError(f"{self._path}: line {self._parser.CurrentLineNumber}: {problem}")

    def read(self) -> None:
        """Read the file."""
        size = 0
        try:
            with self._path.open("rb") as file:
                while chunk := file.read(_CHUNK_BYTES):
                    size += len(chunk)
                    if size > LARGEST_BYTES:
                        raise self.wrong(f"larger than {LARGEST_BYTES} bytes")
                    self._parser.Parse(chunk)
                self._parser.Parse(b"", True)
        except OSError as error:
            raise ScenarioError(f"{self._path}: cannot be read: {error.strerror}") from None
        except xml.parsers.expat.ExpatError as error:
            problem = xml.parsers.expat.ErrorString(error.code)
            raise ScenarioError(f"{self._path}: line {error.lineno}: not XML: {problem}") from None
        except (LookupError, ValueError) as error:  # an encoding that is unknown or not supported
            raise self.wrong(f"not XML: {printable(str(error))}") from None

    def _refuse_doctype(self, *_: object) -> None:
        raise self.wrong("a document type declaration; files of SUMO have none")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth == 1 and name != "net":
            raise self.wrong(f"<{printable(name)}>: a network of SUMO starts with <net>")
        handlers: dict[str, Callable[[dict[str, str]], None]] = {
            "location": self._location,
            "edge": self._start_edge,
            "lane": self._lane,
        }
        if name in handlers:
            handlers[name](attributes)

    def _end(self, name: str) -> None:
        self._depth -= 1
        if name == "edge":
            self._edge = None

    def _location(self, attributes: dict[str, str]) -> None:
        proj = attributes.get("projParameter", "!")
        if proj.startswith("+"):
            points = self._points(attributes.get("netOffset", "0,0"), "netOffset")
            if len(points) != 1:
                raise self.wrong("netOffset: one x,y in metres is needed")
            try:
                self.frame = CoordinateFrame.named(proj, points[0])
            except ScenarioError as error:
                raise self.wrong(str(error)) from None

    def _start_edge(self, attributes: dict[str, str]) -> None:
        self._edge = attributes
        if "from" in attributes and "to" in attributes:
            self.edge_ends.add((attributes["from"], attributes["to"]))

    def _lane(self, attributes: dict[str, str]) -> None:
        edge = self._edge
        if edge is None:
            raise self.wrong("<lane> outside of an <edge>")
        if edge.get("function") in _NO_ROADS or not _for_cars(attributes):
            self.skipped += 1
            return
        name = attributes.get("id", "")
        points = self._points(attributes.get("shape", ""), f"lane {printable(name)}: shape")
        if len(points) < 2:
            raise self.wrong(f"lane {printable(name)}: a shape of two points or more is needed")
        kind = NUMBER.get(edge.get("type", "").rpartition(".")[2], UNKNOWN)
        if edge.get("function") == "internal":
            kind = NUMBER["crossing"]
        ends = (edge["from"], edge["to"]) if "from" in edge and "to" in edge else None
        self.lanes.append(_Lane(f"lane {name}", kind, self._width_m(attributes), points, ends))

    def _width_m(self, attributes: dict[str, str]) -> float:
        text = attributes.get("width", str(_SUMO_WIDTH_M))
        try:
            width_m = float(text)
        except ValueError:
            width_m = math.nan
        if not 0 < width_m <= MAX_LANE_WIDTH_M:
            raise self.wrong(
                f"width = {shown(text)}: a positive number of metres up to {MAX_LANE_WIDTH_M:g} is needed"
            )
        return max(width_m, MIN_LANE_WIDTH_M)

    def _points(self, text: str, name: str) -> list[tuple[float, float]]:
        """Return the points of a text `x,y x,y …`, without heights; `name` is used in errors."""
        points = []
        for part in text.split():
            try:
                numbers = [float(number) for number in part.split(",")]
            except ValueError:
                numbers = []
            if len(numbers) not in (2, 3) or not all(abs(number) <= MAX_COORDINATE_M for number in numbers):
                raise self.wrong(f"{name}: {shown(part)}: x,y in metres is needed")
            points.append((numbers[0], numbers[1]))
        self._points_left -= len(points)
        if self._points_left < 0:
            raise self.wrong(f"more than {MAX_POINTS} points; cut out a part first")
        return points


class _Polygons(_Reader):
    """Handlers for a file of polygons, as polyconvert writes it."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.buildings: list[list[tuple[float, float]]] = []

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth == 1 and name not in ("additional", "shapes"):
            raise self.wrong(f"<{printable(name)}>: a file of SUMO's polygons starts with <additional>")
        if name != "poly" or not attributes.get("type", "").startswith("building"):
            return
        where = f"poly {printable(attributes.get('id', ''))}"
        if attributes.get("geo", "0") in ("1", "true", "yes"):
            raise self.wrong(f"{where}: geo = {attributes['geo']}: polygons in metres are needed")
        points = self._points(attributes.get("shape", ""), f"{where}: shape")
        if len(set(points)) < LEAST_CORNERS:
            raise self.wrong(f"{where}: shape: three corners or more are needed")
        self.buildings.append(points[:-1] if points[0] == points[-1] else points)


def read_sumo_polygons(path: Path) -> list[list[tuple[float, float]]]:
    """Return the corners in metres of each polygon whose type begins with `building`.

    Raise ScenarioError, naming the line, for a bad file.
    """
    reader = _Polygons(path)
    reader.read()
    return reader.buildings


def _for_cars(lane: dict[str, str]) -> bool:
    allowed, refused = lane.get("allow", "").split(), lane.get("disallow", "").split()
    if allowed:
        return not _CARS.isdisjoint(allowed)
    return _CARS.isdisjoint(refused)


def read_sumo(path: Path, origin_deg: tuple[float, float] | None) -> Roads:
    """Read the lanes; metres are SUMO's own unless an origin is given.

    Raise ScenarioError, naming the line, for a bad file.
    """
    reader = _Reader(path)
    reader.read()
    builder = RoadsBuilder(path)
    if reader.skipped:
        builder.notes["lanes not for cars"] = reader.skipped
    for lane in reader.lanes:
        # The ends of lanes inside intersections equal those of the lanes that they join, to the centimetre.
        points = [((round(100 * x), round(100 * y)), (x, y)) for x, y in lane.points]
        one_way = lane.ends is None or lane.ends[::-1] not in reader.edge_ends
        builder.add(lane.name, points, lane.kind, (1, 0), lane.width_m, one_way)
    return builder.build(builder.coordinates(), reader.frame).around(path, origin_deg)
