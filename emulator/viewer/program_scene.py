"""Values that programs report in a recording: curves against time, and vehicles coloured on a map."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import rerun as rr

from emulator.viewer.drawing import BLUE, GREY, ORANGE, SKY, Canvas, Floats, Period, drawable
from emulator.viewer.radio_scene import next_charts_s
from vnet.units import title_of, unit_of

MOST_VALUES = 16
"""Names of values that are drawn, in the order in which they are first reported."""
SCALE = np.array([(40, 90, 220), (0, 158, 115), (255, 205, 40)], dtype=float)
"""Colours of the least, middle and largest value so far: blue, green and yellow, and nowhere near grey."""


def titled(name: str) -> str:
    """Return the title of a value, with its unit."""
    unit = unit_of(name)
    return drawable(f"{title_of(name)} ({unit})" if unit else title_of(name))


def entity(kind: str, name: str) -> str:
    """Return the entity of a value: of its "curve", its "map", or its "texts"."""
    return f"program/{kind}/{rr.escape_entity_path_part(name)}"


class ProgramScene:
    """Draws what programs report by names of their own below `/program`, from the messages of a run."""

    def __init__(self, canvas: Canvas, scene: Mapping[str, Any], vehicle: str) -> None:
        self._canvas = canvas
        self._node_ids: list[str] = scene["node_ids"]
        self._vehicle = vehicle
        self._number = self._node_ids.index(vehicle)
        self._bounds: dict[str, tuple[float, float]] = {}
        self._told: dict[str, str] = {}
        self._next_colours_s = 0.0

    @property
    def names(self) -> list[str]:
        """Names of the values that are drawn."""
        return list(self._bounds)

    @property
    def texts(self) -> list[str]:
        """Names of the texts that the vehicle that is looked at closely has reported."""
        return list(self._told)

    def period(self, period: Period) -> None:
        """Draw a period."""
        values = period.values()
        for name in values:
            if name not in self._bounds and len(self._bounds) < MOST_VALUES:
                self._announce(name)
        for name in self._bounds:
            if name in values:
                self._curve(name, values[name])
        if self._bounds and period.time_s >= self._next_colours_s:
            self._next_colours_s = next_charts_s(period.time_s)
            self._colour(values)
        for name in self._bounds:
            self._canvas.points(entity("map", name), period.points("position_m"))
        self._texts(period.texts())

    def _announce(self, name: str) -> None:
        self._bounds[name] = (np.inf, -np.inf)
        band = [("95 % of the vehicles", GREY, 1.0), ("5 %", GREY, 1.0)]
        lines = [("mean", BLUE, 2.0), (self._vehicle, ORANGE, 1.5)]
        self._canvas.series(entity("curve", name), band + lines)
        self._canvas.point_style(entity("map", name), None, 6.0, self._node_ids)

    def _curve(self, name: str, value: Floats) -> None:
        known = value[np.isfinite(value)]
        low, high = np.percentile(known, [5, 95]) if len(known) else (np.nan, np.nan)
        mean = float(known.mean()) if len(known) else float("nan")
        self._canvas.plot(entity("curve", name), float(high), float(low), mean, float(value[self._number]))
        if len(known):
            least, most = self._bounds[name]
            self._bounds[name] = min(least, float(known.min())), max(most, float(known.max()))

    def _colour(self, values: Mapping[str, Floats]) -> None:
        """Colour the vehicles by their values, between the least and the largest so far; grey without one."""
        for name, (least, most) in self._bounds.items():
            value = values.get(name)
            if value is None or least > most:
                continue
            share = np.clip((value - least) / max(most - least, 1e-12), 0, 1)
            scaled = np.column_stack([np.interp(share, (0, 0.5, 1), SCALE[:, part]) for part in range(3)])
            colours = np.where(np.isfinite(share)[:, None], scaled, np.array(GREY[:3], dtype=float))
            self._canvas.log(entity("map", name), rr.Points2D.from_fields(colors=colours.astype(np.uint8)))

    def _texts(self, texts: Mapping[str, list[str]]) -> None:
        """Draw the texts of the vehicle that is looked at closely, as states against time."""
        for name, reported in texts.items():
            text = drawable(reported[self._number])
            if (
                not text
                or self._told.get(name) == text
                or (name not in self._told and len(self._told) == MOST_VALUES)
            ):
                continue
            if name not in self._told:
                self._canvas.states(entity("texts", name), {text: SKY})
            self._told[name] = text
            self._canvas.log(entity("texts", name), rr.StateChange(state=text))
