"""Maps of a run: roads, vehicles, and their links or trajectories; coloured by what programs report."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.pages.canvas import BLUE, GREY, INK, ORANGE, SKY, Canvas, canvas, legend
from emulator.records.reported import figure_text, is_text
from emulator.records.tables import BACKGROUND, positions_by_time
from emulator.report.drawing import Drawing
from emulator.report.program_figures import Drawers
from emulator.report.source import NothingToShow, Source
from emulator.world.buildings import Buildings
from vnet.errors import counted, printable
from vnet.types import Array, Mask
from vnet.units import label_of, title_of

INNER_PX = 334
"""Width of a map inside its axes, at the size that it is drawn for."""
LEAST_PX, MOST_PX = 150, 420
"""Bounds of its height."""
MOST_CORNERS = 12_000
"""Corners of buildings that are drawn, those of the largest ones."""
MOST_ROADS, MOST_LINKS, MOST_TRAJECTORIES = 10_000, 3000, 400
"""Road segments, links and trajectories that are drawn: more would make a page of many megabytes."""
CELLS = 600, 300
"""Cells of a map's width in which roads are one, if there are many: one pixel or two each."""
MOST_NAMED = 30
"""Vehicles up to which each has its name beside it."""
NAME_PX = (6.0, 12.0)
"""Width of a letter of a name at most, and height of the name."""
LARGEST_INTEGER = 1e15
"""Bound of numbers up to which classes are of whole numbers: beyond it they are shown with four digits."""
POINTS_A_TRAJECTORY = 80
MOST_CLASSES = 5
OPACITY = (0.06, 0.25, 0.45, 0.7, 1.0)
"""Opacity of a vehicle's point, by the class of its value."""
UNIT: dict[str, Any] = {"linestyle": "none", "marker": "s", "markersize": 8, "color": ORANGE, "zorder": 4}
"""Marker of a roadside unit."""
MOST_COLOURED = 6
"""Values with a map of their own."""
KILOMETRES_FROM_M = 3000.0
"""Extent from which on axes are in kilometres."""


def map_charts(source: Source) -> Drawers:
    """Return title and drawing of the map, and of a map for each value that programs report, by id."""
    drawers: Drawers = {"map": ("Map", partial(_network, source))}
    names = [name for name in source.drawn_names if not is_text(source.states.schema.field(name).type)]
    for number, name in enumerate(names[:MOST_COLOURED]):
        drawers[f"map-of-{number}"] = (f"Map: {title_of(name)}", partial(_coloured, source, name))
    return drawers


def _network(source: Source) -> Drawing:
    """Draw roads, vehicles, and trajectories where vehicles drive, else the links that delivered frames."""
    made, scale = _frame(source)
    position_m = _last_positions(source)
    if source.moves:
        shown = _draw_trajectories(made, source, scale)
        text = f"{_ground(source)} Lines: the ways of {shown}; points: where they were last."
    else:
        shown = _draw_links(made, source, scale)
        text = f"{_ground(source)} Lines: {shown}; points: vehicles."
    if len(background_m := _background_m(source)):
        _draw_vehicles(made, background_m * scale, GREY, 2)
        text += " Small grey points: vehicles without programs, where they were at the end."
    _draw_vehicles(made, position_m * scale)
    if units := source.scenario.roadside:
        made.axes.plot(*(position_m[-len(units) :] * scale).T, **UNIT)
        text += " Squares: roadside units."
    if len(position_m) <= MOST_NAMED:
        text += _draw_names(made, source.node_ids, position_m * scale)
    return Drawing(made, text)


def _coloured(source: Source, name: str) -> Drawing:
    """Draw each vehicle by the last value that it reported."""
    last = _last_values(source.value(name))
    known = np.isfinite(last)
    if len(set(last[known].tolist())) == 1:
        raise NothingToShow("all vehicles ended with the same value")
    index, labels = classes(last, source.is_boolean(name))
    made, scale = _frame(source)
    position_m = _last_positions(source) * scale
    from matplotlib.colors import to_rgba
    from matplotlib.lines import Line2D

    handles = []
    dots: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 7, "markeredgewidth": 0.8}
    dots["markeredgecolor"] = BLUE
    for number, label in enumerate(labels):
        dots["markerfacecolor"] = to_rgba(BLUE, OPACITY[round(number * (len(OPACITY) - 1) / (len(labels) - 1))])
        made.axes.plot(*position_m[index == number].T, **dots)
        handles.append(Line2D([], [], label=label, **dots))
    _draw_vehicles(made, position_m[~known], GREY)
    legend(made, handles)
    silent = " Grey: never reported it." if (~known).any() else ""
    return Drawing(made, f"{label_of(name)}: what each vehicle reported last.{silent}")


