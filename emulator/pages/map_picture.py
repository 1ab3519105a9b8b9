"""Pictures of maps: roads by class, and the lanes of small areas."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from emulator.pages.palette import PALETTE
from emulator.world.maps.roads import NAMES, Roads
from vnet.types import Array

LANES_SHOWN_M = 800.0
"""Largest extent of a picture that shows lanes."""

# Colour and line width in points of each class. Similar classes differ only in width.
_STYLES = {
    "motorway": (PALETTE["red"].light, 2.6),
    "trunk": (PALETTE["red"].light, 2.2),
    "primary": (PALETTE["orange"].light, 2.0),
    "secondary": (PALETTE["green"].light, 1.6),
    "tertiary": (PALETTE["blue"].light, 1.2),
    "unclassified": (PALETTE["sky"].light, 0.9),
    "residential": (PALETTE["sky"].light, 0.8),
    "living_street": (PALETTE["purple"].light, 0.8),
    "service": ("0.6", 0.6),
    "road": (PALETTE["blue"].light, 0.7),
    "crossing": ("0.6", 0.6),
}
_SIDE_INCHES = 9.0
"""Length of the picture's longer side."""
_DPI = 140
"""Pixels an inch."""


def draw_map(roads: Roads, path: Path, title: str, window: tuple[Array, Array] | None = None) -> None:
    """Write a picture of a map, or of the part between the corners `window` (south-west and north-east, in metres).

    Raise OSError if it cannot be written.
    """
    low, high = window or (roads.node_m.min(axis=0), roads.node_m.max(axis=0))
    margin_m = 0.0 if window else 0.02 * float((high - low).max()) + 5.0
    low, high = low - margin_m, high + margin_m
    span_m = float((high - low).max())
    width, height = np.maximum((high - low) / span_m, 0.3) * _SIDE_INCHES
    figure = Figure(figsize=(width, height))
    axes = figure.add_subplot()
    if span_m <= LANES_SHOWN_M:
        _draw_lanes(axes, roads)
    _draw_roads(axes, roads, 0.6 if span_m > 6000 else 1.0)
    axes.set(xlabel="east (m)", ylabel="north (m)", aspect="equal")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_title(title, loc="left", fontsize=11)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=_DPI, bbox_inches="tight")


def _style(kind: int) -> tuple[str, float]:
    return _STYLES[NAMES[kind].removesuffix("_link")]


def _draw_roads(axes: Axes, roads: Roads, scale: float) -> None:
    point_m = roads.node_m[roads.node]
    handles = {}
    kinds = np.unique(roads.kind)
    for kind in kinds[np.argsort([_style(k)[1] for k in kinds.tolist()], kind="stable")].tolist():
        segment = roads.segment[roads.kind[roads.road_of[roads.segment]] == kind]
        colour, width = _style(kind)
        lines = np.stack([point_m[segment], point_m[segment + 1]], axis=1)
        axes.add_collection(LineCollection(list(lines), colors=colour, linewidths=width * scale, capstyle="round"))
        name = NAMES[kind].removesuffix("_link").replace("_", " ")
        handles[name] = Line2D([], [], color=colour, linewidth=width + 0.6, label=name)
    if len(handles) > 1:
        shown = list(handles.values())[::-1]
        axes.legend(handles=shown, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=9)


def _draw_lanes(axes: Axes, roads: Roads) -> None:
    """Draw the strips in which a vehicle's centre may be, with an arrow on each longer segment."""
    lanes = roads.lane_map()
    start = lanes.point_m
    end = start + lanes.length_m[:, None] * lanes.direction
    aside = lanes.half_width_m[:, None] * lanes.normal
    strips = np.stack([start - aside, end - aside, end + aside, start + aside], axis=1)
    axes.add_collection(PolyCollection(list(strips), facecolors="0.867", linewidths=0))
    long = lanes.length_m > 12.0
    middle = (start + end)[long] / 2
    ahead = 4.0 * lanes.direction[long]
    axes.quiver(
        *middle.T, *ahead.T, angles="xy", scale_units="xy", scale=1, width=0.0018, headwidth=5, color="0.333"
    )
