"""Paths of vehicles on a map: the rightmost lane of each link, and the turn from each link to the next."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from emulator.world.driven.map_links import CORNER_M, Links
from vnet.types import Array

SHARE = 0.45
"""Greatest share of a link, or of a straight part of it, that a turn at one of its ends takes."""
TURN_POINTS = 13
"""Points of the path of a turn."""
ARC_POINTS = 7
"""Points of the arc that rounds a corner: of a right angle one every 15°."""
_SAME_M = 1e-6
"""Points closer than this are the same."""
_MIN_ONE_PLUS_COSINE = 0.5
"""Lower bound of 1 + cos(turn): at a turn sharper than 120° the corner of a lane is cut off."""


@dataclass(frozen=True, eq=False)
class Path:
    """Centre line (n, 2) of the rightmost lane of a link or a turn, with its headings (n,), which are unwrapped.

    `lanes` and `width_m` are the number of lanes and their width at its beginning and at its end.
    """

    point_m: Array
    heading_rad: Array
    lanes: tuple[int, int]
    width_m: tuple[float, float]

    @cached_property
    def along_m(self) -> Array:
        """Distances (n,) of the points from the first, along the line."""
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.point_m, axis=0).T))])

    @property
    def length_m(self) -> float:
        """Length of the line."""
        return float(self.along_m[-1])

    def at(self, along_m: float, left_m: float) -> Array:
        """Return the position (2,) at a distance from the beginning, to the left of the line."""
        east_m, north_m, heading_rad = (
            np.interp(along_m, self.along_m, values) for values in (*self.point_m.T, self.heading_rad)
        )
        return np.array([east_m - left_m * np.sin(heading_rad), north_m + left_m * np.cos(heading_rad)])


class Paths:
    """The paths of links and turns on `links`, made and numbered as they are asked for.

    `side` is 1 where people drive on the right, else -1; vehicles drive `aside_m` to the right of the lanes.
    """

    def __init__(self, links: Links, side: float, aside_m: float) -> None:
        self._links, self._side, self._aside_m = links, side, aside_m
        self.paths: list[Path] = []
        self._of_link: dict[int, int] = {}
        self._of_turn: dict[tuple[int, int], int | None] = {}

    def of_link(self, link: int) -> int:
        """Return the number of a link's path."""
        if link not in self._of_link:
            self._of_link[link] = self._add(self._make(link))
        return self._of_link[link]

    def of_turn(self, link: int, other: int) -> int | None:
        """Return the number of the path from the end of a link to another; None if they join without any."""
        if (link, other) not in self._of_turn:
            one, then = self.paths[self.of_link(link)], self.paths[self.of_link(other)]
            near = np.hypot(*(then.point_m[0] - one.point_m[-1])) < _SAME_M
            self._of_turn[link, other] = None if near else self._add(_turn(one, then))
        return self._of_turn[link, other]

    def _add(self, path: Path) -> int:
        self.paths.append(path)
        return len(self.paths) - 1

    def _make(self, link: int) -> Path:
        links = self._links
        line_m = links.line_m(link)
        most_m = SHARE * float(links.length_m[link])
        ends_m = [min(links.cut_m(int(point)), most_m) for point in (links.start[link], links.end[link])]
        lane_m = offset_line(cut_line(line_m, *ends_m), links.offset_m(link, self._side) + self._aside_m)
        lanes, width_m = int(links.lanes[link]), float(links.roads.lane_width_m[links.road[link]])
        return Path(*rounded(lane_m), (lanes, lanes), (width_m, width_m))


def cut_line(line_m: Array, begin_m: float, end_m: float) -> Array:
    """Return a line (n, 2) without so much of its beginning and of its end."""
    along_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line_m, axis=0).T))])
    last_m = along_m[-1] - end_m
    is_new = np.diff(along_m, prepend=-1.0) > _SAME_M
    inner = np.flatnonzero(is_new & (along_m > begin_m + _SAME_M) & (along_m < last_m - _SAME_M))
    ends = np.column_stack([np.interp([begin_m, last_m], along_m, axis) for axis in line_m.T])
    return np.concatenate([ends[:1], line_m[inner], ends[1:]])


