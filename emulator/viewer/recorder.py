"""A Rerun recording of a run, from what the emulator tells observers, and its layout.

Few batched entities: one for all vehicles, one for all links, one for all points. Periods are drawn several at
a time. The layout is an overview, the radio, and one vehicle, as tabs; lengths are in metres, times in emulated
seconds, east is right and north is up.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, TypeVar

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from emulator.records.period_figures import NO_VIEWS, Estimate, Views, views_of
from emulator.viewer.drawing import POSITION, TIMELINE, Canvas, PeriodArrays
from emulator.viewer.scenes import WINDOW_S, OverviewScene, ProgramScene, RadioScene, VehicleScene, entity, titled
from emulator.viewer.sinks import Sinks, open_recording, written
from vnet.errors import VnetError, first_names

T = TypeVar("T")
SAME_M = 1e-3
"""Distance up to which a reported position is the raw fix again, whose float32 rounds to millimetres."""
DRAWN_TOGETHER_S = 1.0
"""Periods are drawn some at a time: ten take hardly longer than three that come apart."""


@dataclass(frozen=True)
class Content:
    """Kinds of data that a run has; `values` and `texts` are names that programs report.

    Of what its program declares, those that have been reported: `estimates`, `charts`, and `peers`.
    """

    estimates: tuple[Estimate, ...] = ()
    """With `POSITION` if estimates are not the raw fixes again."""
    charts: tuple[tuple[str, str], ...] = ()
    """Id and title."""
    peers: tuple[str, ...] = ()
    busy: bool = False
    """Channel busy ratios."""
    values: tuple[str, ...] = ()
    texts: tuple[str, ...] = ()

    def after(self, period: PeriodArrays, views: Views, values: list[str], texts: list[str]) -> Content:
        """Return the content of the run up to and with this period."""
        off_m = period.points("estimate_m") - period.points("fix_m")
        seen = [each for each in views.estimates if np.isfinite(period.points(each.estimate)).any()]
        if (np.abs(off_m) > SAME_M).any():
            seen.append(POSITION)
        charts = [
            (each.id, each.axis)
            for each in views.charts
            if any(np.isfinite(period.figure(name)) for name in each.lines.values())
        ]
        return replace(
            self,
            estimates=_joined(self.estimates, seen),
            charts=_joined(self.charts, charts),
            peers=_joined(self.peers, [name for name, found in period.peers().items() if found]),
            busy=self.busy or bool(np.isfinite(period.numbers("busy_ratio")).any()),
            values=tuple(values),
            texts=tuple(texts),
        )


def _joined(known: tuple[T, ...], seen: Iterable[T]) -> tuple[T, ...]:
    return tuple(dict.fromkeys([*known, *seen]))


def blueprint(vehicle: str, content: Content, tab: int = 0) -> rrb.Blueprint:
    """All tabs, following what comes in, open at number `tab`; `vehicle` is the one that is looked at closely.

    Views are laid out for the `content` of the run alone.
    """
    shown = [overview(content), radio(content), one_vehicle(vehicle, content)]
    if content.values or content.texts:
        shown.append(program(vehicle, content))
    tabs = rrb.Tabs(*shown, active_tab=tab)
    time = rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="following")
    return rrb.Blueprint(tabs, time, collapse_panels=True)


def overview(content: Content) -> rrb.Vertical:
    """The network: map, beliefs, figures, faults, events."""
    beliefs = [
        _around_truth(each.name, f"{each.title.capitalize()} − truth (m)", each) for each in content.estimates
    ]
    main: list[rrb.Spatial2DView | rrb.Vertical] = [
        rrb.Spatial2DView(origin="map", name="Map (east →, north ↑): vehicles and links of this period")
    ]
    below = [rrb.StateTimelineView(origin="faults", name="Faults acting, vehicles down"), _events()]
    if beliefs:
        main.append(rrb.Vertical(*beliefs))
    below[:0] = [_matrix(f"peers/{name}", f"{titled(name)} by vehicle (brighter: more)") for name in content.peers]
    return rrb.Vertical(
        rrb.Horizontal(
            rrb.TextDocumentView(origin="about", name="About", titlebar=False),
            rrb.Spatial2DView(
                origin="legend",
                name="Legend",
                titlebar=False,
                visual_bounds=rrb.VisualBounds2D(x_range=(-1.2, 26.6), y_range=(-0.6, 2.0)),
            ),
            column_shares=[4, 5],
        ),
        rrb.Horizontal(
            *main,
            rrb.Vertical(*_curves(content)),
            column_shares=[4, 2.4, 3.6] if beliefs else [4, 4],
        ),
        rrb.Horizontal(*below, column_shares=[*[2] * len(content.peers), 3, 4]),
        row_shares=[1.6, 7, 2.8],
        name="Overview",
    )


def _curves(content: Content) -> list[rrb.TimeSeriesView | rrb.Tabs]:
    """Figures against time, frames last."""
    curves: list[rrb.TimeSeriesView | rrb.Tabs] = []
    more = [_against_time(f"figures/{key}", title) for key, title in content.charts]
    if more:
        curves.append(more.pop(0))
    more += [_against_time("figures/position", "RMSE of position (m)")] if POSITION in content.estimates else []
    if not content.charts:
        more += [_against_time(entity("curve", name), titled(name)) for name in content.values]
    if more:
        curves.append(rrb.Tabs(*more))
    # The heading has the colours of the outcomes already.
    return [*curves, _against_time("radio/frames", "Frames a period by outcome, stacked", legend=False)]


def program(vehicle: str, content: Content) -> rrb.Vertical:
    """Values that programs report: each against time, and on a map."""
    each = [
        rrb.Horizontal(
            _against_time(entity("curve", name), f"{titled(name)}: mean, 5 to 95 %, {vehicle}"),
            rrb.Spatial2DView(
                origin=entity("map", name),
                contents=["$origin/**", "/map/lanes"],
                name=f"{titled(name)}: blue least, yellow most, grey not reported",
            ),
            column_shares=[3, 2],
            name=titled(name),
        )
        for name in content.values
    ]
    parts: list[rrb.Tabs | rrb.StateTimelineView] = [rrb.Tabs(*each)] if each else []
    if content.texts:
        parts.append(rrb.StateTimelineView(origin="program/texts", name=f"{vehicle} reports"))
    return rrb.Vertical(*parts, row_shares=[4, 1][: len(parts)], name="Program")


def radio(content: Content) -> rrb.Vertical:
    """Views of the outcomes of frames."""
    last = f"last {WINDOW_S:g} s"
    return rrb.Vertical(
        rrb.Horizontal(
            _against_time("radio/frames", "Frames a period by outcome, stacked"),
            _matrix("radio/links", f"Delivered by link, {last} (brighter: more; dark: none)"),
            column_shares=[3, 2],
        ),
        rrb.Horizontal(
            _bars("radio/distance", f"Delivered (%) by distance (m), {last}"),
            _bars("radio/latency", f"Deliveries by latency (ms), {last}"),
            _against_time("radio/age", "Age of information, time between receptions (ms)"),
        ),
        rrb.Horizontal(
            rrb.Tabs(*_loads(content)),
            rrb.Tabs(
                _bars("radio/heard", f"Delivered by receiver (%), {last}"),
                _bars("radio/ages", "Age by receiver (ms)"),
                _bars("radio/bytes", "Load by vehicle (kB/s)", legend=True),
            ),
        ),
        row_shares=[5, 4, 4],
        name="Radio",
    )


def _loads(content: Content) -> list[rrb.TimeSeriesView]:
    """Load, and how busy the medium is where vehicles share one."""
    busy = [_against_time("radio/busy", "Busy ratio of the medium (%)")] if content.busy else []
    return [_against_time("radio/load", "Load of a vehicle (kB/s)"), *busy]


def one_vehicle(vehicle: str, content: Content) -> rrb.Vertical:
    """One vehicle."""
    around = [rrb.Spatial2DView(origin="vehicle/hears", name=f"{vehicle} hears (around it, east →, north ↑)")]
    for each in content.estimates:
        name = f"{vehicle}: {each.title} − truth (m), 95 % ellipse"
        around.append(_around_truth(f"vehicle/{each.name}", name, each))
    curves = [_against_time("vehicle/frames", f"Frames to {vehicle} a period")]
    if content.estimates:
        curves.insert(0, _against_time("vehicle/errors", f"{vehicle}: distance from the truth (m)"))
    return rrb.Vertical(
        rrb.Horizontal(*around),
        rrb.Horizontal(
            rrb.Vertical(*curves),
            rrb.TextDocumentView(origin="vehicle/table", name=f"Whom {vehicle} hears"),
            column_shares=[2, 1],
        ),
        row_shares=[4, 4],
        name=f"Vehicle {vehicle}",
    )


def _around_truth(origin: str, name: str, of: Estimate) -> rrb.Spatial2DView:
    bounds = rrb.VisualBounds2D(x_range=(-of.view_m, of.view_m), y_range=(-of.view_m, of.view_m))
    return rrb.Spatial2DView(origin=origin, name=name, visual_bounds=bounds)


def _against_time(origin: str, name: str, legend: bool = True) -> rrb.TimeSeriesView:
    """Figures on one axis of time with all others; errors fall, so that the legend's corner is mostly free."""
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        plot_legend=rrb.PlotLegend("RightTop", visible=legend),
    )


