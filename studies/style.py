"""The style of the experiments' figures: colours, one look a mechanism, and saving as PNG and SVG.

Colours are those of Okabe and Ito, and nothing is told by colour alone. A mechanism has one colour and line
in all figures; its variants ("random, one hop") keep the colour. No pyplot: no window, no state that lasts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from emulator.pages.palette import PALETTE

DPI = 150
BLACK, GREY = "0", "0.4"
ORANGE, SKY, GREEN, YELLOW, BLUE, RED, PURPLE = (
    PALETTE[name].light for name in ("orange", "sky", "green", "yellow", "blue", "red", "purple")
)

styled = matplotlib.rc_context(
    {
        "font.family": "DejaVu Sans",
        "font.size": 10,
        "axes.titlesize": 11,
        "figure.titlesize": 13,
        "legend.fontsize": 9,
        "legend.frameon": False,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.axisbelow": True,
        "axes.grid": True,
        "grid.color": "0.867",
        "grid.linewidth": 0.6,
        "svg.hashsalt": "vnet",
    }
)


@dataclass(frozen=True)
class Look:
    """Colour, line and marker of a mechanism."""

    colour: str
    line: Any
    marker: str


LOOKS = {
    "centralized": Look(BLACK, "-", "s"),
    "bound": Look(GREY, (0, (1, 1)), "D"),
    "optimized": Look(BLUE, "-", "o"),
    "random": Look(RED, (0, (5, 2)), "^"),
    "none": Look(GREEN, (0, (4, 1.5, 1, 1.5)), "v"),
}
OTHER_LOOKS = (
    Look(PURPLE, (0, (1, 1.5)), "P"),
    Look(ORANGE, (0, (7, 2, 1, 2, 1, 2)), "X"),
    Look(SKY, (0, (9, 3)), "<"),
    Look(YELLOW, (0, (3, 1)), ">"),
)
VARIANT_LINES = ((0, (2, 1)), (0, (1, 3)), (0, (6, 1, 1, 1)))


@styled
def save(figure: Figure, out: Path) -> Path:
    """`out`.png and `out`.svg; the same figure gives the same bytes."""
    out.parent.mkdir(parents=True, exist_ok=True)
    png = out.with_name(out.name + ".png")
    figure.savefig(png, dpi=DPI)
    figure.savefig(out.with_name(out.name + ".svg"), metadata={"Date": None})
    return png


def label_levels(axes: Axes, levels: Sequence[float], labels: Sequence[str]) -> None:
    """Write labels right of the axes at their levels, moved apart where they would overlap."""
    if not levels:
        return
    data_to_axes = axes.transData + axes.transAxes.inverted()
    true = [float(data_to_axes.transform((axes.get_xlim()[0], level))[1]) for level in levels]
    line: dict[str, Any] = {"arrowstyle": "-", "color": GREY, "linewidth": 0.7, "shrinkA": 0, "shrinkB": 0}
    for label, level, place in zip(labels, true, spread(true, 0.065), strict=True):
        axes.annotate(
            label, (1, level), (1.03, place), xycoords="axes fraction", textcoords="axes fraction", va="center",
            fontsize=9, arrowprops=line, annotation_clip=False,
        )  # fmt: skip


def spread(places: Sequence[float], gap: float) -> list[float]:
    """Places at least `gap` apart, in the same order, each near where it was."""
    order = np.argsort(places, kind="stable")
    moved = np.array(places, dtype=float)[order]
    for _ in range(200):
        overlap = np.maximum(0, gap - np.diff(moved)) / 2
        moved[:-1] -= overlap
        moved[1:] += overlap
    result = np.empty_like(moved)
    result[order] = moved
    return [float(place) for place in result]


def looks_of(names: Sequence[str]) -> dict[str, Look]:
    """A look for each mechanism: its own, a variant of the one it is called after, or the next that is free."""
    looks: dict[str, Look] = {}
    others, variants = 0, 0
    for name in names:
        base = name.split(",")[0]
        if name in LOOKS:
            looks[name] = LOOKS[name]
        elif base in LOOKS:
            line = VARIANT_LINES[variants % len(VARIANT_LINES)]
            variants += 1
            looks[name] = Look(LOOKS[base].colour, line, f"${'abcdefgh'[variants % 8]}$")
        else:
            looks[name] = OTHER_LOOKS[others % len(OTHER_LOOKS)]
            others += 1
    return looks
