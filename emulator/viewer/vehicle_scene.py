"""Vehicles in a recording: where one is and thinks it is, whom it hears and trusts, and what programs report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import rerun as rr

from emulator.radio.outcomes import Outcome
from emulator.records.period_figures import Views
from emulator.viewer.drawing import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    POSITION,
    RED,
    SKY,
    Canvas,
    Floats,
    PeriodArrays,
    drawable,
    ellipses,
    flipped,
    link_states,
    nice_length,
    outcome_colours,
)
from emulator.viewer.radio_scene import WINDOW_S, SlidingSum, next_charts_s
from vnet.units import title_of, unit_of

SLOW_EVERY_S = 1.0
"""Interval at which ellipses and neighbours are drawn."""
CURVES = (SKY, RED, ORANGE)
"""Colours of the errors of its estimates."""
LABELLED = 40
"""As many neighbours have their names written beside them."""


def range_rings_m(reach_m: float) -> list[float]:
    """Return the radii of rings around a vehicle: two or more at round lengths, and the range of its radio."""
    step_m = nice_length(reach_m / 2)
    return [*np.arange(step_m, 0.95 * reach_m, step_m).tolist(), reach_m]


class VehicleScene:
    """Draws one vehicle below `/vehicle`, from the scene and period messages of a run."""

    def __init__(self, canvas: Canvas, scene: Mapping[str, Any], vehicle: str, views: Views) -> None:
        self._canvas = canvas
        self._estimates = (POSITION, *views.estimates)
        self._node_ids: list[str] = scene["node_ids"]
        self._vehicle = vehicle
        self._number = self._node_ids.index(vehicle)
        periods = round(WINDOW_S * 1e9 / scene["period_ns"])
        self._tried, self._heard = SlidingSum(periods), SlidingSum(periods)
        self._peers = {name: np.full(len(self._node_ids), np.nan) for name in views.peers}
        self._next_s = self._next_slow_s = 0.0
        self._is_there = True
        self._set_styles()
        for each in self._estimates:
            canvas.rings(f"vehicle/{each.name}", each.rings_m)
        reach_m: float | None = scene["range_m"]
        if reach_m is not None:
            canvas.rings("vehicle/hears", range_rings_m(reach_m), cross=False)
        canvas.series(
            "vehicle/errors",
            [(each.title, colour, 2.0) for each, colour in zip(self._estimates, CURVES, strict=False)],
        )
        canvas.series("vehicle/frames", (("delivered", GREEN, 2.0), ("not delivered", RED, 1.0)))

    def period(self, period: PeriodArrays) -> None:
        """Draw a period; nothing while the vehicle is not in the network."""
        is_there = bool(np.isfinite(period.points("position_m")[self._number, 0]))
        if not is_there:
            if self._is_there:
                self._clear()
            self._is_there = False
            return
        self._is_there = True
        self._errors(period)
        self._frames(period)
        for name, by_node in period.peers().items():
            if self._vehicle in by_node:
                self._peers[name] = by_node[self._vehicle].copy()
        if not period.up[self._number]:
            for values in self._peers.values():
                values[:] = np.nan
        if period.time_s >= self._next_s:
            self._next_s = next_charts_s(period.time_s)
            self._table(period)

    def _clear(self) -> None:
        """Draw nothing of the vehicle, which has not entered yet or has left."""
        canvas, nothing = self._canvas, np.empty((0, 2), dtype=np.float32)
        for name in ("position/fix", "hears/neighbours"):
            canvas.points(f"vehicle/{name}", nothing)
        canvas.strips("vehicle/hears/links", np.empty((0, 2, 2), dtype=np.float32))
        for each in self._estimates:
            canvas.points(f"vehicle/{each.name}/estimate", nothing)
            if each.cloud:
                canvas.points(f"vehicle/{each.name}/cloud", nothing)
            canvas.strips(f"vehicle/{each.name}/ellipse", np.empty((0, 2, 2), dtype=np.float32))
        text = f"{self._vehicle} is not in the network: it has not entered yet, or has left."
        canvas.log("vehicle/table", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))

    def _set_styles(self) -> None:
        canvas = self._canvas
        canvas.point_style("vehicle/position/fix", GREY, 5.0)
        for each in self._estimates:
            canvas.point_style(f"vehicle/{each.name}/estimate", SKY, 6.0)
            canvas.strip_style(f"vehicle/{each.name}/ellipse", SKY, 2.0)
            canvas.point_style(f"vehicle/{each.name}/cloud", GREY, 1.5)
        canvas.strip_style("vehicle/hears/links", None, 2.0)
        canvas.point_style("vehicle/hears/neighbours", None, 5.0)
        canvas.point_style("vehicle/hears/self", SKY, 7.0, [self._vehicle], show_labels=True)
        canvas.points("vehicle/hears/self", [[0.0, 0.0]], static=True)

    def _errors(self, period: PeriodArrays) -> None:
        """Its estimates, as differences from the truth."""
        canvas, one = self._canvas, slice(self._number, self._number + 1)
        canvas.points("vehicle/position/fix", (period.points("fix_m") - period.points("position_m"))[one])
        is_slow = period.time_s >= self._next_slow_s
        errors = {each: period.off_truth(each)[one] for each in self._estimates}
        for each, off_m in errors.items():
            canvas.points(f"vehicle/{each.name}/estimate", off_m)
            cloud = period.clouds(each).get(self._vehicle)
            if not period.up[self._number]:
                cloud = np.empty((0, 2), dtype=np.float32)
            if cloud is not None and each.cloud:
                canvas.points(f"vehicle/{each.name}/cloud", cloud)
            if is_slow:
                covariance = period.covariances(each.covariance)[one]
                canvas.strips(f"vehicle/{each.name}/ellipse", ellipses(off_m, covariance))
        canvas.plot("vehicle/errors", *[float(np.hypot(*off_m[0])) for off_m in errors.values()][: len(CURVES)])
        if is_slow:
            self._next_slow_s = period.time_s + SLOW_EVERY_S
            self._neighbours(period)

    def _neighbours(self, period: PeriodArrays) -> None:
        """Draw the links from the vehicles in range, coloured by the outcome of their frames."""
        canvas, position = self._canvas, period.points("position_m")
        place = position - position[self._number]
        sender, receiver, state = link_states(period)
        mine = receiver == self._number
        sender, colour = sender[mine], outcome_colours(state[mine])
        strips = np.stack([np.zeros((len(sender), 2), np.float32), place[sender]], axis=1)
        canvas.strips("vehicle/hears/links", strips, colour)
        names = rr.Points2D.from_fields(
            positions=flipped(place[sender]),
            colors=colour,
            labels=[self._node_ids[number] for number in sender],
            show_labels=len(sender) <= LABELLED,
        )
        canvas.log("vehicle/hears/neighbours", names)

    def _frames(self, period: PeriodArrays) -> None:
        received = period.pairs[period.pairs[:, 1] == self._number]
        got = received[received[:, 2] == Outcome.delivered, 3].sum()
        self._canvas.plot("vehicle/frames", float(got), float(received[:, 3].sum() - got))
        self._tried.add(np.bincount(received[:, 0], received[:, 3], len(self._node_ids)))
        got_from = received[received[:, 2] == Outcome.delivered]
        self._heard.add(np.bincount(got_from[:, 0], got_from[:, 3], len(self._node_ids)))

    def _table(self, period: PeriodArrays) -> None:
        """Neighbours: what was heard of each lately, and what the vehicle reports of it, in descending order."""
        tried, heard = self._tried.total, self._heard.total
        told = np.array([np.nan_to_num(values, nan=-1.0) for values in self._peers.values()])
        told = told.reshape(-1, len(self._node_ids))
        numbers = [n for n in range(len(self._node_ids)) if tried[n] or (told[:, n] > 0).any()]
        numbers.sort(key=lambda n: (*-told[:, n], -heard[n], n))
        rows = [self._row(n, int(tried[n]), int(heard[n])) for n in numbers]
        heads = ["hears", f"frames in {WINDOW_S:g} s", "delivered", *self._peers]
        head = f"| {' | '.join(heads)} |\n|:--{'|--:' * (len(heads) - 1)}|\n"
        text = rr.TextDocument(head + "\n".join(rows), media_type=rr.MediaType.MARKDOWN)
        self._canvas.log("vehicle/table", text)

    def _row(self, number: int, tried: int, heard: int) -> str:
        told = [f"{values[number]:.3f}".replace("nan", "–") for values in self._peers.values()]
        share = f"{heard / tried:.0%}" if tried else "–"
        name = self._node_ids[number] + (" (itself)" if number == self._number else "")
        return f"| {' | '.join([name, str(tried or '–'), share, *told])} |"


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

    def period(self, period: PeriodArrays) -> None:
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
