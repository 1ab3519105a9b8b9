"""Drawing for all parts of a recording: colours, lengths, a canvas, and a period as arrays.

Rerun's 2-D views have y downwards, hence the minus signs: east is right, north is up.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import ArrayLike, NDArray

from emulator.pages.palette import PALETTE
from emulator.radio.outcomes import DRAWN, Outcome
from emulator.records.period_figures import Estimate
from emulator.stream import unpack, unpack_pairs

Colour = tuple[int, int, int] | tuple[int, int, int, int]
Floats = NDArray[np.float32]

TIMELINE = "emulated time"

BLUE, SKY, GREEN, ORANGE, RED, PURPLE, GREY, DARK = (
    PALETTE[name].rgb for name in ("blue", "sky", "green", "orange", "red", "purple", "grey", "ink")
)
OUTCOME_COLOURS: dict[Outcome, Colour] = {outcome: PALETTE[outcome.colour].rgb for outcome in DRAWN}
"""In the order in which they are stacked."""

POSITION = Estimate(
    "position", "position", "estimate_m", "covariance_m2", "position_m", (1.0, 2.0, 5.0, 10.0, 50.0), 5.6
)
"""Rings are the scale of what is drawn around the truth; the larger ones are seen by zooming out."""
ELLIPSE_95 = 2.4477
"""√χ²(0.95; 2): so many standard deviations hold 95 % of a normal distribution in the plane."""
ELLIPSE_CORNERS = 32
HALF_ROOT = float(np.sqrt(0.5))

_ALSO_DRAWN = set("–—‘’“”„…·×÷±≤≥≠≈√→←↑↓°²³µ∞%")


def drawable(text: str) -> str:
    """The text with `?` for what the viewer's font has no glyph for, which would end the viewer."""
    return "".join(c if _has_glyph(c) else "?" for c in " ".join(text.split()))


def _has_glyph(character: str) -> bool:
    return character.isprintable() and (ord(character) < 0x180 or character in _ALSO_DRAWN)


