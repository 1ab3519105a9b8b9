"""`[network]` and `[map]`: vehicles, their positions or their drivers (programs, SUMO), and their roads."""

from __future__ import annotations

import math
import re
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn
from xml.parsers import expat

from pydantic import Field, model_validator

from emulator.scenario.program import Entry
from emulator.scenario.sections import DAY_S, FAR_M, FAR_S, WILD_M, Section, Switch
from vnet.bounded import read_bounded
from vnet.errors import ScenarioError, shown
from vnet.transport.keys import is_segment
from vnet.units import NS_PER_S

LIBSUMO = "libsumo"
"""The package that has SUMO as a library, and its name among the inputs of a run."""
VehicleId = Annotated[str, Field(min_length=1, max_length=200)]
LARGEST_BYTES = 1 << 20
LATEST_S = 1e9
_UNITS_S = (1.0, 60.0, 3600.0, 86400.0)
_UNSAFE = re.compile(r"[^A-Za-z0-9_.]|^[_.]")
"""Characters of an id that are escaped where one of them cannot be part of a key."""
Speed = Annotated[float, Field(ge=0, le=100)]
Place = Annotated[float, Field(ge=0, le=100_000)]
_SYNONYMS = {
    **dict.fromkeys(("n", "net"), "net-file"),
    **dict.fromkeys(("r", "route", "routes"), "route-files"),
    **dict.fromkeys(("a", "additional"), "additional-files"),
    "b": "begin",
}
"""Other names of options in SUMO's configurations, and those that its manual uses."""
OF_TRIPS = ("start_s", "max_vehicles", "disc", "origin_deg")
"""Keys of `[network]` for vehicles that move."""
NO_PATH = 'path is required with kind = "file", "trips" or "sumo", and only then'
Shift = Annotated[float, Field(ge=-FAR_M, le=FAR_M)]
OriginDeg = tuple[Annotated[float, Field(ge=-84, le=84)], Annotated[float, Field(ge=-180, le=180)]]


class Sumo(Section):
    """`[network.sumo]`: which vehicles have programs, with `kind = "sumo"` and `step = true`."""

    nodes: tuple[VehicleId, ...] | None = Field(None, min_length=1)
    """Vehicles that have a program, by their ids in SUMO; if left out those that SUMO inserts first,
    `max_vehicles` of them, or all. The others drive, have no radio, and react."""
    lights_to: tuple[VehicleId, ...] = ()
    """Nodes that read the state of every traffic light with each fix, in `fix.sensors["traffic_lights"]`."""


def libsumo_build() -> str | None:
    """Return version and build of the libsumo that is installed, without importing it; None if there is none.

    The build is the wheel's platform: the same sources, built by another compiler, may round otherwise.
    """
    try:
        found = distribution(LIBSUMO)
    except PackageNotFoundError:
        return None
    tags = [line for line in (found.read_text("WHEEL") or "").splitlines() if line.startswith("Tag: ")]
    return " ".join([found.version, *sorted({tag.rpartition("-")[2] for tag in tags})])


def input_files(path: Path) -> list[Path]:
    """The files that SUMO reads with a configuration, so far as it names them and they are there.

    Raises ScenarioError if it is no configuration.
    """
    values = _values(path)
    named = [
        name for key, value in values.items() if key.endswith(("-file", "-files")) for name in value.split(",")
    ]
    files = [path.parent / name.strip() for name in named if name.strip()]
    return sorted({file.resolve() for file in files if file.is_file()})


def read_begin_s(path: Path) -> float:
    """The time in seconds at which a configuration begins. Raises ScenarioError."""
    text = _values(path).get("begin", "0")
    try:  # seconds, or days:hours:minutes:seconds
        begin_s = sum(float(part) * unit for part, unit in zip(reversed(text.split(":")), _UNITS_S, strict=False))
    except ValueError:
        begin_s = math.nan
    if not 0 <= begin_s <= LATEST_S:
        raise ScenarioError(f"{path}: begin = {shown(text)}: seconds, or hours:minutes:seconds, from 0 on")
    return begin_s


