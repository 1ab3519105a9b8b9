"""A map as a picture: roads by class, and close up their lanes with the direction of travel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from emulator.world.maps.classes import NAMES
from emulator.world.maps.roads import Roads

CLOSE_M = 800.0
"""Pictures of no more than this show lanes."""

# Okabe and Ito; classes that look alike are not told apart by more than their width.
_STYLES = {
    "motorway": ("#D55E00", 2.6),
    "trunk": ("#D55E00", 2.2),
    "primary": ("#E69F00", 2.0),
    "secondary": ("#009E73", 1.6),
    "tertiary": ("#0072B2", 1.2),
    "unclassified": ("#56B4E9", 0.9),
    "residential": ("#56B4E9", 0.8),
    "living_street": ("#CC79A7", 0.8),
    "service": ("#999999", 0.6),
    "road": ("#0072B2", 0.7),
    "crossing": ("#999999", 0.6),
}
_SIDE_INCHES, _DPI = 9.0, 140


def draw_map(roads: Roads, path: Path, title: str, drive_on: str = "right") -> None:
    """Write a PNG. Raises OSError."""
    low, high = roads.node_m.min(axis=0), roads.node_m.max(axis=0)
    width, height = np.maximum(high - low, 1.0)
    scale = _SIDE_INCHES / max(width, height)
    figure = Figure(figsize=(max(4.0, width * scale) + 1.6, max(3.0, height * scale) + 1.0), layout="constrained")
    axes = figure.add_subplot()
    if max(width, height) <= CLOSE_M:
        _draw_lanes(axes, roads, drive_on)
    _draw_roads(axes, roads, thin=max(width, height) > 6000)
    axes.set(xlabel="east (m)", ylabel="north (m)", aspect="equal")
    axes.set_title(title, loc="left", fontsize=11)
    axes.margins(0.02)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=_DPI)


def _style(kind: int) -> tuple[str, float]:
    return _STYLES[NAMES[kind].removesuffix("_link")]


def _draw_roads(axes: Axes, roads: Roads, thin: bool) -> None:
    place = roads.node_m[roads.node]
    handles = []
    kinds = np.unique(roads.kind)
    for kind in kinds[np.argsort([_style(k)[1] for k in kinds.tolist()])].tolist():
        segment = roads.segment[roads.kind[roads.road_of[roads.segment]] == kind]
        colour, width = _style(kind)
        width *= 0.6 if thin else 1.0
        lines = np.stack([place[segment], place[segment + 1]], axis=1)
        axes.add_collection(LineCollection(list(lines), colors=colour, linewidths=width, capstyle="round"))
        if not NAMES[kind].endswith("_link"):
            handles.append(Line2D([], [], color=colour, linewidth=width + 0.6, label=NAMES[kind].replace("_", " ")))
    axes.autoscale_view()
    axes.legend(handles=handles[::-1], loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=9)


def _draw_lanes(axes: Axes, roads: Roads, drive_on: str) -> None:
    """Strips in which a vehicle's centre may be, with an arrow on each longer segment."""
    lanes = roads.lane_map(drive_on)
    start = lanes.point_m
    end = start + lanes.length_m[:, None] * lanes.direction
    aside = lanes.half_width_m[:, None] * lanes.normal
    strips = np.stack([start - aside, end - aside, end + aside, start + aside], axis=1)
    for strip in strips:
        axes.fill(*strip.T, color="#DDDDDD", linewidth=0)
    long = lanes.length_m > 12.0
    middle = (start + end)[long] / 2
    ahead = 4.0 * lanes.direction[long]
    axes.quiver(
        *middle.T, *ahead.T, angles="xy", scale_units="xy", scale=1, width=0.0018, headwidth=5, color="#555555"
    )