@dataclass(frozen=True)
class PeriodArrays:
    """A period message as arrays; n vehicles in the order of `node_ids`, NaN for what was not reported."""

    message: Mapping[str, Any]
    node_ids: Sequence[str]

    @property
    def number(self) -> int:
        """Number of the period, from 0."""
        return int(self.message["period"])

    @property
    def time_ns(self) -> int:
        """Start of the period, in nanoseconds."""
        return int(self.message["time_ns"])

    @property
    def time_s(self) -> float:
        """The same in seconds."""
        return self.time_ns / 1e9

    def points(self, name: str) -> Floats:
        """One of the (n, 2) arrays, in metres; NaN where there is none."""
        return self._column(name, 2)

    def covariances(self, name: str) -> Floats:
        """One of the (n, 4) arrays as (n, 2, 2), in m²; NaN where there is none."""
        return self._column(name, 4).reshape(-1, 2, 2)

    def _column(self, name: str, size: int) -> Floats:
        found = self.message.get(name, self.message.get("columns", {}).get(name))
        if not isinstance(found, bytes) or len(found) != 4 * size * len(self.node_ids):
            return np.full((len(self.node_ids), size), np.nan, np.float32)
        return unpack(found, size)

    def numbers(self, name: str) -> Floats:
        """One of the (n,) arrays."""
        return unpack(self.message[name])[:, 0]

    def figure(self, name: str) -> float:
        """One of the figures; NaN where there is no number."""
        value = self.message["figures"].get(name)
        return float(value) if isinstance(value, float | int) else float("nan")

    @cached_property
    def up(self) -> NDArray[np.bool_]:
        """Mask of the vehicles that are up, (n,)."""
        return np.frombuffer(self.message["up"], dtype=np.uint8).astype(bool)

    @cached_property
    def down(self) -> list[str]:
        """The vehicles that are not, though they are in the network."""
        there = np.isfinite(self.points("position_m")[:, 0])
        return [node for node, down in zip(self.node_ids, there & ~self.up, strict=True) if down]

    @cached_property
    def pairs(self) -> NDArray[np.int32]:
        """Counts of outcomes by link, (k, 4): sender, receiver, outcome, count."""
        return unpack_pairs(self.message)

    def counts(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Frames attempted and frames delivered, each (n, n): row receives, column sends."""
        sender, receiver, outcome, number = self.pairs.T
        n = len(self.node_ids)
        place = receiver * n + sender + n * n * (outcome == Outcome.delivered)
        others, delivered = np.bincount(place, number, 2 * n * n).astype(np.int32).reshape(2, n, n)
        return others + delivered, delivered

    def received(self) -> tuple[NDArray[np.int32], Floats]:
        """Links that delivered, (k, 3): sender, receiver, how many; and (k,) the age of each newest frame in ms."""
        delivered = self.pairs[:, 2] == Outcome.delivered
        return self.pairs[delivered][:, [0, 1, 3]], self.numbers("pairs_age_ms")[delivered]

    def off_truth(self, of: Estimate) -> Floats:
        """Errors (n, 2) of an estimate in metres."""
        return self.points(of.estimate) - self.points(of.truth)

    def clouds(self, of: Estimate) -> dict[str, Floats]:
        """Points around the truth by node, (k, 2), in metres."""
        truth = np.broadcast_to(self.points(of.truth), (len(self.node_ids), 2))
        found = self.message.get("lists", {}).get(of.cloud, {})
        at = {node: number for number, node in enumerate(self.node_ids)}
        return {n: unpack(cloud, 2) - truth[at[n]] for n, cloud in found.items() if len(cloud) % 8 == 0}

    def values(self) -> dict[str, Floats]:
        """Numbers that programs report by names of their own, (n,) by name; none from an older vnet."""
        return {name: unpack(value)[:, 0] for name, value in self.message.get("values", {}).items()}

    def texts(self) -> dict[str, list[str]]:
        """Texts that programs report by names of their own, one a vehicle by name."""
        return {name: list(texts) for name, texts in self.message.get("texts", {}).items()}

    def peers(self) -> dict[str, dict[str, Floats]]:
        """By name and node, the values (n,) that it reported for each other one and itself."""
        found = self.message.get("peers", {})
        return {name: {node: unpack(each)[:, 0] for node, each in by.items()} for name, by in found.items()}


def link_states(period: PeriodArrays) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.int32]]:
    """Senders, receivers and states (outcomes) of the links on which frames were decided in a period.

    A link is `delivered` if a frame got through; else its state is what befell most of them.
    """
    pairs = period.pairs
    if not len(pairs):
        return np.empty(0, np.intp), np.empty(0, np.intp), np.empty(0, np.int32)
    link = pairs[:, 0].astype(np.intp) * len(period.node_ids) + pairs[:, 1]
    order = np.argsort(link, kind="stable")  # as a rule they come so
    pairs, link = pairs[order], link[order]
    rank = np.where(pairs[:, 2] == Outcome.delivered, _FIRST, pairs[:, 3])
    starts = np.flatnonzero(np.diff(link, prepend=-1))
    best = np.maximum.reduceat(rank * len(Outcome) + pairs[:, 2], starts)
    return link[starts] // len(period.node_ids), link[starts] % len(period.node_ids), best % len(Outcome)


_FIRST = np.int64(1) << 40
"""More than there are frames."""


def ellipses(centre_m: ArrayLike, covariance_m2: ArrayLike) -> Floats:
    """Outlines (k, ELLIPSE_CORNERS + 1, 2) of the 95 % ellipses, of those that are finite and positive."""
    centre, matrix = np.asarray(centre_m, dtype=float), np.asarray(covariance_m2, dtype=float)
    known = np.isfinite(centre).all(axis=1) & np.isfinite(matrix).all(axis=(1, 2))
    value, vector = np.linalg.eigh(matrix[known])
    angle = np.linspace(0, 2 * np.pi, ELLIPSE_CORNERS + 1)
    circle = ELLIPSE_95 * np.stack([np.cos(angle), np.sin(angle)])
    axes = vector * np.sqrt(np.maximum(value, 0.0))[:, None, :]
    return np.asarray(centre[known][:, None, :] + (axes @ circle).transpose(0, 2, 1), dtype=np.float32)


def outcome_colours(outcomes: NDArray[np.int32]) -> NDArray[np.uint8]:
    """The colours (k, 3) of outcomes."""
    return _COLOUR_OF[outcomes]


_COLOUR_OF = np.zeros((len(Outcome), 3), dtype=np.uint8)
for _outcome, _colour in OUTCOME_COLOURS.items():
    _COLOUR_OF[_outcome] = _colour[:3]


class _Rows:
    """Drawing of one entity, instant by instant."""

    def __init__(self) -> None:
        self.times_ns: list[int] = []
        self.arrays: list[NDArray[Any]] = []
        self.colours: list[NDArray[np.uint8]] = []

    def add(self, time_ns: int, array: NDArray[Any], colours: NDArray[np.uint8] | None = None) -> None:
        self.times_ns.append(time_ns)
        self.arrays.append(array)
        if colours is not None:
            self.colours.append(colours)

    @property
    def lengths(self) -> NDArray[np.int32]:
        """Number of elements at each instant."""
        return np.array([len(array) for array in self.arrays], dtype=np.int32)


class Canvas:
    """A recording to draw on. `at` sets the time; nothing may be awaited between it and what is drawn.

    Points, lines and plots are kept until `send`: one message of many instants costs little more than one of one.
    """

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._time_ns = 0
        self._points: dict[str, _Rows] = defaultdict(_Rows)
        self._strips: dict[str, _Rows] = defaultdict(_Rows)
        self._plots: dict[str, tuple[list[int], list[float]]] = {}
        self._bars: dict[str, Floats] = {}
        self._announced: set[str] = set()

    def at(self, time_ns: int) -> None:
        """Set the emulated time of whatever is drawn from now on."""
        self._time_ns = time_ns

    def log(self, entity: str, *what: rr.AsComponents, static: bool = False) -> None:
        """Anything that Rerun knows."""
        if not static:
            self._recording.set_time(TIMELINE, duration=np.timedelta64(self._time_ns, "ns"))
        self._recording.log(entity, what[0], *what[1:], static=static)

    def point_style(
        self,
        entity: str,
        colours: Colour | ArrayLike | None,
        radius: float,
        labels: Sequence[str] | None = None,
        show_labels: bool = False,
        order: float | None = None,
    ) -> None:
        """Set the style of an entity's points for all times: `radius` on the screen, one colour or one each.

        None for colours that change: what is always there would hide what comes with a time.
        """
        style = rr.Points2D.from_fields(
            colors=[colours] if isinstance(colours, tuple) else colours,
            radii=rr.Radius.ui_points(radius),
            labels=labels,
            show_labels=None if labels is None else show_labels,
            draw_order=order,
        )
        self.log(entity, style, static=True)

    def points(self, entity: str, position_m: ArrayLike, static: bool = False) -> None:
        """Points (k, 2) where they are now; those at NaN are not seen."""
        position = flipped(np.asarray(position_m, dtype=np.float32).reshape(-1, 2))
        if static:
            self.log(entity, rr.Points2D.from_fields(positions=position), static=True)
        else:
            self._points[entity].add(self._time_ns, position)

    def labels(
        self, entity: str, position_m: ArrayLike, colours: Colour | ArrayLike, labels: Sequence[str]
    ) -> None:
        """Words that are always there."""
        self.point_style(entity, colours, 0.1, labels, show_labels=True)
        self.points(entity, position_m, static=True)

    def strip_style(self, entity: str, colour: Colour | None, width: float, order: float | None = None) -> None:
        """Set the style of an entity's lines for all times: `width` on screen; None for a changing colour."""
        style = rr.LineStrips2D.from_fields(
            colors=None if colour is None else [colour],
            radii=rr.Radius.ui_points(width / 2),
            draw_order=order,
        )
        self.log(entity, style, static=True)

    def strips(
        self, entity: str, strips_m: Any, colours: NDArray[np.uint8] | None = None, static: bool = False
    ) -> None:
        """Lines (k, corners, 2) as they are now."""
        strips = flipped(strips_m)
        if static:
            self.log(entity, rr.LineStrips2D.from_fields(strips=_strip_array([strips])), static=True)
        else:
            self._strips[entity].add(self._time_ns, strips, colours)

    def rings(self, entity: str, radii_m: Sequence[float], cross: bool = True) -> None:
        """Circles around the origin, each with its radius in words: the scale of a view."""
        angle = np.linspace(0, 2 * np.pi, 65)
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self.strip_style(f"{entity}/rings", (*GREY, 110), 1.0, -20.0)
        self.strips(f"{entity}/rings", [radius * circle for radius in radii_m], static=True)
        where = [(HALF_ROOT * radius, HALF_ROOT * radius) for radius in radii_m]
        self.labels(f"{entity}/radii", where, GREY, [in_length(radius) for radius in radii_m])
        if cross:
            arm = 0.12 * radii_m[0]
            self.strip_style(f"{entity}/truth", RED, 2.5, 50.0)
            self.strips(f"{entity}/truth", [[[-arm, 0], [arm, 0]], [[0, -arm], [0, arm]]], static=True)

    def series(
        self, entity: str, styles: Sequence[tuple[str, Colour, float]], aggregation: Literal["MinMax"] | None = None
    ) -> None:
        """Announce lines against time, once: names (with units, where the view has none), colours and widths."""
        if entity not in self._announced:
            self._announced.add(entity)
            names, colours, widths = zip(*styles, strict=True)
            lines = rr.SeriesLines(names=names, colors=colours, widths=widths, aggregation_policy=aggregation)
            self.log(entity, lines, static=True)

    def states(self, entity: str, colours: Mapping[str, Colour]) -> None:
        """Announce states of a timeline, once, and their colours; others have colours of Rerun's choice."""
        if entity not in self._announced:
            self._announced.add(entity)
            style = rr.StateConfiguration(values=list(colours), colors=list(colours.values()))
            self.log(entity, style, static=True)

    def plot(self, entity: str, *values: float) -> None:
        """One more value of each line of an entity against time, NaN for none."""
        self.plot_at(entity, [self._time_ns], values)

    def plot_at(self, entity: str, times_ns: Sequence[int], values: Sequence[float]) -> None:
        """More values of an entity: at each time as many as it has lines."""
        times, numbers = self._plots.setdefault(entity, ([], []))
        times.extend(times_ns)
        numbers.extend(values)

    def bars(self, entity: str, values: ArrayLike, middles: ArrayLike, width: float, colour: Colour) -> None:
        """A bar chart with bars of `width` around `middles`, which are only told when they change."""
        where, heights = np.asarray(middles, dtype=np.float32), np.asarray(values, dtype=np.float32)
        told = self._bars.get(entity)
        if told is None or not np.array_equal(told, where):
            self._bars[entity] = where
            widths = np.full(len(where), width, dtype=np.float32)
            self.log(entity, rr.BarChart(heights, color=colour, abscissa=where, widths=widths))
        else:
            self.log(entity, rr.BarChart.from_fields(values=heights))

    def send(self) -> None:
        """Send what has been kept."""
        index = cache(_index)  # most entities have the same times
        for entity, rows in self._points.items():
            columns = rr.Points2D.columns(positions=np.concatenate(rows.arrays))
            self._recording.send_columns(entity, index(tuple(rows.times_ns)), columns.partition(rows.lengths))
        for entity, rows in self._strips.items():
            colours = np.concatenate(rows.colours) if rows.colours else None
            columns = rr.LineStrips2D.columns(strips=_strip_array(rows.arrays), colors=colours)
            self._recording.send_columns(entity, index(tuple(rows.times_ns)), columns.partition(rows.lengths))
        for entity, (times_ns, numbers) in self._plots.items():
            columns = rr.Scalars.columns(scalars=np.array(numbers))
            lines = np.full(len(times_ns), len(numbers) // len(times_ns))
            self._recording.send_columns(entity, index(tuple(times_ns)), columns.partition(lines))
        for kept in (self._points, self._strips, self._plots):
            kept.clear()


def _index(times_ns: tuple[int, ...]) -> list[rr.TimeColumn]:
    return [rr.TimeColumn(TIMELINE, duration=np.array(times_ns, dtype="timedelta64[ns]"))]


_STRIPS = rr.components.LineStrip2DBatch([]).as_arrow_array().type


def _strip_array(arrays: Sequence[Floats]) -> pa.Array:
    """Strips (k, corners, 2) of all arrays as Rerun keeps them; its own conversion goes strip by strip."""
    corners = np.concatenate([np.full(len(array), array.shape[1], dtype=np.int32) for array in arrays])
    if not len(corners):
        return pa.array([], type=_STRIPS)
    points = rr.encodings.Vec2DBatch(np.concatenate([array.reshape(-1, 2) for array in arrays])).as_arrow_array()
    starts = np.concatenate([[0], np.cumsum(corners)]).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(starts), points, type=_STRIPS)


def nice_length(at_most: float) -> float:
    """The largest of 1, 2, 5, 10, 20, … that is not above."""
    power = 10.0 ** np.floor(np.log10(at_most))
    return float(max(step * power for step in (1, 2, 5) if step * power <= at_most))


def in_length(length_m: float) -> str:
    """A length in words: 500 m, 2 km."""
    return f"{length_m / 1000:.4g} km" if length_m >= 1000 else f"{length_m:.4g} m"


def flipped(position: ArrayLike) -> Floats:
    """East, north as Rerun's x right, y down."""
    return np.asarray(position, dtype=np.float32) * np.array([1, -1], dtype=np.float32)
