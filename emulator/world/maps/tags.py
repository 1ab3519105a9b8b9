"""What OpenStreetMap's tags say of a way: whether cars may use it, its class, lanes, direction and width."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from emulator.world.maps.classes import CLASSES, LANE_WIDTH_M, MOST_LANES, NARROWEST_M, NUMBER, WIDEST_M

_ONE_WAY_CLASSES = {"motorway", "motorway_link"}
_ROUND = {"roundabout", "circular"}
_WIDTH = re.compile(r"(\d{1,4}(?:\.\d{1,9})?)\s*m?")


@dataclass(frozen=True)
class Street:
    """A way for cars. `lanes` are those in and against its direction; `turned` says to turn its points round."""

    kind: int
    lanes: tuple[int, int]
    lane_width_m: float
    turned: bool


def street(tags: Mapping[str, str]) -> Street | None:
    """What is known of a way; None if it is not for cars. Values that cannot be are as if they were not there."""
    name = tags.get("highway", "")
    kind = NUMBER.get(name)
    if kind is None or name == "crossing" or tags.get("area") == "yes" or _closed_to_cars(tags):
        return None
    lanes, turned = _lanes(tags, name)
    lane_width_m = float(LANE_WIDTH_M[kind])
    width = _WIDTH.fullmatch(tags.get("width", ""))
    if width and NARROWEST_M <= float(width[1]) / sum(lanes) <= WIDEST_M:
        lane_width_m = float(width[1]) / sum(lanes)
    return Street(kind, lanes, lane_width_m, turned)


def _closed_to_cars(tags: Mapping[str, str]) -> bool:
    for key in ("motorcar", "motor_vehicle", "vehicle", "access"):  # the most particular decides
        if key in tags:
            return tags[key] == "no"
    return False


def _lanes(tags: Mapping[str, str], name: str) -> tuple[tuple[int, int], bool]:
    """Lanes forward and backward, and whether they are meant against the way's direction."""
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
    """A number of lanes, or 0 where the tag says nothing that can be used."""
    return int(text) if text and re.fullmatch("[0-9]{1,3}", text) and 1 <= int(text) <= MOST_LANES else 0
