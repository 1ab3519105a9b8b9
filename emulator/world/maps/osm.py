"""OpenStreetMap files, XML or PBF, read by pyosmium: the ways that cars may use."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from emulator.world.maps.classes import CLASSES, LANE_WIDTH_M, MOST_LANES, NARROWEST_M, NUMBER, WIDEST_M
from emulator.world.maps.frame import Frame, frame_around
from emulator.world.maps.roads import Roads, RoadsBuilder
from vnet.errors import ScenarioError, printable

if TYPE_CHECKING:
    from osmium.osm import Way

_ONE_WAY_CLASSES = {"motorway", "motorway_link"}
_ROUND = {"roundabout", "circular"}
_NO_CARS = {"no"}
_WIDTH = re.compile(r"(\d+(?:\.\d+)?)\s*m?")


def read_osm(path: Path, frame: Frame | None) -> Roads:
    """Read roads; the frame is around their middle unless given. Raises ScenarioError that names the way."""
    try:
        import osmium
    except ImportError:
        raise ScenarioError(
            f"{path}: OpenStreetMap files need pyosmium, which is not installed: pip install 'vnet-emulator[maps]'"
        ) from None
    builder = RoadsBuilder(path)
    try:
        processor = osmium.FileProcessor(str(path)).with_locations().with_filter(osmium.filter.KeyFilter("highway"))
        for entity in processor:
            if entity.is_way():
                _add_way(path, builder, entity)
    except (RuntimeError, ValueError, OSError) as error:
        raise ScenarioError(f"{path}: not an OpenStreetMap file: {printable(str(error), 300)}") from None
    degrees = builder.places()
    if not len(degrees):
        raise ScenarioError(f"{path}: no roads that vehicles may use")
    frame = frame or frame_around(degrees[:, 1], degrees[:, 0])
    return builder.build(frame.to_local(degrees[:, 1], degrees[:, 0]), frame)


def _add_way(path: Path, builder: RoadsBuilder, way: Way) -> None:
    tags = dict(way.tags)
    kind = NUMBER.get(tags["highway"])
    if kind is None or tags["highway"] == "crossing" or tags.get("area") == "yes" or _closed_to_cars(tags):
        builder.note("ways not for cars")
        return
    name = f"way {way.id}"
    if len(way.nodes) < 2:
        raise ScenarioError(f"{path}: {name}: {len(way.nodes)} nodes; a road needs two")
    points = []
    for node in way.nodes:
        if not node.location.valid():
            raise ScenarioError(
                f"{path}: {name}: node {node.ref} is not in the file, or not on the earth; cut maps out with whole ways"
            )
        points.append((node.ref, (node.location.lon, node.location.lat)))
    forward, backward = _lanes(tags)
    if backward < 0:  # against the way's direction
        points.reverse()
        backward = 0
    width = _WIDTH.fullmatch(tags.get("width", ""))
    lane_width_m = float(LANE_WIDTH_M[kind])
    if width and NARROWEST_M <= float(width[1]) / (forward + backward) <= WIDEST_M:
        lane_width_m = float(width[1]) / (forward + backward)
    builder.add(name, points, kind, (forward, backward), lane_width_m)


def _closed_to_cars(tags: Mapping[str, str]) -> bool:
    for key in ("motorcar", "motor_vehicle", "vehicle", "access"):  # the most particular decides
        if key in tags:
            return tags[key] in _NO_CARS
    return False


def _lanes(tags: Mapping[str, str]) -> tuple[int, int]:
    """Lanes forward and backward; backward is −1 where the road is one way against its direction."""
    kind = tags["highway"]
    one_way = tags.get("oneway", "yes" if kind in _ONE_WAY_CLASSES or tags.get("junction") in _ROUND else "no")
    each = CLASSES[kind].lanes
    total = _count(tags.get("lanes"))
    if one_way in ("yes", "true", "1"):
        return total or each, 0
    if one_way in ("-1", "reverse"):
        return total or each, -1
    forward, backward = _count(tags.get("lanes:forward")), _count(tags.get("lanes:backward"))
    if total:
        forward = forward or (max(1, total - backward) if backward else max(1, (total + 1) // 2))
        backward = backward or max(1, total - forward)
    return forward or each, backward or each


def _count(text: str | None) -> int:
    """A number of lanes, or 0 where the tag says nothing that can be used."""
    return int(text) if text and text.isascii() and text.isdigit() and 1 <= int(text[:9]) <= MOST_LANES else 0
