"""`vnet map`: looking at maps, and converting them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table

from emulator.cli.application import group
from emulator.cli.options import pair
from emulator.terminal.console import one_line_errors
from emulator.terminal.live import SafeConsole
from emulator.world.maps.city import SIZE_M, city_roads
from emulator.world.maps.files import read_roads, write_roads, writer_of
from emulator.world.maps.problems import PLACE_M, Calibration, MapReport, calibrate, examine, residuals
from emulator.world.maps.roads import Roads
from emulator.world.projection import CoordinateFrame
from emulator.world.trips.drive import check_trips_name, whole_motion, write_trips
from emulator.world.trips.generate import LEFT, RIGHT, generate_motion
from emulator.world.trips.motion import Motion, Rules
from vnet.errors import ScenarioError, VnetError
from vnet.extras import require
from vnet.types import Array

RATE_HZ = 10.0
"""Rate at which recorded trips are read for a calibration."""
RULES = Rules(fastest_mps=70.0, longest_gap_s=10.0, hardest_mps2=10.0)
"""Cleaning of recorded trips for a calibration: the defaults of [network], and no jump is driven."""


app = group("Look at maps, and convert them.")

MapArgument = Annotated[Path, typer.Argument(metavar="MAP", help="OSM XML or PBF, SUMO .net.xml, GeoJSON or NPZ.")]
OutArgument = Annotated[Path, typer.Argument(metavar="OUT", help="A file: .geojson, .json or .npz.")]
OriginOption = Annotated[
    str | None, typer.Option(metavar="LAT,LON", help="Where the map's metres start; else in its middle.")
]
DriveOnOption = Annotated[Literal["right", "left"], typer.Option(help="On which side people drive.")]


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
        if out is not None:
            if out.suffix.lower() != ".png":
                raise VnetError(f"--out {out}: a picture is written as *.png")
            require(f"--out {out}", "matplotlib")
        roads = read_roads(map_file, pair("--origin", origin))
        middle = pair("--at", at)
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
        _refuse_input(out, "", map_file)
        write_roads(read_roads(map_file, pair("--origin", origin)), out)
        print(f"wrote {out}")


@app.command()
def city(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="*.geojson or *.npz.")],
    seed: Annotated[int, typer.Option(min=0, help="Another seed, another city.")] = 1,
    size_m: Annotated[
        float, typer.Option(metavar="METRES", help="From one end to the other, 1000 to 10000.")
    ] = SIZE_M,
) -> None:
    """Generate a city, the one in which vehicles drive with network.kind = "city"."""
    with one_line_errors():
        writer_of(out)
        roads = city_roads(seed, size_m)
        write_roads(roads, out)
        print(f"wrote {out}: {float(roads.length_m.sum()) / 1000:.1f} km of road")


@app.command()
def trips(
    map_file: MapArgument,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="*.csv or *.parquet.")],
    vehicles: Annotated[int, typer.Option(min=1, max=10_000, help="How many.")] = 50,
    duration: Annotated[float, typer.Option(min=1, max=86_400, metavar="SECONDS", help="For how long.")] = 300.0,
    rate_hz: Annotated[float, typer.Option(min=0.1, max=100, metavar="HZ", help="Samples a second.")] = 10.0,
    seed: Annotated[int, typer.Option(min=0, help="Another seed, other trips.")] = 1,
    drive_on: DriveOnOption = "right",
) -> None:
    """Generate trips along a map: a file for network.kind = "trips", in the map's metres."""
    with one_line_errors():
        check_trips_name(out)
        periods = round(duration * rate_hz) + 1
        motion = generate_motion(
            map_file,
            read_roads(map_file),
            vehicles,
            seed,
            periods,
            round(1e9 / rate_hz),
            LEFT if drive_on == "left" else RIGHT,
        )
        count = write_trips(motion, out, rate_hz)
        print(f"wrote {out}: {len(motion.node_ids)} vehicles, {count:,} samples")


