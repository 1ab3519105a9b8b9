"""Layout of a recording: an overview, the radio, and one vehicle, as tabs."""

from __future__ import annotations

import rerun.blueprint as rrb

from emulator.viewer.drawing import TIMELINE
from emulator.viewer.radio_scene import WINDOW_S

COMMON_VIEW_M, POSITION_VIEW_M = 1.15, 5.6


def blueprint(vehicle: str, tab: int = 0) -> rrb.Blueprint:
    """All tabs, following what comes in, open at number `tab`; `vehicle` is the one that is looked at closely."""
    tabs = rrb.Tabs(overview(), radio(), one_vehicle(vehicle), active_tab=tab)
    time = rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="following")
    return rrb.Blueprint(tabs, time, collapse_panels=True)


def overview() -> rrb.Vertical:
    """The network: map, beliefs, figures, faults, events."""
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
            rrb.Spatial2DView(origin="map", name="Map (east →, north ↑): vehicles and links of this period"),
            rrb.Vertical(
                _around_truth("common", "Common error − truth (m), with 95 % ellipses", COMMON_VIEW_M),
                _around_truth("position", "Position − truth (m)", POSITION_VIEW_M),
            ),
            rrb.Vertical(
                _against_time("figures/common", "Common error (m)"),
                rrb.Tabs(
                    _against_time("figures/consensus", "Consensus (m)"),
                    _against_time("figures/position", "RMSE of position (m)"),
                ),
                _against_time("radio/frames", "Frames a period by outcome, stacked"),
                row_shares=[4, 2, 3],
            ),
            column_shares=[4, 2.4, 3.6],
        ),
        rrb.Horizontal(
            _matrix("weights", "Weights of the fusion (brighter: more)"),
            rrb.StateTimelineView(origin="faults", name="Faults acting, vehicles down"),
            _events(),
            column_shares=[2, 3, 4],
        ),
        row_shares=[1.4, 7, 2.8],
        name="Overview",
    )


def radio() -> rrb.Vertical:
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
            rrb.Tabs(
                _against_time("radio/load", "Load of a vehicle (kB/s)"),
                _against_time("radio/busy", "Busy ratio of the medium (%)"),
            ),
            rrb.Tabs(
                _bars("radio/heard", f"Delivered by receiver (%), {last}"),
                _bars("radio/ages", "Age by receiver (ms)"),
                _bars("radio/bytes", "Load by vehicle (kB/s)", legend=True),
            ),
        ),
        row_shares=[5, 4, 4],
        name="Radio",
    )


def one_vehicle(vehicle: str) -> rrb.Vertical:
    """One vehicle."""
    return rrb.Vertical(
        rrb.Horizontal(
            rrb.Spatial2DView(origin="vehicle/hears", name=f"{vehicle} hears (around it, east →, north ↑)"),
            _around_truth("vehicle/position", f"{vehicle}: position − truth (m), 95 % ellipse", POSITION_VIEW_M),
            _around_truth("vehicle/common", f"{vehicle}: common error − truth (m), 95 % ellipse", COMMON_VIEW_M),
        ),
        rrb.Horizontal(
            rrb.Vertical(
                _against_time("vehicle/errors", f"{vehicle}: distance from the truth (m)"),
                _against_time("vehicle/frames", f"Frames to {vehicle} a period"),
            ),
            rrb.TextDocumentView(origin="vehicle/table", name=f"Whom {vehicle} hears and weighs"),
            column_shares=[2, 1],
        ),
        row_shares=[4, 4],
        name=f"Vehicle {vehicle}",
    )


def _around_truth(origin: str, name: str, half_m: float) -> rrb.Spatial2DView:
    bounds = rrb.VisualBounds2D(x_range=(-half_m, half_m), y_range=(-half_m, half_m))
    return rrb.Spatial2DView(origin=origin, name=name, visual_bounds=bounds)


def _against_time(origin: str, name: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=rrb.PlotLegend("LeftTop"))


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
