"""Attributes of a way from its OpenStreetMap tags: access for cars, class, lanes, direction and width."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from emulator.world.maps.classes import CLASSES, LANE_WIDTH_M, MAX_LANE_WIDTH_M, MAX_LANES, MIN_LANE_WIDTH_M, NUMBER

_ONE_WAY_CLASSES = {"motorway", "motorway_link"}
"""Classes whose ways are one-way unless tagged otherwise."""
_ROUND = {"roundabout", "circular"}
"""Values of `junction` whose ways are one-way unless tagged otherwise."""
_WIDTH = re.compile(r"(\d{1,4}(?:\.\d{1,9})?)\s*m?")


@dataclass(frozen=True)
class Street:
    """A way for cars. `lanes` are those in and against its direction.

    `reversed` is true if the direction is against the order of the way's points.
    """

    kind: int
    lanes: tuple[int, int]
    lane_width_m: float
    reversed: bool


def street(tags: Mapping[str, str]) -> Street | None:
    """Return the attributes of a way, or None if it is not for cars. Invalid values of tags are ignored."""
    name = tags.get("highway", "")
    kind = NUMBER.get(name)
    if kind is None or name == "crossing" or tags.get("area") == "yes" or _closed_to_cars(tags):
        return None
    lanes, is_reversed = _lanes(tags, name)
    lane_width_m = float(LANE_WIDTH_M[kind])
    width = _WIDTH.fullmatch(tags.get("width", ""))
    if width and MIN_LANE_WIDTH_M <= float(width[1]) / sum(lanes) <= MAX_LANE_WIDTH_M:
        lane_width_m = float(width[1]) / sum(lanes)
    return Street(kind, lanes, lane_width_m, is_reversed)


def _closed_to_cars(tags: Mapping[str, str]) -> bool:
    for key in ("motorcar", "motor_vehicle", "vehicle", "access"):  # the most specific decides
        if key in tags:
            return tags[key] == "no"
    return False


def _lanes(tags: Mapping[str, str], name: str) -> tuple[tuple[int, int], bool]:
    """Return the lanes forward and backward, and true if forward is against the order of the way's points."""
    is_one_way = name in _ONE_WAY_CLASSES or tags.get("junction") in _ROUND
    one_way = tags.get("oneway", "yes" if is_one_way else "no")
    usual, total = CLASSES[name].lanes, _count(tags.get("lanes"))
    if one_way in ("yes", "true", "1", "-1", "reverse"):
        return (total or usual, 0), one_way in ("-1", "reverse")
    forward, backward = _count(tags.get("lanes:forward")), _count(tags.get("lanes:backward"))
    if total:
        forward = forward or (max(1, total - backward) if backward else max(1, (total + 1) // 2))
        backward = backward or max(1, total - forward)
    return (forward or usual, backward or usual), False


def _count(text: str | None) -> int:
    """Return a number of lanes, or 0 if the tag is missing or invalid."""
    return int(text) if text and re.fullmatch("[0-9]{1,3}", text) and 1 <= int(text) <= MAX_LANES else 0