@app.command()
def datum(
    map_file: MapArgument,
    trips_file: Annotated[Path, typer.Argument(metavar="TRIPS", help="*.csv, *.parquet, *.npz or SUMO's FCD.")],
    origin: OriginOption = None,
    drive_on: DriveOnOption = "right",
    others: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Use every other vehicle, and write the trips of the rest: *.csv, *.parquet."
        ),
    ] = None,
) -> None:
    """Find from true trips by how much a map is shifted: keys for [map]. Evaluate on other trips."""
    with one_line_errors():
        if others is not None:
            check_trips_name(others)
            _refuse_input(others, "--others ", trips_file, map_file)
        motion = whole_motion(trips_file, pair("--origin", origin), RATE_HZ, RULES)
        roads = read_roads(map_file, pair("--origin", origin) or motion.origin_deg)
        lanes = roads.lane_map(drive_on)
        used = np.ones(len(motion.node_ids), dtype=np.bool_)
        if others is not None:
            used[1::2] = False
        found = residuals(lanes, motion)
        try:
            result = calibrate(found.of(used))
        except ScenarioError as error:
            raise ScenarioError(f"{map_file}: {error}") from None
        _print_datum(result, int(used.sum()))
        if others is not None:
            try:
                rest = calibrate(found.of(~used))
                alone = f"datum_m = {_metres(rest.datum_m)}, aside_m = {rest.aside_m:.2f}"
            except ScenarioError as error:
                alone = str(error)
            print(f"# the other vehicles alone: {alone}")
            _others(others, motion, used, RATE_HZ)


def _refuse_input(out: Path, option: str, *read: Path) -> None:
    """Raise VnetError if a file that is to be written is one that is read."""
    if out.exists() and any(out.samefile(path) for path in read if path.exists()):
        raise VnetError(f"{option}{out}: is read by this command; name another file")


def _print_datum(result: Calibration, vehicles: int) -> None:
    """Print what has been found as keys of `[map]`."""
    print(f"# {vehicles} vehicles, {result.samples:,} residuals in {result.places} squares of {PLACE_M:g} m")
    print(f"datum_m = {_metres(result.datum_m)}")
    print(f"datum_sigma_m = {float(np.sqrt(np.mean(result.error_m**2))):.2f}")
    print(f"aside_m = {result.aside_m:.2f}")
    print(f"sigma_m = {result.sigma_m:.2f}")


def _metres(pair_m: Array) -> str:
    return f"[{pair_m[0]:.2f}, {pair_m[1]:.2f}]"


def _others(path: Path, motion: Motion, used: NDArray[np.bool_], rate_hz: float) -> None:
    """Write the trips of the vehicles that are not `used`, a mask."""
    rest = replace(
        motion,
        node_ids=tuple(name for name, is_used in zip(motion.node_ids, used.tolist(), strict=True) if not is_used),
        position_m=motion.position_m[:, ~used],
        heading_rad=motion.heading_rad[:, ~used],
    )
    count = write_trips(rest, path, rate_hz)
    print(f"wrote {path}: {len(rest.node_ids)} vehicles, {count:,} samples")


def _part(path: Path, roads: Roads, middle_m: tuple[float, float], side_km: float) -> Roads:
    part = roads.within(*_box(middle_m, side_km))
    if not len(part):
        raise ScenarioError(f"{path}: no road within {side_km:g} km around --at {middle_m[0]:g},{middle_m[1]:g}")
    return part


def _box(middle_m: tuple[float, float], side_km: float) -> tuple[Array, Array]:
    """The south-western and the north-eastern corner of a square, in metres."""
    middle, half_m = np.array(middle_m), side_km * 500
    return middle - half_m, middle + half_m


def _print(path: Path, report: MapReport, frame: CoordinateFrame | None) -> None:
    east, north = report.size_km
    console = SafeConsole()
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
    from emulator.pages.map_picture import draw_map  # matplotlib takes a second to import

    try:
        draw_map(roads, out, title, window)
    except OSError as error:
        raise ScenarioError(f"--out {out}: cannot be written: {error}") from None
    print(f"wrote {out}")
