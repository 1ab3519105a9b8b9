"""Figures of networks: degrees, directions of roads, graphs.

Each function writes a PNG and an SVG next to each other and returns the PNG's path; its `draw_…` only makes the
figure.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from emulator.world.networks import REFERENCE_RANGE_M
from emulator.world.world import components
from studies.style import BLUE, COMPONENT_LOOKS, GREY, RED, counted, save, shown, styled
from vnet.types import Array

Networks = Mapping[str, tuple[Array, Array]]
"""Name → positions (N, 2) in metres, east and north, and headings (N,) in radians from east to north."""

SECTORS = 24
SHOWN_COMPONENTS = 5


def degree_histogram(networks: Networks, out: Path, range_m: float = REFERENCE_RANGE_M) -> Path:
    """Histogram of the degrees; a panel a network."""
    return save(draw_degree_histogram(networks, range_m), out)


@styled
def draw_degree_histogram(networks: Networks, range_m: float) -> Figure:
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    panels = figure.subplots(1, len(networks), sharex=True, sharey=True, squeeze=False)[0]
    degrees = {name: _links(position_m, range_m).sum(axis=0) for name, (position_m, _) in networks.items()}
    largest = max(int(degree.max()) for degree in degrees.values())
    for axes, (name, degree) in zip(panels, degrees.items(), strict=True):
        axes.bar(range(largest + 1), np.bincount(degree, minlength=largest + 1), width=0.85, color=BLUE)
        axes.axvline(degree.mean(), color=RED, linestyle=(0, (5, 2)), label=f"mean {degree.mean():.1f}")
        axes.set(title=f"{shown(name)}: {counted(len(degree), 'vehicle')}", xlabel="vehicles in range (degree)")
        axes.set_xlim(-0.7, max(largest, 4) + 0.7)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(axis="x", visible=False)
        axes.legend(loc="upper right")
    panels[0].set_ylabel("number of vehicles")
    figure.suptitle(f"How many others each vehicle has within {range_m / 1000:g} km")
    return figure


def road_angle_histogram(networks: Networks, out: Path) -> Path:
    """Directions of the roads: vehicles a sector of 15°, east at the right, north at the top."""
    return save(draw_road_angle_histogram(networks), out)


@styled
def draw_road_angle_histogram(networks: Networks) -> Figure:
    figure = Figure(figsize=(10, 4.3), layout="constrained")
    grid: dict[str, Any] = {"subplot_kw": {"projection": "polar"}, "squeeze": False}
    panels = figure.subplots(1, len(networks), sharey=True, **grid)[0]
    width = 2 * np.pi / SECTORS
    counts = {name: _sector_counts(heading_rad) for name, (_, heading_rad) in networks.items()}
    largest = max(int(count.max()) for count in counts.values())
    for axes, (name, count) in zip(panels, counts.items(), strict=True):
        axes.bar(np.arange(SECTORS) * width, count, width=0.9 * width, color=BLUE)
        axes.set_title(f"{shown(name)}: {counted(int(count.sum()), 'vehicle')}", pad=12)
        axes.set_thetagrids(range(0, 360, 45), ["east", "45°", "north", "135°", "west", "225°", "south", "315°"])
        axes.set_ylim(0, largest * 1.05)
        axes.yaxis.set_major_locator(MaxNLocator(4, integer=True, prune="lower"))
        axes.set_rlabel_position(67.5)
        axes.tick_params(axis="y", labelsize=9)
    figure.suptitle(f"Which way the roads lead: number of vehicles in each sector of {360 // SECTORS}°")
    return figure


def graphs(networks: Networks, out: Path, range_m: float = REFERENCE_RANGE_M) -> Path:
    """The networks as maps at one scale: vehicles, their headings, links in range, connected components."""
    return save(draw_graphs(networks, range_m), out)


@styled
def draw_graphs(networks: Networks, range_m: float) -> Figure:
    middles, sizes = zip(*(_extent_km(position_m, range_m) for position_m, _ in networks.values()), strict=True)
    height_km = max(size[1] for size in sizes)
    widths_km = [max(size[0], 0.55 * height_km) for size in sizes]
    scale = 12 / sum(widths_km)
    figure = Figure(figsize=(13.5, min(scale * height_km + 2.2, 14)), layout="constrained")
    panels = figure.subplots(1, len(networks), width_ratios=widths_km, squeeze=False)[0]
    for axes, (name, (position_m, heading_rad)), middle, width_km in zip(
        panels, networks.items(), middles, widths_km, strict=True
    ):
        _draw_graph(axes, shown(name), position_m, heading_rad, range_m)
        axes.set_xlim(middle[0] - width_km / 2, middle[0] + width_km / 2)
        axes.set_ylim(middle[1] - height_km / 2, middle[1] + height_km / 2)
        axes.set_aspect("equal")
    panels[0].set_ylabel("north (km)")
    figure.suptitle(f"Who is within {range_m / 1000:g} km of whom; arrows show headings")
    return figure


def _draw_graph(axes: Axes, name: str, position_m: Array, heading_rad: Array, range_m: float) -> None:
    position_km = position_m / 1000
    linked = _links(position_m, range_m)
    ends = np.argwhere(np.triu(linked))
    axes.add_collection(LineCollection(list(position_km[ends]), colors="0.69", linewidths=0.6, zorder=1))
    groups = _by_component(position_m, range_m)
    for (colour, marker), (label, members) in zip((*COMPONENT_LOOKS, (GREY, "x")), groups, strict=False):
        at, heading = position_km[members], heading_rad[members]
        axes.scatter(at[:, 0], at[:, 1], s=26, color=colour, marker=marker, linewidths=0.9, label=label, zorder=3)
        arrow: dict[str, Any] = {
            "angles": "xy",
            "scale": 28,
            "width": 0.005,
            "headwidth": 4.5,
            "headlength": 5,
            "zorder": 4,
        }
        axes.quiver(at[:, 0], at[:, 1], np.cos(heading), np.sin(heading), color=colour, **arrow)
    found = len(np.unique(components(position_m, range_m)))
    sizes = f"{counted(len(position_m), 'vehicle')}, {counted(len(ends), 'link')},\n{counted(found, 'component')}"
    axes.set(title=f"{name}: {sizes}", xlabel="east (km)")
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=1, handletextpad=0.2)


def _links(position_m: Array, range_m: float) -> NDArray[np.bool_]:
    """(N, N): who has whom in range; nobody themselves."""
    offset = position_m[:, None] - position_m[None]
    linked: NDArray[np.bool_] = np.hypot(offset[..., 0], offset[..., 1]) <= range_m
    np.fill_diagonal(linked, False)
    return linked


def _by_component(position_m: Array, range_m: float) -> list[tuple[str, NDArray[np.intp]]]:
    """Labels and vehicles of the largest components, and of all others together."""
    label = components(position_m, range_m)
    members = sorted((np.flatnonzero(label == one) for one in np.unique(label)), key=len, reverse=True)
    groups = [(f"component of {counted(len(some), 'vehicle')}", some) for some in members[:SHOWN_COMPONENTS]]
    if rest := members[SHOWN_COMPONENTS:]:
        groups.append((f"{counted(len(rest), 'smaller component')}", np.concatenate(rest)))
    return groups


def _extent_km(position_m: Array, range_m: float) -> tuple[Array, Array]:
    """Middle (2,) and size (2,) of the map in kilometres, with room at the edges."""
    low, high = position_m.min(axis=0) / 1000, position_m.max(axis=0) / 1000
    return (low + high) / 2, np.maximum(high - low, range_m / 2000) * 1.12 + 0.3


def _sector_counts(heading_rad: Array) -> NDArray[np.intp]:
    """(SECTORS,): vehicles by the nearest sector; sectors are centred, so that a road due east is in one."""
    sector = np.round(np.mod(heading_rad, 2 * np.pi) / (2 * np.pi / SECTORS)).astype(np.intp) % SECTORS
    return np.bincount(sector, minlength=SECTORS)