def offset_line(line_m: Array, right_m: float) -> Array:
    """Return a line (n, 2) moved to the right, without parts that this would reverse on the inside of a curve."""
    if not right_m:
        return line_m
    step = np.diff(line_m, axis=0)
    right = np.column_stack([step[:, 1], -step[:, 0]]) / np.hypot(*step.T)[:, None]
    inner = right[1:] + right[:-1]
    scale = np.maximum(1 + np.einsum("ij,ij->i", right[1:], right[:-1]), _MIN_ONE_PLUS_COSINE)
    moved_m = line_m + right_m * np.concatenate([right[:1], inner / scale[:, None], right[-1:]])
    if (np.einsum("ij,ij->i", np.diff(moved_m, axis=0), step) > 0).all():
        return np.asarray(moved_m)
    kept = [0]
    for k in range(1, len(line_m)):
        if float((moved_m[k] - moved_m[kept[-1]]) @ step[k - 1]) > 0:
            kept.append(k)
    if len(kept) == 1:
        kept.append(len(line_m) - 1)
    return np.asarray(moved_m[kept])


def rounded(line_m: Array) -> tuple[Array, Array]:
    """Return the points (n, 2) and the unwrapped headings (n,) of a line whose corners are arcs."""
    step = np.diff(line_m, axis=0)
    length_m = np.hypot(*step.T)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    ahead = step / length_m[:, None]
    corner = np.flatnonzero(np.abs(np.diff(heading)) > _SAME_M)
    before, after, point_m = ahead[corner, None], ahead[corner + 1, None], line_m[corner + 1, None]
    cut_m = np.minimum(CORNER_M, SHARE * np.minimum(length_m[corner], length_m[corner + 1]))[:, None, None]
    # Quadratic Bézier curves with the corners as their control points.
    t = np.linspace(0, 1, ARC_POINTS)[:, None]
    arc_m = point_m + cut_m * (t**2 * after - (1 - t) ** 2 * before)
    tangent = (1 - t) * before + t * after
    start_rad = heading[corner, None]
    arc_rad = start_rad + _wrapped(np.arctan2(tangent[..., 1], tangent[..., 0]) - start_rad)
    points_m = np.concatenate([line_m[:1], arc_m.reshape(-1, 2), line_m[-1:]])
    return points_m, np.concatenate([heading[:1], arc_rad.ravel(), heading[-1:]])


def _turn(one: Path, then: Path) -> Path:
    """Return the path from the end of one to the beginning of another: a cubic Bézier curve, nearly an arc."""
    start_m, end_m = one.point_m[-1], then.point_m[0]
    start_rad, end_rad = float(one.heading_rad[-1]), float(then.heading_rad[0])
    turn = float(_wrapped(np.array(end_rad - start_rad)))
    # With this reach the curve of a symmetric turn is an arc of a circle, to a thousandth of its radius.
    reach_m = float(np.hypot(*(end_m - start_m))) / (3 * np.cos(turn / 4) ** 2)
    control_m = np.array(
        [
            start_m,
            start_m + reach_m * np.array([np.cos(start_rad), np.sin(start_rad)]),
            end_m - reach_m * np.array([np.cos(end_rad), np.sin(end_rad)]),
            end_m,
        ]
    )
    tangent = (_SLOPE[..., None] * np.diff(control_m, axis=0)).sum(axis=1)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    lanes, width_m = (one.lanes[1], then.lanes[0]), (one.width_m[1], then.width_m[0])
    return Path((_WEIGHT[..., None] * control_m).sum(axis=1), heading, lanes, width_m)


def _cubic(t: Array) -> tuple[Array, Array]:
    """Return the weights of the four control points of a cubic Bézier curve, and of their steps in its slope."""
    weight = np.column_stack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])
    return weight, np.column_stack([(1 - t) ** 2, 2 * t * (1 - t), t**2])


_WEIGHT, _SLOPE = _cubic(np.linspace(0, 1, TURN_POINTS))


def _wrapped(angle: Array) -> Array:
    """Return angles in [-π, π)."""
    return np.asarray(np.mod(angle + np.pi, 2 * np.pi) - np.pi)
