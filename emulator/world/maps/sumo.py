"""SUMO road networks (.net.xml): the lanes that passenger cars may use, each as a road of its own.

Read by expat as a stream, within bounds. SUMO's own reader (sumolib) knows no lines to name in an error, and
expands whatever entities a file declares; here a file that declares any is refused. Coordinates stay SUMO's, so
that its traces fit; its projection, if it states one, becomes the frame.
"""

from __future__ import annotations

import math
import xml.parsers.expat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from emulator.world.maps.classes import NARROWEST_M, NUMBER, UNKNOWN, WIDEST_M
from emulator.world.maps.roads import MOST_POINTS, Roads, RoadsBuilder
from emulator.world.networks import FARTHEST_M
from emulator.world.projection import Frame
from vnet.errors import ScenarioError, printable, shown

LARGEST_BYTES = 2**31
_CHUNK_BYTES = 2**20
_SUMO_WIDTH_M = 3.2
"""Of a lane that does not say; SUMO's default."""
_NO_ROADS = {"crossing", "walkingarea", "connector"}
_CARS = {"passenger", "all", "private"}


@dataclass
class _Lane:
    name: str
    kind: int
    width_m: float
    points: list[tuple[float, float]]
    ends: tuple[str, str] | None


class _Reader:
    """What expat calls; keeps the lanes of all edges until it is known which have an opposite."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._parser = xml.parsers.expat.ParserCreate()
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.StartDoctypeDeclHandler = self._refuse_doctype
        self._depth = 0
        self._edge: dict[str, str] | None = None
        self.frame: Frame | None = None
        self.lanes: list[_Lane] = []
        self._points_left = MOST_POINTS
        self.pairs: set[tuple[str, str]] = set()
        self.left_out = 0

    def wrong(self, what: str) -> ScenarioError:
        """An error at the line that is being read."""
        return ScenarioError(f"{self._path}: line {self._parser.CurrentLineNumber}: {what}")

    def read(self) -> None:
        """Read the whole file."""
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
            what = xml.parsers.expat.ErrorString(error.code)
            raise ScenarioError(f"{self._path}: line {error.lineno}: not XML: {what}") from None
        except (LookupError, ValueError) as error:  # an encoding that Python does not know, or has more bytes
            raise self.wrong(f"not XML: {printable(str(error))}") from None

    def _refuse_doctype(self, *_: object) -> None:
        raise self.wrong("a document type declaration; networks of SUMO have none")

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
                self.frame = Frame.named(proj, points[0])
            except ScenarioError as error:
                raise self.wrong(str(error)) from None

    def _start_edge(self, attributes: dict[str, str]) -> None:
        self._edge = attributes
        if "from" in attributes and "to" in attributes:
            self.pairs.add((attributes["from"], attributes["to"]))

    def _lane(self, attributes: dict[str, str]) -> None:
        edge = self._edge
        if edge is None:
            raise self.wrong("<lane> outside of an <edge>")
        if edge.get("function") in _NO_ROADS or not _for_cars(attributes):
            self.left_out += 1
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
        if not 0 < width_m <= WIDEST_M:
            raise self.wrong(f"width = {shown(text)}: a positive number of metres up to {WIDEST_M:g} is needed")
        return max(width_m, NARROWEST_M)

    def _points(self, text: str, what: str) -> list[tuple[float, float]]:
        """Points written as `x,y x,y …`, a height ignored."""
        points = []
        for part in text.split():
            try:
                numbers = [float(number) for number in part.split(",")]
            except ValueError:
                numbers = []
            if len(numbers) not in (2, 3) or not all(abs(number) <= FARTHEST_M for number in numbers):
                raise self.wrong(f"{what}: {shown(part)}: x,y in metres is needed")
            points.append((numbers[0], numbers[1]))
        self._points_left -= len(points)
        if self._points_left < 0:
            raise self.wrong(f"more than {MOST_POINTS} points; cut out a part first")
        return points


def _for_cars(lane: dict[str, str]) -> bool:
    allowed, refused = lane.get("allow", "").split(), lane.get("disallow", "").split()
    if allowed:
        return not _CARS.isdisjoint(allowed)
    return _CARS.isdisjoint(refused)


def read_sumo(path: Path, origin_deg: tuple[float, float] | None) -> Roads:
    """Read the lanes; metres are SUMO's own unless an origin is given. Raises ScenarioError that names the line."""
    reader = _Reader(path)
    reader.read()
    builder = RoadsBuilder(path)
    if reader.left_out:
        builder.notes["lanes not for cars"] = reader.left_out
    for lane in reader.lanes:
        # The ends of lanes inside crossings are those of the lanes they join, to the centimetre.
        points = [((round(100 * x), round(100 * y)), (x, y)) for x, y in lane.points]
        one_way = lane.ends is None or lane.ends[::-1] not in reader.pairs
        builder.add(lane.name, points, lane.kind, (1, 0), lane.width_m, one_way)
    return builder.build(builder.places(), reader.frame).around(path, origin_deg)