def _values(path: Path) -> dict[str, str]:
    """Return each option's value in a configuration, without output files."""
    values: dict[str, str] = {}
    sections: list[str] = []
    parser = expat.ParserCreate()

    def start(name: str, attributes: dict[str, str]) -> None:
        if not sections and name not in ("configuration", "sumoConfiguration"):
            raise ScenarioError(
                f"{path}: line {parser.CurrentLineNumber}: element {name!r} is no configuration of SUMO"
            )
        if "output" not in sections:
            values[_SYNONYMS.get(name, name)] = attributes.get("value", attributes.get("v", ""))
        sections.append(name)

    def doctype(*_: object) -> NoReturn:
        raise ScenarioError(f"{path}: line {parser.CurrentLineNumber}: a document type; SUMO writes none")

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda name: sections.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(read_bounded(path, LARGEST_BYTES), True)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, LookupError, expat.ExpatError) as error:  # an unknown encoding is a LookupError
        raise ScenarioError(f"{path}: not a SUMO configuration: {error}") from None
    return values


def node_id(given: str) -> str:
    """Return the id of a node for an id in a file: itself if keys can hold it, else with characters escaped.

    Any character but letters, digits, `_` and `.` becomes its code in hexadecimal between hyphens, as `#` becomes
    `-23-`; so does a hyphen, so that the given id can be read from the escaped one. An `x` goes before what does
    not begin with a letter or a digit.
    """
    if is_segment(given) or not given.isprintable():
        return given
    escaped = _UNSAFE.sub(lambda found: f"-{ord(found[0]):x}-", given)
    return f"x{escaped}" if escaped.startswith("-") else escaped


class Driven(Section):
    """`[network.driven]`: the road, where vehicles are at the start, and how they move (`kind = "driven"`)."""

    road: Literal["straight", "ring", "map"] = "straight"
    """Shape of the road. Vehicles that come to the end of a `straight` one leave the network; a `ring` has none.
    With `map` they drive on the roads of `[map]`, or without it in a generated city (`network.size_m`, `seed`)."""
    routes: tuple[Annotated[tuple[str, ...], Field(min_length=1)], ...] | None = Field(None, min_length=1)
    """`map`: roads that vehicles follow, by their names in the map's file, such as `["way 12", "-way 7"]`; `-` for
    one against its direction. Vehicles have the routes in turn. If left out, each vehicle starts anywhere, and
    takes any exit of each junction, but dead ends; `network.seed` draws them."""
    length_m: float = Field(5000.0, ge=100, le=100_000)
    """Length of the road: of a ring the circumference of its rightmost lane."""
    lanes: int = Field(1, ge=1, le=12)
    """Number of lanes, all in one direction; lane 0 is the rightmost. A map has lanes of its own."""
    lane_width_m: float = Field(3.5, ge=2, le=10)
    """Width of a lane. A map has widths of its own."""
    gap_m: float = Field(30.0, gt=0, le=10_000)
    """Clear distance at the start between a vehicle and the next in its lane, the first one being the foremost.
    Where routes are drawn it is the least distance between two in a street."""
    speed_mps: Speed | tuple[Speed, ...] = 20.0
    """Speed at the start, of all vehicles or of each."""
    start_m: tuple[Place, ...] | None = None
    """Position of each vehicle's centre along the road, or its route, at the start, in place of `gap_m`."""
    start_lanes: tuple[Annotated[int, Field(ge=0, le=11)], ...] | None = None
    """Lane of each vehicle at the start; if left out vehicles are put into the lanes in turn."""
    lag_s: float = Field(0.3, ge=0, le=10)
    """Time constant with which the acceleration follows what the program asks for."""
    max_acceleration_mps2: float = Field(3.0, gt=0, le=100)
    """Largest acceleration; what a program asks for beyond it is limited, with an event."""
    max_braking_mps2: float = Field(8.0, gt=0, le=100)
    """Largest deceleration."""
    max_speed_mps: float = Field(50.0, gt=0, le=100)
    """Largest speed. Vehicles do not reverse."""
    vehicle_length_m: float = Field(4.5, ge=1, le=30)
    """Length of a vehicle."""
    vehicle_width_m: float = Field(1.8, gt=0, le=4)
    """Width of a vehicle. Two collide where their rectangles overlap."""
    lane_change_s: float = Field(4.0, gt=0, le=60)
    """Duration of a lane change."""

    @model_validator(mode="after")
    def _fits_the_road(self) -> Driven:
        if any(speed > self.max_speed_mps for speed in self.speeds_mps(1)):
            raise ValueError(f"speed_mps: at most max_speed_mps = {self.max_speed_mps:g}")
        if self.road == "map":
            return self._fits_a_map()
        if self.routes is not None:
            raise ValueError(f'routes goes with road = "map", not with "{self.road}"')
        if any(lane >= self.lanes for lane in self.start_lanes or ()):
            raise ValueError(f"start_lanes: the lanes are 0 to {self.lanes - 1}")
        if any(place > self.length_m for place in self.start_m or ()):
            raise ValueError(f"start_m: at most length_m = {self.length_m:g}")
        if self.vehicle_width_m > self.lane_width_m:
            raise ValueError(f"vehicle_width_m: at most lane_width_m = {self.lane_width_m:g}")
        if self.road == "ring" and self.length_m / (2 * math.pi) <= self.lanes * self.lane_width_m:
            raise ValueError(f"length_m = {self.length_m:g}: too short for a ring of {self.lanes} lanes")
        return self

    def _fits_a_map(self) -> Driven:
        fields = type(self).model_fields
        for name in ("length_m", "lanes", "lane_width_m"):
            if getattr(self, name) != fields[name].default:
                raise ValueError(
                    f'{name} goes with road = "straight" or "ring": a map has roads and lanes of its own'
                )
        if self.routes is None and (self.start_m is not None or self.start_lanes is not None):
            raise ValueError('start_m and start_lanes need routes where road = "map"')
        return self

    def speeds_mps(self, vehicles: int) -> tuple[float, ...]:
        """Return the speed at the start of each of so many vehicles, if they have one in common."""
        return self.speed_mps if isinstance(self.speed_mps, tuple) else (self.speed_mps,) * vehicles