def _bars(origin: str, name: str, legend: bool = False) -> rrb.BarChartView:
    return rrb.BarChartView(origin=origin, name=name, plot_legend=rrb.PlotLegend("LeftTop", visible=legend))


def _matrix(origin: str, name: str) -> rrb.TensorView:
    """A matrix that fills its view; small numbers are lifted, to be seen among zeros."""
    colours = rrb.TensorScalarMapping(colormap="viridis", mag_filter="nearest", gamma=0.6)
    return rrb.TensorView(origin=origin, name=name, scalar_mapping=colours, view_fit="fill")


def _events() -> rrb.TextLogView:
    columns = [
        rrb.encodings.TextLogColumn("LogLevel"),
        rrb.encodings.TextLogColumn("Body"),
    ]
    return rrb.TextLogView(origin="events", name="Events", columns=rrb.TextLogColumns(text_log_columns=columns))


class Recorder:
    """Writes into `sinks` as a context manager; `take` messages in order.

    `missed` counts the periods that never came. Raises VnetError if the file cannot be written, or nobody is called
    as the vehicle that `sinks` want to be looked at closely.
    """

    def __init__(self, sinks: Sinks, name: str) -> None:
        self._stack = ExitStack()
        self._recording = self._stack.enter_context(open_recording(sinks, name))
        self._canvas = Canvas(self._recording)
        self._sinks, self._vehicle = sinks, sinks.vehicle
        self._overview: OverviewScene | None = None
        self._parts: list[OverviewScene | RadioScene | VehicleScene] = []
        self._program: ProgramScene | None = None
        self._content = Content()
        self._views = NO_VIEWS
        self._node_ids: list[str] = []
        self._waiting: deque[PeriodArrays] = deque()
        self._last: int | None = None
        self.missed = 0

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.draw()
        finally:
            self._stack.close()

    def take(self, stream: str, message: Mapping[str, Any]) -> None:
        """Draw a message of `scene`, `period` or `end`; others, and periods before the first scene, are ignored."""
        if stream == "scene" and not self._parts:
            self._begin(message)
        elif stream == "period" and self._parts:
            self._waiting.append(PeriodArrays(message, self._node_ids))
            first_s = self._waiting[0].time_s
            if self._last is None or self._waiting[-1].time_s - first_s > DRAWN_TOGETHER_S:
                self.draw()
        elif stream == "end" and self._overview is not None:
            self.draw()
            self._overview.events(message.get("events", []))

    def _begin(self, scene: Mapping[str, Any]) -> None:
        self._node_ids = scene["node_ids"]
        vehicle = self._vehicle or self._node_ids[0]
        if vehicle not in self._node_ids:
            raise VnetError(f"no such vehicle: {vehicle}; there are {first_names(self._node_ids)}")
        self._views = views_of(scene.get("views", {}))
        self._overview = OverviewScene(self._canvas, scene, self._views)
        self._parts = [
            self._overview,
            RadioScene(self._canvas, scene),
            VehicleScene(self._canvas, scene, vehicle, self._views),
        ]
        self._vehicle = vehicle
        self._program = ProgramScene(self._canvas, scene, vehicle)
        self._recording.send_blueprint(blueprint(vehicle, self._content))
        written(self._recording, self._sinks)  # whatever happens now, it can be looked at

    def finish(self) -> None:
        """Draw what waits, and wait until all is written. Raises VnetError if it cannot be."""
        self.draw()
        written(self._recording, self._sinks)

    def draw(self) -> None:
        """Draw the periods that wait, which `take` does only once there are some."""
        while self._waiting:
            period = self._waiting.popleft()
            self._canvas.at(period.time_ns)
            if self._last is not None and period.number > self._last + 1:
                self._tell_gap(period.number - self._last - 1)
            self._last = period.number
            for part in self._parts:
                part.period(period)
            self._lay_out(period)
        self._canvas.send()

    def _lay_out(self, period: PeriodArrays) -> None:
        """Draw what programs report, and lay out views for what the run has shown for the first time."""
        assert self._program is not None and self._vehicle is not None
        self._program.period(period)
        content = self._content.after(period, self._views, self._program.names, self._program.texts)
        if content != self._content:
            self._content = content
            self._recording.send_blueprint(blueprint(self._vehicle, content))

    def _tell_gap(self, count: int) -> None:
        self.missed += count
        text = f"{count} periods before this one are missing: the recording could not keep up"
        self._canvas.log("events", rr.TextLog(text, level="ERROR"))
