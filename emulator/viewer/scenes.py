"""Scenes of a recording, drawn from the scene and period messages of a run.

The whole network: map, estimates, figures, faults and events. Its radio. One vehicle: where it is and thinks it is,
whom it hears and trusts. What programs report by names of their own.
"""

from __future__ import annotations

import tomllib
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from emulator.radio.outcomes import Outcome
from emulator.records.events import WARNING, EventKind, level_of
from emulator.records.metrics import DeclaredReference, ReferenceFailedError, Setting, named
from emulator.records.period_figures import Views
from emulator.records.run_folder import SCENARIO_FILE
from emulator.scenario.loading import parse_recorded_scenario
from emulator.scenario.own_functions import declared, load_entry
from emulator.scenario.scenario import Radio
from emulator.stream import LATENCY_BIN_NS, unpack
from emulator.viewer.drawing import (
    BLUE,
    DARK,
    GREEN,
    GREY,
    ORANGE,
    OUTCOME_COLOURS,
    POSITION,
    PURPLE,
    RED,
    SKY,
    Canvas,
    Floats,
    PeriodArrays,
    drawable,
    ellipses,
    flipped,
    in_length,
    link_states,
    nice_length,
    outcome_colours,
)
from vnet.errors import VnetError, counted, first_names
from vnet.types import Array
from vnet.units import label_of

WINDOW_S = 5.0
"""Shares, histograms and loads are those of so many last seconds, and redrawn as often."""
DISTANCE_BINS = 20
STROKES = 8
"""The layers of the stacked chart are lines that go up and down so often in a period: Rerun fills no areas."""
LEAST_LATENCY_BINS = 8
LARGEST_MATRIX = 400
"""Vehicles of which matrices are drawn: of links, and of what they report of each other."""


def next_charts_s(time_s: float) -> float:
    """Time of the charts' next redraw: soon in the beginning, then as often as there is new data."""
    return time_s + min(max(1.0, time_s), WINDOW_S)


class SlidingSum:
    """Sums of arrays of whole numbers over the last periods."""

    def __init__(self, periods: int) -> None:
        self._kept: deque[NDArray[Any]] = deque()
        self._periods = max(1, periods)
        self.total: NDArray[Any] = np.zeros(1)

    def add(self, array: NDArray[Any]) -> None:
        """Take one period's."""
        self._kept.append(array)
        self.total = self.total + array
        if len(self._kept) > self._periods:
            self.total -= self._kept.popleft()

    def __len__(self) -> int:
        return len(self._kept)


class Ages:
    """Age of information at the receivers, and the gaps between packets from one sender.

    Times between receptions are those between the sendings of what is received.
    """

    def __init__(self, count: int, periods: int) -> None:
        self._sent_ms = np.full((count, count), np.nan)
        self._gaps = SlidingSum(periods)

    def period(self, period: PeriodArrays, end_ms: float) -> None:
        """Take a period that ended then."""
        links, age_ms = period.received()
        sender, receiver, number = links.T
        sent_ms, before_ms = end_ms - age_ms, self._sent_ms[receiver, sender]
        newer = sent_ms > before_ms
        self._gaps.add(np.array([(sent_ms - before_ms)[newer].sum(), number[newer].sum()]))
        self._sent_ms[receiver, sender] = np.fmax(before_ms, sent_ms)
        if not period.up.all():
            self._sent_ms[~period.up] = self._sent_ms[:, ~period.up] = np.nan

    def at(self, end_ms: float, tried: NDArray[Any]) -> NDArray[np.float64]:
        """The ages in ms (n, n), a row receives, a column sends; NaN on links that have not brought anything yet.

        Links on which there were no frames of late, by `tried` (n, n), begin again.
        """
        self._sent_ms[tried == 0] = np.nan
        return end_ms - self._sent_ms

    @property
    def mean_gap_ms(self) -> float:
        """The mean time between receptions over all links of late; NaN if nothing came twice."""
        total_ms, gaps = self._gaps.total
        return float(total_ms / gaps) if gaps else float("nan")