def classes(value: Array, is_boolean: bool = False) -> tuple[NDArray[np.intp], list[str]]:
    """Return the class (n,) of each value, -1 of one that is not finite, and the classes' labels, the least first.

    There are at most `MOST_CLASSES`: false and true; each integer, or as many of them in each class; or ranges of
    one width. Ranges without any value stay.
    """
    known = np.isfinite(value)
    number = value[known]
    low, high = float(number.min()), float(number.max())
    if is_boolean:
        edges, labels = np.array([0.0, 1.0]), ["false", "true"]
    elif (number == np.rint(number)).all() and max(high, -low) < LARGEST_INTEGER:
        count = min(MOST_CLASSES, int(high - low + 1))
        bounds = low + np.floor((high - low + 1) * np.arange(count + 1) / count)
        edges = bounds[:-1]
        labels = [
            figure_text(first) + (f" – {figure_text(behind - 1)}" if behind - first > 1 else "")
            for first, behind in pairwise(bounds.tolist())
        ]
    else:
        edges = np.linspace(low, high, MOST_CLASSES + 1)
        labels = [f"{figure_text(first)} – {figure_text(end)}" for first, end in pairwise(edges.tolist())]
        edges = edges[:-1]
    index = np.full(len(value), -1, dtype=np.intp)
    index[known] = np.searchsorted(edges, number, side="right") - 1
    return index, labels


def _frame(source: Source) -> tuple[Canvas, float]:
    """Make axes of equal scale around all vehicles, with the roads; returns also the axes' units a metre."""
    world = source.world
    low, high = world.area_m
    centre, half = (low + high) / 2, np.maximum((high - low) / 2 * 1.08, 25.0)
    height_px = float(np.clip(INNER_PX * half[1] / half[0], LEAST_PX, MOST_PX))
    half = np.maximum(half, (half[1] * INNER_PX / height_px, half[0] * height_px / INNER_PX))
    is_wide = 2 * half.max() > KILOMETRES_FROM_M
    scale, unit = (1e-3, "km") if is_wide else (1.0, "m")
    made = canvas(f"east ({unit})", f"north ({unit})", plot_px=height_px)
    (left, bottom), (right, top) = (centre - half) * scale, (centre + half) * scale
    made.axes.set(xlim=(left, right), ylim=(bottom, top))
    made.axes.grid(visible=False)
    if world.buildings is not None:
        _draw_buildings(made, world.buildings.touching(centre - half, centre + half), scale)
    _draw_roads(made, world.lane_point_m, world.lane_heading_rad, world.lane_length_m, (centre, half), scale)
    return made, scale


def _draw_roads(
    made: Canvas, point_m: Array, heading_rad: Array, length_m: Array, window_m: tuple[Array, Array], scale: float
) -> None:
    """Draw the lanes that come near the window (centre and half extents), of a road one if there are many."""
    centre, half = window_m
    reach_m = 2 * float(np.abs(half).sum()) + float(np.hypot(*(point_m - centre).T).max(initial=0.0))
    endless = np.isinf(length_m)
    along = np.column_stack([np.cos(heading_rad), np.sin(heading_rad)])
    start = point_m - np.where(endless, reach_m, 0.0)[:, None] * along
    end = point_m + np.where(endless, reach_m, length_m)[:, None] * along
    near = ~((np.maximum(start, end) < centre - half) | (np.minimum(start, end) > centre + half)).any(axis=1)
    lines_m = np.stack([start, end], axis=1)[near]
    for cells in CELLS:
        if len(lines_m) > MOST_ROADS:
            lines_m = _distinct(lines_m, 2 * float(half.max()) / cells)
    if len(lines_m) > MOST_ROADS:
        longest = np.argsort(-np.linalg.norm(lines_m[:, 1] - lines_m[:, 0], axis=1), kind="stable")
        lines_m = lines_m[np.sort(longest[:MOST_ROADS])]
    opacity = 0.55 if not endless.all() else float(np.clip(30 / max(len(lines_m), 1), 0.25, 0.55))
    _draw_lines(made, lines_m * scale, GREY, opacity, 0.8)


def _distinct(lines_m: Array, cell_m: float) -> Array:
    """Return lines (n, 2, 2) with their ends on a grid, each once: lanes of a road are one, curves stay whole."""
    ends = np.rint(lines_m / cell_m)
    east, north = (ends[:, 1] - ends[:, 0]).T
    is_turned = (east < 0) | ((east == 0) & (north < 0))
    ends[is_turned] = ends[is_turned][:, ::-1]
    ends = np.unique(ends, axis=0)
    return np.asarray(ends[(ends[:, 0] != ends[:, 1]).any(axis=1)] * cell_m)


def _draw_buildings(made: Canvas, buildings: Buildings, scale: float) -> None:
    """Draw the areas of buildings as one path, the largest ones if there are many."""
    shown = buildings.largest(MOST_CORNERS)
    if not len(shown):
        return
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    codes = np.full(len(shown.corner_m), Outline.LINETO, dtype=np.uint8)
    codes[shown.first[:-1]] = Outline.MOVETO
    closed = shown.first[1:]
    corners = np.insert(shown.corner_m * scale, closed, shown.corner_m[shown.first[:-1]] * scale, axis=0)
    outline = Outline(corners, np.insert(codes, closed, Outline.CLOSEPOLY))
    made.axes.add_patch(PathPatch(outline, facecolor=GREY, edgecolor="none", alpha=0.3))


