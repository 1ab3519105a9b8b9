"""`vnet map`: looking at maps, and converting them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from emulator.terminal import one_line_errors
from emulator.world.maps.files import read_roads, write_roads, writer_of
from emulator.world.maps.problems import MapReport, examine
from emulator.world.maps.roads import Roads
from emulator.world.projection import Frame
from vnet.errors import ScenarioError
from vnet.roads.lanes import Array

app = typer.Typer(no_args_is_help=True, help="Look at maps, and convert them.")

MapArgument = Annotated[Path, typer.Argument(metavar="MAP", help="OSM XML or PBF, SUMO .net.xml, GeoJSON or NPZ.")]
OutArgument = Annotated[Path, typer.Argument(metavar="OUT", help="A file: .geojson, .json or .npz.")]
OriginOption = Annotated[
    str | None, typer.Option(metavar="LAT,LON", help="Where the map's metres start; else in its middle.")
]


@app.command()
def show(
    map_file: MapArgument,
    out: Annotated[Path | None, typer.Option(help="Write a picture (PNG).")] = None,
    origin: OriginOption = None,
    at: Annotated[str | None, typer.Option(metavar="EAST,NORTH", help="The middle of a part, in metres.")] = None,
    side_km: Annotated[float, typer.Option(min=0.01, max=1000, help="The side of that part, in km.")] = 3.0,
) -> None:
    """Say how long a map's roads are and what is odd about it, and draw it."""
    with one_line_errors():
        roads = read_roads(map_file, _pair("--origin", origin))
        middle = _pair("--at", at)
        if middle is not None:
            roads = _part(map_file, roads, middle, side_km)
        report = examine(roads)
        _print(map_file, report, roads.frame)
        if out is not None:
            window = None if middle is None else _box(middle, side_km)
            _draw(roads, out, f"{map_file.name}: {report.length_km:,.1f} km of road", window)


@app.command()
def convert(map_file: MapArgument, out: OutArgument, origin: OriginOption = None) -> None:
    """Write a map as GeoJSON or NPZ, by the name of OUT."""
    with one_line_errors():
        writer_of(out)  # before a large file is read
        write_roads(read_roads(map_file, _pair("--origin", origin)), out)
        print(f"wrote {out}")


def _pair(option: str, text: str | None) -> tuple[float, float] | None:
    """Two numbers, written with a comma."""
    if text is None:
        return None
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        first = second = float("nan")
    if not np.isfinite([first, second]).all():
        raise ScenarioError(f"{option} {text}: two numbers with a comma between them are needed")
    if option == "--origin" and not (abs(first) <= 90 and abs(second) <= 180):
        raise ScenarioError(f"{option} {text}: latitudes are within ±90, longitudes within ±180")
    return first, second


def _part(path: Path, roads: Roads, middle_m: tuple[float, float], side_km: float) -> Roads:
    part = roads.within(*_box(middle_m, side_km))
    if not len(part):
        raise ScenarioError(f"{path}: no road within {side_km:g} km around --at {middle_m[0]:g},{middle_m[1]:g}")
    return part


def _box(middle_m: tuple[float, float], side_km: float) -> tuple[Array, Array]:
    """The south-western and the north-eastern corner of a square, in metres."""
    middle, half_m = np.array(middle_m), side_km * 500
    return middle - half_m, middle + half_m


def _print(path: Path, report: MapReport, frame: Frame | None) -> None:
    east, north = report.size_km
    console = Console()
    print(f"{path.name}: {east:.1f} × {north:.1f} km, {report.roads:,} roads, {report.nodes:,} points")
    print(
        f"{report.length_km:,.1f} km of road, {report.one_way_km:,.1f} km one way; {report.lane_km:,.1f} km of lane"
    )
    if frame is None:
        print("it does not say where on the earth it is")
    else:
        latitude, longitude = frame.to_wgs84(np.zeros(2))
        print(f"its metres start at {latitude:.6f}, {longitude:.6f}")
    table = Table("class", "roads", "km")
    for column in table.columns[1:]:
        column.justify = "right"
    for name, (count, km) in report.by_class.items():
        table.add_row(name, f"{count:,}", f"{km:,.1f}")
    console.print(table)
    for what, how_many in report.problems.items():
        print(f"{what}: {how_many}")


def _draw(roads: Roads, out: Path, title: str, window: tuple[Array, Array] | None) -> None:
    from emulator.world.maps.picture import draw_map  # matplotlib takes a second to import

    try:
        draw_map(roads, out, title, window)
    except (OSError, ValueError) as error:  # a kind of picture that matplotlib does not know is a ValueError
        raise ScenarioError(f"--out {out}: cannot be written: {error}") from None
    print(f"wrote {out}")