class RadioScene:
    """Draws what concerns the radio below `/radio`, from the scene and period messages of a run."""

    def __init__(self, canvas: Canvas, scene: Mapping[str, Any]) -> None:
        self._canvas = canvas
        self._count = len(scene["node_ids"])
        self._period_ns: int = scene["period_ns"]
        self._period_s = self._period_ns / 1e9
        self._range_m: float | None = scene["range_m"]
        periods = round(WINDOW_S / self._period_s)
        self._tried, self._delivered = SlidingSum(periods), SlidingSum(periods)
        self._apart: deque[Sequence[NDArray[Any]]] = deque(maxlen=max(1, periods))
        """The links with frames in each of the last periods: lengths (m), frames tried, and frames delivered."""
        self._latency, self._sent, self._received = SlidingSum(periods), SlidingSum(periods), SlidingSum(periods)
        self._latency_bins = LEAST_LATENCY_BINS
        self._ages = Ages(self._count if self._count <= LARGEST_MATRIX else 0, periods)
        self._next_s = 0.0
        loads = (("sent: mean", SKY, 2.0), ("sent: most", BLUE, 1.0), ("received: mean", GREEN, 2.0))
        canvas.series("radio/load", [*loads, ("received: most", ORANGE, 1.0)])

    def period(self, period: PeriodArrays) -> None:
        """Draw a period."""
        self._stack(period)
        self._load(period)
        self._busy(period)
        if self._count <= LARGEST_MATRIX:
            tried, delivered = period.counts()
            self._tried.add(tried)
            self._delivered.add(delivered)
            position_m = period.points("position_m").astype(float)
            used = np.nonzero(tried)
            distance_m = np.hypot(*(position_m[used[0]] - position_m[used[1]]).T)
            known = np.isfinite(distance_m)  # who has left is nowhere
            self._apart.append((distance_m[known], tried[used][known], delivered[used][known]))
            self._ages.period(period, self._end_ms(period))
        self._latency.add(np.frombuffer(period.message["latency_counts"], dtype="<i4"))
        self._sent.add(period.numbers("sent_bytes").astype(float))
        self._received.add(period.numbers("received_bytes").astype(float))
        if period.time_s >= self._next_s:
            self._next_s = next_charts_s(period.time_s)
            self._charts(period)

    def _stack(self, period: PeriodArrays) -> None:
        """Frames by outcome, one layer on the other: each is a line from its lower to its upper bound and back.

        The line ends with the period: joined to the next one, which has another number of frames, it would be seen
        as frames of this outcome.
        """
        points = 2 * STROKES + 1
        times_ns = (period.time_ns + self._period_ns * np.arange(points) // points).tolist()
        lower = 0.0
        for outcome, colour in OUTCOME_COLOURS.items():
            count = period.message["outcomes"].get(outcome.name, 0)
            entity = f"radio/frames/{outcome.name}"
            if count:
                self._canvas.series(entity, [(outcome.title, colour, 2.5)], "MinMax")
                self._canvas.plot_at(entity, times_ns, [lower, lower + count] * STROKES + [np.nan])
            lower += count

    def _load(self, period: PeriodArrays) -> None:
        rates = [period.numbers(name) / self._period_s / 1e3 for name in ("sent_bytes", "received_bytes")]
        self._canvas.plot("radio/load", *(float(value) for rate in rates for value in (rate.mean(), rate.max())))

    def _busy(self, period: PeriodArrays) -> None:
        ratio = 100 * period.numbers("busy_ratio")[period.up]
        if not len(ratio) or np.isnan(ratio).any():  # senders share no medium, or no window is over
            return
        self._canvas.series("radio/busy", [("mean", SKY, 2.0), ("most", BLUE, 1.0)])
        self._canvas.plot("radio/busy", float(ratio.mean()), float(ratio.max()))

    def _age(self, end_ms: float) -> None:
        """Ages by vehicle, and over all links."""
        ages_ms = self._ages.at(end_ms, self._tried.total)
        known = np.isfinite(ages_ms)
        by_receiver_ms = np.where(known, ages_ms, 0).sum(axis=1) / np.maximum(1, known.sum(axis=1))
        self._canvas.bars("radio/ages", by_receiver_ms, np.arange(self._count), 0.8, SKY)
        if not known.any():
            return
        lines = (("age: half of the links", SKY, 2.0), ("age: 95 % of the links", BLUE, 1.0))
        self._canvas.series("radio/age", [*lines, ("between receptions: mean", PURPLE, 2.0)])
        # Not the mean: a link that the peer cap closes for good would raise it for ever.
        half_ms, most_ms = np.quantile(ages_ms[known], [0.5, 0.95], method="higher").tolist()
        self._canvas.plot("radio/age", half_ms, most_ms, self._ages.mean_gap_ms)

    def _charts(self, period: PeriodArrays) -> None:
        canvas, span_s = self._canvas, len(self._latency) * self._period_s
        latency, width_ms = self._latency.total, LATENCY_BIN_NS / 1e6
        self._latency_bins = max(self._latency_bins, int(np.flatnonzero(latency).max(initial=0)) + 2)
        latency = latency[: self._latency_bins]
        canvas.bars("radio/latency", latency, (np.arange(len(latency)) + 0.5) * width_ms, width_ms, SKY)
        for side, name, window, colour in ((-1, "sent", self._sent, SKY), (1, "received", self._received, GREEN)):
            rate = window.total / span_s / 1e3
            canvas.bars(f"radio/bytes/{name}", rate, np.arange(self._count) + 0.2 * side, 0.4, colour)
        if self._count <= LARGEST_MATRIX:
            self._links()
            self._age(self._end_ms(period))

    def _end_ms(self, period: PeriodArrays) -> float:
        return (period.time_ns + self._period_ns) / 1e6

    def _links(self) -> None:
        """Delivery by link, by vehicle and by distance."""
        tried, delivered = self._tried.total, self._delivered.total
        vehicles, heard = np.arange(self._count), 100 * delivered.sum(axis=1) / np.maximum(1, tried.sum(axis=1))
        self._canvas.bars("radio/heard", heard, vehicles, 0.8, GREEN)
        share = np.divide(delivered, tried, out=np.full(tried.shape, np.nan), where=tried > 0)
        axes = ("receiver", "sender")
        self._canvas.log("radio/links", rr.Tensor(share.astype(np.float32), dim_names=axes, value_range=(0, 1)))
        distance_m, tried, delivered = (np.concatenate(each) for each in zip(*self._apart, strict=True))
        farthest_m = self._range_m or float(distance_m.max(initial=1.0))
        shares, middles_m, width_m = delivery_by_distance(distance_m, tried, delivered, farthest_m)
        self._canvas.bars("radio/distance", 100 * np.nan_to_num(shares), middles_m, 0.95 * width_m, GREEN)


def delivery_by_distance(
    distance_m: NDArray[np.float64], tried: NDArray[Any], delivered: NDArray[Any], farthest_m: float
) -> tuple[Floats, Floats, float]:
    """Shares delivered by distance: (DISTANCE_BINS,), NaN where nobody tried; the bins' middles and width (m)."""
    width_m = farthest_m / DISTANCE_BINS
    place = np.minimum((distance_m / width_m).astype(int), DISTANCE_BINS - 1)
    tries, hits = (np.bincount(place, each, DISTANCE_BINS) for each in (tried, delivered))
    share = np.divide(hits, tries, out=np.full(DISTANCE_BINS, np.nan), where=tries > 0)
    middles_m = (np.arange(DISTANCE_BINS) + 0.5) * width_m
    return share.astype(np.float32), middles_m.astype(np.float32), width_m


SLOW_EVERY_S = 1.0
"""Interval at which ellipses and neighbours are drawn."""
ERROR_CURVES = (SKY, RED, ORANGE)
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
            [(each.title, colour, 2.0) for each, colour in zip(self._estimates, ERROR_CURVES, strict=False)],
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
        canvas.plot(
            "vehicle/errors", *[float(np.hypot(*off_m[0])) for off_m in errors.values()][: len(ERROR_CURVES)]
        )
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
    return drawable(label_of(name))


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
            self._canvas.states(entity("texts", name), {text: SKY})
            self._told[name] = text
            self._canvas.log(entity("texts", name), rr.StateChange(state=text))


LANE_HALF_LENGTH_M = 250.0
ELLIPSES_EVERY_S = 1.0
"""Interval at which ellipses and clouds are drawn."""
CURVES = (RED, SKY, BLUE, ORANGE)
"""Colours of the curves of a chart that the program declares."""
LOG_LEVELS = {"debug": "DEBUG", "warning": "WARN", "error": "ERROR", "critical": "CRITICAL"}
"""Rerun's names of the levels of a program's log."""
NAMED_DOWN = 6
ACTING, NOBODY = "acting", "none"
"""States of faults, and of those who are down."""
LEGEND_STEP = 3.1
"""From one name of the legend to the next; its rows are 1 apart."""


class OverviewScene:
    """Draws the network, from the scene and period messages of a run."""

    def __init__(self, canvas: Canvas, scene: Mapping[str, Any], views: Views) -> None:
        self._canvas = canvas
        self._views = views
        self._node_ids: list[str] = scene["node_ids"]
        try:
            self._reference: DrawnReference | None = DrawnReference(scene)
        except VnetError:
            self._reference = None
        self._published = published(scene)
        self._peers: dict[str, Floats] = {}
        """By name, the latest values that vehicles (rows) reported for others (columns)."""
        self._faults: set[str] = set()
        self._down: list[str] | None = None
        self._up: bytes | None = None
        self._clouds: dict[str, dict[str, Floats]] = {each.name: {} for each in views.estimates}
        """Each vehicle's latest, by estimate."""
        self._next_ellipses_s = self._next_peers_s = 0.0
        self._draw_static(scene)

    def _draw_static(self, scene: Mapping[str, Any]) -> None:
        canvas = self._canvas
        canvas.log("about", rr.TextDocument(describe(scene), media_type=rr.MediaType.MARKDOWN), static=True)
        point, heading = unpack(scene["lane_point_m"], 2), unpack(scene["lane_heading_rad"])[:, 0]
        length = unpack(scene["lane_length_m"])[:, 0]
        endless = np.isinf(length)
        ahead, behind = np.where(endless, LANE_HALF_LENGTH_M, length), np.where(endless, LANE_HALF_LENGTH_M, 0)
        along = np.column_stack([np.cos(heading), np.sin(heading)])
        lanes = np.stack([point - behind[:, None] * along, point + ahead[:, None] * along], axis=1)
        canvas.strip_style("map/lanes", (*GREY, 120), 1.0, -30.0)
        canvas.strips("map/lanes", lanes, static=True)
        if len(edges := unpack(scene["building_edge_m"], 2).reshape(-1, 2, 2)):
            canvas.strip_style("map/buildings", (*GREY, 200), 1.0, -29.0)
            canvas.strips("map/buildings", edges, static=True)
        self._set_styles()
        if units := tomllib.loads(scene["scenario"]).get("roadside", []):
            names = [unit["id"] for unit in units]
            canvas.point_style("map/roadside", ORANGE, 7.0, names, show_labels=True, order=29.0)
            canvas.points("map/roadside", [unit["position_m"] for unit in units], static=True)
        self._has_background = has_background(scene)
        if self._has_background:
            canvas.point_style("map/background", GREY, 1.5, order=-20.0)
        draw_scale(canvas, point if len(point) else unpack(scene["area_m"], 2))
        draw_legend(canvas, scene)
        for each in (POSITION, *self._views.estimates):
            canvas.rings(each.name, each.rings_m)
        for chart in self._views.charts:
            lines = [(label, colour, 2.0) for label, colour in zip(chart.lines, CURVES, strict=False)]
            first = next(iter(chart.lines.values()))
            if self._reference is not None:
                lines.append((self._reference.label, GREEN, 1.5))
            if first in self._published:
                lines.append((self._published[first][0], GREY, 1.5))
            canvas.series(f"figures/{chart.id}", lines)
        canvas.states("faults/down", {NOBODY: DARK})
        canvas.series("figures/position", [("estimate", SKY, 2.0), ("raw fix", GREY, 1.0)])

    def _set_styles(self) -> None:
        canvas = self._canvas
        canvas.strip_style("map/links", None, 1.8, -10.0)
        canvas.point_style("map/true", None, 5.0, self._node_ids)
        canvas.point_style("map/fix", GREY, 2.0)
        canvas.point_style("map/estimate", BLUE, 2.5, order=31.0)
        canvas.point_style("position/fix", GREY, 3.0, self._node_ids)
        canvas.point_style("position/estimate", SKY, 4.0, self._node_ids)
        for each in self._views.estimates:
            canvas.point_style(f"{each.name}/cloud", GREY, 1.0)
            canvas.point_style(f"{each.name}/estimate", SKY, 4.0, self._node_ids)
            canvas.strip_style(f"{each.name}/ellipses", (*SKY, 130), 1.2)

    def period(self, period: PeriodArrays) -> None:
        """Draw a period."""
        self._map(period)
        self._beliefs(period)
        self._figures(period)
        self._of_peers(period)
        self._faults_and_downs(period)
        self.events(period.message["events"])
        self._canvas.at(period.time_ns)

    def _map(self, period: PeriodArrays) -> None:
        canvas, position = self._canvas, period.points("position_m")
        sender, receiver, state = link_states(period)
        # Each direction is the half of the line that is nearer to its sender.
        halves = np.stack([position[sender], (position[sender] + position[receiver]) / 2], axis=1)
        canvas.strips("map/links", halves, outcome_colours(state))
        canvas.points("map/true", position)
        if self._has_background:
            canvas.points("map/background", period.points("background_m"))
        canvas.points("map/fix", period.points("fix_m"))
        canvas.points("map/estimate", period.points("estimate_m"))

    def _beliefs(self, period: PeriodArrays) -> None:
        canvas, position = self._canvas, period.points("position_m")
        canvas.points("position/fix", period.points("fix_m") - position)
        canvas.points("position/estimate", period.off_truth(POSITION))
        is_time = period.time_s >= self._next_ellipses_s
        if is_time:
            self._next_ellipses_s = period.time_s + ELLIPSES_EVERY_S
        for each in self._views.estimates:
            off_m, clouds = period.off_truth(each), self._clouds[each.name]
            canvas.points(f"{each.name}/estimate", off_m)
            clouds |= period.clouds(each)
            for node in period.down:
                clouds.pop(node, None)
            if is_time:
                canvas.strips(f"{each.name}/ellipses", ellipses(off_m, period.covariances(each.covariance)))
                if clouds:
                    canvas.points(f"{each.name}/cloud", np.concatenate([clouds[node] for node in sorted(clouds)]))

    def _figures(self, period: PeriodArrays) -> None:
        found: Mapping[str, float] = {}
        if self._reference is not None:
            with suppress(ReferenceFailedError):  # the report says why
                found = self._reference.step(period.message)
        for chart in self._views.charts:
            names = list(chart.lines.values())[: len(CURVES)]
            values = [period.figure(name) for name in names]
            if self._reference is not None:
                values.append(found.get(names[0], float("nan")))
            if names[0] in self._published:
                values.append(self._published[names[0]][1])
            self._canvas.plot(f"figures/{chart.id}", *values)
        self._canvas.plot("figures/position", period.figure("position_rmse_m"), period.figure("fix_rmse_m"))

    def _of_peers(self, period: PeriodArrays) -> None:
        count = len(self._node_ids)
        for name, by_node in period.peers().items():
            matrix = self._peers.setdefault(name, np.full((count, count), np.nan, dtype=np.float32))
            for node, row in by_node.items():
                matrix[self._node_ids.index(node)] = row
        for matrix in self._peers.values():
            matrix[~period.up] = np.nan
        if not self._peers or period.time_s < self._next_peers_s or count > LARGEST_MATRIX:
            return
        self._next_peers_s = next_charts_s(period.time_s)
        for name, matrix in self._peers.items():
            axes = ("reports", "of")
            self._canvas.log(f"peers/{name}", rr.Tensor(matrix, dim_names=axes, value_range=(0, 1)))

    def _faults_and_downs(self, period: PeriodArrays) -> None:
        acting = set(period.message["faults"])
        for label in sorted(acting ^ self._faults):
            self._canvas.states(f"faults/{label}", {ACTING: PURPLE})
            state = ACTING if label in acting else ""  # an empty state ends the one before
            self._canvas.log(f"faults/{label}", rr.StateChange(state=state))
        self._faults = acting
        up = period.up.tobytes()
        if up != self._up:  # as vehicles enter and leave, too: who is down may be the same then
            colours = np.where(period.up[:, None], np.array(SKY, dtype=np.uint8), np.array(RED, dtype=np.uint8))
            self._canvas.log("map/true", rr.Points2D.from_fields(colors=colours))
            self._up = up
        down = period.down
        if down != self._down:
            shown = first_names(down, NAMED_DOWN)
            self._canvas.log("faults/down", rr.StateChange(state=f"{len(down)}: {shown}" if down else NOBODY))
            self._down = down

    def events(self, events: Iterable[Mapping[str, Any]]) -> None:
        """Write down what happened, each event at its own time."""
        for event in events:
            self._canvas.at(event["time_ns"])
            planned = event["kind"] == EventKind.fault_started
            level = "WARN" if level_of(event["kind"], event["details"]) >= WARNING or planned else "INFO"
            if event["kind"] == EventKind.log:
                level = LOG_LEVELS.get(str(event["details"].get("level")), level)
            self._canvas.log("events", rr.TextLog(drawable(event["text"]), level=level))


def draw_scale(canvas: Canvas, point_m: Floats) -> None:
    """A bar with its length in words, below the map on the left."""
    low, high = point_m.min(axis=0), point_m.max(axis=0)
    length_m = nice_length(max(float(high[0] - low[0]) / 5, 1.0))
    x, y = low[0], low[1] - max(0.08 * float(high[1] - low[1]), length_m / 10)
    ends = [[[end, y - length_m / 30], [end, y + length_m / 30]] for end in (x, x + length_m)]
    canvas.strip_style("map/scale/bar", GREY, 2.0)
    canvas.strips("map/scale/bar", [[[x, y], [x + length_m, y]], *ends], static=True)
    canvas.labels("map/scale/length", [[x + length_m / 2, y]], GREY, [in_length(length_m)])


def draw_legend(canvas: Canvas, scene: Mapping[str, Any]) -> None:
    """Legend of the map's colours, in a view of its own: two rows of points with their names."""
    vehicles = [("true position", SKY), ("estimate", BLUE), ("raw fix", GREY), ("vehicle down", RED)]
    if "roadside" in tomllib.loads(scene["scenario"]):
        vehicles.append(("roadside unit", ORANGE))
    if has_background(scene):
        vehicles.append(("small: without program", GREY))
    never = impossible(scene)
    links = [(one.title, colour) for one, colour in OUTCOME_COLOURS.items() if one not in never]
    for entity, items, row in (("vehicles", vehicles, 0.0), ("links", links, -1.0)):
        place = [[LEGEND_STEP * number, row] for number in range(1, len(items) + 1)]
        canvas.labels(f"legend/{entity}/title", [[0.0, row]], GREY, [f"{entity}:"])
        colours = [list(colour) for _, colour in items]
        canvas.point_style(f"legend/{entity}", colours, 5.0, [label for label, _ in items], show_labels=True)
        canvas.points(f"legend/{entity}", place, static=True)


def has_background(scene: Mapping[str, Any]) -> bool:
    """Return whether there are vehicles without programs."""
    return bool(tomllib.loads(scene["scenario"]).get("network", {}).get("step"))


def impossible(scene: Mapping[str, Any]) -> set[Outcome]:
    """The outcomes that no reception of this run can have, whatever faults are injected."""
    scenario = parse_recorded_scenario(scene["scenario"], Path(SCENARIO_FILE))
    vehicles = len(scene["node_ids"])
    return {outcome for outcome in Outcome if not outcome.is_possible(scenario, vehicles)}


def in_reach(radio: Radio) -> str:
    """Rule of connectivity in words."""
    if radio.path_loss is None:
        return "radio by given links" if radio.links else f"radio {radio.range_m:g} m"
    stages: dict[str, str] = {
        "shadowing": "shadowing",
        "buildings": "buildings",
        "fading": "fading",
        "mac": "CSMA" if radio.mac is None or radio.mac.kind == "80211p" else radio.mac.kind,
        "congestion": "congestion",
    }
    words = [f"radio: {radio.path_loss.kind.replace('_', ' ')}"]
    return ", ".join(words + [text for name, text in stages.items() if getattr(radio, name) is not None])


def describe(scene: Mapping[str, Any]) -> str:
    """A run in a heading and a line, as Markdown."""
    scenario = parse_recorded_scenario(scene["scenario"], Path("scenario"))
    run, radio = scenario.run, scenario.radio
    count = int(np.frombuffer(scene["component"], dtype="<i2").max()) + 1
    at_first = " at first" if scene["moves"] else ""
    parts = [
        f"{len(scene['node_ids'])} vehicles in {counted(count, 'component')}{at_first}",
        scenario.program.entry.removesuffix(":main"),
        f"{in_reach(radio)}, loss {radio.loss:.0%}, at most {scene['max_peers']} peers",
        f"{run.pacing}, {run.duration_s:g} s, seed {run.seed}",
    ]
    return f"### {drawable(scene['name'])}\n\n{drawable(' · '.join(parts))}"


class DrawnReference:
    """Takes the messages of a run; see `emulator.records.metrics`. Raises VnetError if it has no reference."""

    def __init__(self, scene: Mapping[str, Any]) -> None:
        scenario = parse_recorded_scenario(scene["scenario"], Path("scenario"))
        reference, self._count = DeclaredReference(scenario), len(scene["node_ids"])
        self.label = f"{reference.name}: {reference.text}"
        point_m = unpack(scene["lane_point_m"], 2).astype(float)
        heading_rad = unpack(scene["lane_heading_rad"])[:, 0].astype(float)
        component = np.frombuffer(scene["component"], dtype="<i2")
        self._sizes = {
            name: each.type.list_size if pa.types.is_fixed_size_list(each.type) else 1
            for name, each in reference.columns.items()
        }
        self._step = reference.begin(Setting(scenario, component, point_m, heading_rad))

    def step(self, period: Mapping[str, Any]) -> dict[str, float]:
        """Take a period; returns its figures of the whole network by name. Periods may be left out.

        Raises ReferenceFailedError.
        """
        told = {**period["columns"], **period}
        states = {name: self._column(name, told[name]) for name in self._sizes}
        up = np.frombuffer(period["up"], dtype=np.uint8).astype(bool)
        if "fix_m" in states:
            states["fix_m"] = np.where(up[:, None], states["fix_m"], np.nan)
        figures = self._step(int(period["time_ns"]), states)
        return {name: figure for name, figure in figures.items() if not isinstance(figure, list)}

    def _column(self, name: str, data: bytes) -> Array:
        """Return a column of the states, with a row for each vehicle."""
        size = self._sizes[name]
        if size == 1:
            return unpack(data)[:, 0].astype(float)
        return np.broadcast_to(unpack(data, size).astype(float), (self._count, size))


def published(scene: Mapping[str, Any]) -> dict[str, tuple[str, float]]:
    """Return what has been published of such a run, as its programs declare it: a label and a value by figure."""
    found: dict[str, tuple[str, float]] = {}
    try:
        scenario = parse_recorded_scenario(scene["scenario"], Path("scenario"))
        for entry in declared(scenario.program, "PUBLISHED"):
            with named(f"PUBLISHED {entry}"):
                values = load_entry(entry)(scene).items()
                found |= {name: (str(label), float(value)) for name, (label, value) in values}
    except VnetError:  # a run is drawn all the same
        return {}
    return found