class Ranging(Section):
    """`[world.ranging]`: a sensor in each driven vehicle for the gap to the one ahead; without it there is none."""

    range_m: float = Field(150.0, gt=0, le=10_000)
    """Largest gap that is measured."""
    sigma_m: float = Field(0.1, ge=0, le=WILD_M)
    """Standard deviation of the gap: by default that of a radar for cars."""
    rate_sigma_mps: float = Field(0.1, ge=0, le=WILD_M)
    """Standard deviation of the gap's rate of change."""


def control_step_ns(control_hz: float) -> int:
    """Return the time between two control instants in nanoseconds."""
    return round(NS_PER_S / control_hz)


class Network(Section):
    """`[network]`: which vehicles there are and where they are, or how they drive."""

    kind: Literal["generated", "file", "trips", "sumo", "city", "driven", "own"] = "generated"
    """`generated` draws `vehicles` in a `layout`, `file` reads where they stand; `trips` reads how they drive,
    `sumo` has SUMO drive, and in a `city`, a generated one or that of `[map]`, `vehicles` drive anywhere; `driven`
    ones are driven by their programs. `own` ones are where a function of yours says; `FILE.py:function` or
    `module:function` in place of a kind is `own` with this `function`."""
    function: Entry | None = None
    """`own`: a function of seed, vehicles and duration_s that returns samples of each vehicle, by id."""
    path: Path | None = None
    """Relative to the scenario file. `file`: CSV with the columns id, x_m, y_m (east, north), heading_rad; `trips`:
    CSV, Parquet, NPZ, or SUMO's FCD (XML); `sumo`: a `.sumocfg`."""
    vehicles: int = Field(38, ge=1, le=10_000)
    """Number of generated vehicles; their ids are v01, v02, …, of 100 or more v001, v002, …"""
    layout: Literal["urban", "dense"] = "urban"
    """`urban` has the degrees and components of the published networks; `dense` packs all into 4.2 km by 4.2 km."""
    size_m: float = Field(3000.0, ge=1000, le=10_000)
    """Extent of the generated city, from one end to the other."""
    seed: int = Field(1, ge=0, lt=2**63)
    """Draws the generated network, the city and its traffic, or SUMO's traffic, and nothing of the run."""
    start_s: float | None = Field(None, ge=-FAR_S, le=FAR_S)
    """Trips: at which time of the file the run begins; at its first sample's, or SUMO's beginning, if left out."""
    max_vehicles: int | None = Field(None, ge=1, le=10_000)
    """Trips: no more than so many vehicles, those that enter first."""
    disc: tuple[float, float, Annotated[float, Field(gt=0, le=FAR_M)]] | None = None
    """Trips: vehicles are there only within this disc, x, y, radius in m."""
    origin_deg: OriginDeg | None = None
    """Trips in degrees: latitude and longitude of x = y = 0 m; the middle of the trips if left out."""
    fastest_mps: float = Field(70.0, gt=0, le=1000)
    """Trips: what is faster is a jump."""
    longest_gap_s: float = Field(10.0, gt=0, le=DAY_S)
    """Trips: so long without a sample a vehicle drives straight on; for longer it has left."""
    max_acceleration_mps2: float | None = Field(None, gt=0, le=FAR_M)
    """Trips: where a vehicle would need a greater acceleration, in the mean of half a second, it leaves, and enters
    again behind; such jumps are driven if left out. Vehicles reach 10."""
    impossible_trips: Literal["leave_out", "refuse"] = "leave_out"
    """Trips: a vehicle with many steps that no vehicle can make is left out, which one line says, or the run is
    refused. If most vehicles are so, units or ids are wrong, and the run is refused in any case."""

    step: Switch = False
    """`sumo`: SUMO is stepped with the run, and programs drive their vehicles among its others; else it has driven
    all of them before the run begins."""

    driven: Driven | None = None
    """Road and dynamics of driven vehicles; `kind = "driven"` has them by default."""
    sumo: Sumo | None = None
    """Vehicles of SUMO that have programs; goes with `step`."""

    @property
    def moves(self) -> bool:
        """True if vehicles drive, enter and leave."""
        return self.kind in ("trips", "sumo", "city", "driven", "own")

    @property
    def programs_drive(self) -> bool:
        """True if programs drive their vehicles, so that the truth comes to be as the run goes on."""
        return self.kind == "driven" or self.step

    @model_validator(mode="before")
    @classmethod
    def _kind_may_be_a_function(cls, data: Any) -> Any:
        kind = data.get("kind") if isinstance(data, dict) else None
        if isinstance(kind, str) and (":" in kind or kind.endswith(".py")) and "function" not in data:
            return data | {"kind": "own", "function": kind}
        return data

    @model_validator(mode="after")
    def _keys_go_with_their_kind(self) -> Network:
        if (self.function is not None) != (self.kind == "own"):
            raise ValueError('function goes with kind = "own", and is required there')
        if (self.kind not in ("generated", "city", "driven", "own")) != (self.path is not None):
            raise ValueError(f'path is required with kind = "{self.kind}"' if self.path is None else NO_PATH)
        given = [name for name in OF_TRIPS if getattr(self, name) is not None]
        if given and self.kind not in ("trips", "sumo", "own"):
            raise ValueError(f'{given[0]} goes with kind = "trips" or "sumo", not with "{self.kind}"')
        if self.driven is not None and self.kind != "driven":
            raise ValueError(f'driven goes with kind = "driven", not with "{self.kind}"')
        if self.step and self.kind != "sumo":
            raise ValueError(f'step goes with kind = "sumo", not with "{self.kind}"')
        if self.sumo is not None and not self.step:
            raise ValueError("sumo goes with step = true")
        if self.step and self.disc is not None:
            raise ValueError("disc goes not with step = true: vehicles are there as long as SUMO has them")
        if self.sumo is not None and self.sumo.nodes is not None and self.max_vehicles is not None:
            raise ValueError("max_vehicles goes not with sumo.nodes, which names the vehicles")
        return self