def _ground(source: Source) -> str:
    """Return what the grey of a map is, in words."""
    buildings = source.world.buildings
    return "Grey lines: roads; grey areas: buildings." if buildings is not None else "Grey: roads."


def _draw_lines(made: Canvas, lines: Array, colour: str, opacity: float, width: float) -> None:
    """Draw lines (k, points, 2) as one path; NaN are gaps."""
    if not len(lines):
        return
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    codes = np.full(lines.shape[:2], Outline.LINETO, dtype=np.uint8)
    codes[:, 0] = Outline.MOVETO
    outline = Outline(lines.reshape(-1, 2), codes.ravel())
    made.axes.add_patch(PathPatch(outline, fill=False, edgecolor=colour, alpha=opacity, linewidth=width))


def _draw_vehicles(made: Canvas, position: Array, colour: str = BLUE, size: float = 5) -> None:
    made.axes.plot(*position.T, color=colour, linestyle="none", marker="o", markersize=size, markeredgewidth=0)


def _draw_names(made: Canvas, node_ids: Sequence[str], position: Array) -> str:
    """Write each vehicle's name within the axes where no other one is; returns what has no room, in words."""
    from matplotlib.transforms import Bbox

    taken: list[Bbox] = []
    area = made.axes.bbox
    there = np.flatnonzero(np.isfinite(position).all(axis=1))
    for number in there.tolist():
        name, (x, y) = printable(node_ids[number], 12), made.axes.transData.transform(position[number])
        width, height = NAME_PX[0] * len(name), NAME_PX[1]
        for right, up in ((4.0, 1.0), (4.0, -1 - height), (-4 - width, 1.0), (-4 - width, -1 - height)):
            box = Bbox.from_bounds(x + right, y + up, width, height)
            inside = area.x0 <= box.x0 and box.x1 <= area.x1 and area.y0 <= box.y0 and box.y1 <= area.y1
            if inside and not box.count_overlaps(taken):
                taken.append(box)
                look: dict[str, Any] = {"fontsize": 9, "color": INK, "va": "bottom"}
                made.axes.annotate(name, position[number], (right, up), textcoords="offset points", **look)
                break
    return " Names without room are left out." if len(taken) < len(there) else ""


def _draw_links(made: Canvas, source: Source, scale: float) -> str:
    """Draw the links on which frames were delivered; returns what is drawn, in words."""
    if not len(source.trace):
        return "no link delivered a frame"
    count = len(source.node_ids)
    good = source.outcome_is("delivered")
    one, other = source.sender[good], source.receiver[good]
    pair = np.unique(np.minimum(one, other) * count + np.maximum(one, other))
    shown = pair[:: max(1, -(-len(pair) // MOST_LINKS))]
    position_m = source.places.position_m(0)
    ends = np.stack([position_m[shown // count], position_m[shown % count]], axis=1)
    _draw_lines(made, ends * scale, SKY, float(np.clip(30 / max(len(shown), 1), 0.35, 0.8)), 1.0)
    part = f"{len(shown):,} of the " if len(shown) < len(pair) else "the "
    return f"{part}{counted(len(pair), 'link')} that delivered frames"


def _draw_trajectories(made: Canvas, source: Source, scale: float) -> str:
    """Draw the ways of the vehicles; returns what is drawn, in words."""
    course_m = source.vectors("position_m")
    periods, count, _ = course_m.shape
    chosen = np.linspace(0, periods - 1, min(periods, POINTS_A_TRAJECTORY)).astype(int)
    vehicles = np.arange(count)[:: max(1, -(-count // MOST_TRAJECTORIES))]
    ways = course_m[chosen][:, vehicles].transpose(1, 0, 2)
    pieces = np.stack([ways[:, :-1], ways[:, 1:]], axis=2).reshape(-1, 2, 2)
    pieces = pieces[np.isfinite(pieces).all(axis=(1, 2))]
    _draw_lines(made, pieces * scale, SKY, 0.8, 1.4)
    part = f"{len(vehicles):,} of " if len(vehicles) < count else ""
    return f"{part}{counted(count, 'vehicle')}"


def _last_positions(source: Source) -> Array:
    """Return where each vehicle was last (N, 2); NaN of one that never was there."""
    if not source.moves:
        return source.places.position_m(0)
    return np.stack([_last_values(source.vectors("position_m")[..., axis]) for axis in (0, 1)], axis=1)


def _background_m(source: Source) -> Array:
    """Return where vehicles without programs were in the run's last period (k, 2)."""
    period_ns = source.scenario.period_ns
    last_ns = (source.closed_ns - 1) // period_ns * period_ns
    positions_m = positions_by_time(source.table(BACKGROUND))
    ends_ns = [time_ns for time_ns in positions_m if time_ns >= last_ns]
    return positions_m[ends_ns[-1]] if ends_ns else np.zeros((0, 2))


def _last_values(value: Array) -> Array:
    """Return the last finite value (N,) of each column of (periods, N); NaN where there is none."""
    known: Mask = np.isfinite(value)
    index = len(value) - 1 - known[::-1].argmax(axis=0)
    return np.asarray(np.where(known.any(axis=0), value[index, np.arange(value.shape[1])], np.nan))