OSM_ENDINGS = (".osm", ".pbf")
"""Endings of files of OpenStreetMap."""


class Map(Section):
    """`[map]`: the roads on which vehicles drive, as programs know them. Without it they know none."""

    path: Path
    """Relative to the scenario file: OpenStreetMap's XML or PBF, SUMO's `.net.xml`, GeoJSON or NPZ."""
    drive_on: Literal["right", "left"] = "right"
    """On which side of the road people drive."""
    origin_deg: OriginDeg | None = None
    """Latitude and longitude of x = y = 0 m, if the map is in degrees and the trips are not; else the trips'."""
    sigma_m: float = Field(0.0, ge=0, le=WILD_M)
    """Standard deviation by which true lanes stray from the map's: programs trust it no further."""
    aside_m: float = Field(0.0, ge=-FAR_M, le=FAR_M)
    """Mean distance of the driven line to the right of the map's lanes; negative: to the left."""
    datum_m: tuple[Shift, Shift] = (0.0, 0.0)
    """Shift of the map, east and north, before programs get it; `vnet map datum` finds it from trips."""
    datum_sigma_m: float = Field(0.0, ge=0, le=WILD_M)
    """Standard deviation in each axis by which the whole map may still be shifted. Nobody can tell that from the
    common error: programs add it to the covariances that they state, not to what they exchange."""
    margin_m: float = Field(300.0, ge=0, le=FAR_M)
    """Programs are given the roads within so much of the box in which vehicles drive."""

    @property
    def side(self) -> float:
        """1 where people drive on the right, else -1."""
        return 1.0 if self.drive_on == "right" else -1.0
