"""A Rerun recording of a run, from what the emulator tells observers.

Few batched entities: one for all vehicles, one for all links, one for all particles. Views are in metres, east to
the right and north up (Rerun's 2-D views have y downwards, hence the minus signs).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import ArrayLike, NDArray

from emulator.channel.outcomes import Outcome
from emulator.observe.observation import unpack, unpack_pairs

# Okabe & Ito 2008: colours that the colour-blind can tell apart.
BLUE, ORANGE, GREEN, RED, GREY, BLACK = (
    (0, 114, 178),
    (230, 159, 0),
    (0, 158, 115),
    (213, 94, 0),
    (150, 150, 150),
    (90, 90, 90),
)
LANE_HALF_LENGTH_M = 250.0
COMMON_VIEW_M, ERRORS_VIEW_M = 2.5, 10.0
SERIES = {
    "error/rmse": ("common_error_rmse_m", "RMSE of the common error (m)", RED),
    "error/deviation": ("deviation_m", "deviation between vehicles (m)", BLUE),
    "error/bias": ("bias_m", "error of the network's mean (m)", GREEN),
    "position/estimate": ("position_rmse_m", "RMSE of position, estimate (m)", BLUE),
    "position/fix": ("fix_rmse_m", "RMSE of position, raw fix (m)", GREY),
}
OUTCOMES = {
    "delivered": GREEN,
    "lost": RED,
    "peer_cap": ORANGE,
    "queue_full": BLUE,
    "oversize": BLACK,
    "fault": (204, 121, 167),
    "receiver_down": GREY,
    "transport": (86, 180, 233),
}


class Recorder:
    """Writes `path` as a context manager; feed it `scene_message`s and `period_message`s in order."""

    def __init__(self, path: Path) -> None:
        self._recording = rr.RecordingStream("vnet", make_default=False, make_thread_default=False)
        self._recording.set_sinks(rr.FileSink(str(path)))
        self._recording.send_blueprint(_blueprint())
        self._scene: dict[str, Any] | None = None
        self._seen: set[str] = set()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._recording.flush(timeout_sec=10.0)
        self._recording.disconnect()

    def scene(self, message: dict[str, Any]) -> None:
        """What does not change; a repetition is ignored."""
        if self._scene is not None:
            return
        self._scene = message
        point = unpack(message["lane_point_m"], 2)
        heading = unpack(message["lane_heading_rad"])[:, 0]
        along = LANE_HALF_LENGTH_M * np.column_stack([np.cos(heading), np.sin(heading)])
        strips = np.stack([point - along, point + along], axis=1)
        lanes = rr.LineStrips2D(_flip(strips), colors=[GREY], radii=rr.Radius.ui_points(1.0))
        self._recording.log("map/lanes", lanes, static=True)
        for view, arm_m in (("common", COMMON_VIEW_M), ("errors", ERRORS_VIEW_M)):
            cross = rr.LineStrips2D(
                [[[-arm_m, 0], [arm_m, 0]], [[0, -arm_m], [0, arm_m]]], colors=[RED], radii=[0.005]
            )
            self._recording.log(f"{view}/truth", cross, static=True)
        for entity, (_, name, colour) in SERIES.items():
            self._recording.log(f"series/{entity}", rr.SeriesLines(names=name, colors=[colour]), static=True)
        for outcome, colour in OUTCOMES.items():
            style = rr.SeriesLines(names=outcome, colors=[colour])
            self._recording.log(f"series/frames/{outcome}", style, static=True)

    def period(self, message: dict[str, Any]) -> None:
        """One period."""
        if self._scene is None:
            return
        self._recording.set_time("emulated time", duration=message["time_ns"] / 1e9)
        self._vehicles(message, self._scene["node_ids"])
        self._common_error(message)
        self._series(message)

    def _vehicles(self, message: dict[str, Any], node_ids: list[str]) -> None:
        position = unpack(message["position_m"], 2)
        self._points("map/vehicles", position, BLUE, 4.0, labels=node_ids)
        pairs = unpack_pairs(message)
        links = pairs[pairs[:, 2] == Outcome.delivered, :2]
        links = np.unique(np.sort(links, axis=1), axis=0)
        strips = rr.LineStrips2D(
            _flip(position[links]), colors=[(*GREEN, 90)], radii=rr.Radius.ui_points(0.5), draw_order=-1.0
        )
        self._recording.log("map/links", strips)
        self._points("errors/fix", unpack(message["fix_m"], 2) - position, GREY, 3.0)
        self._points("errors/estimate", unpack(message["estimate_m"], 2) - position, BLUE, 3.0)

    def _common_error(self, message: dict[str, Any]) -> None:
        truth = unpack(message["common_error_m"], 2)
        if message["clouds"]:
            clouds = np.concatenate([unpack(cloud, 2) for cloud in message["clouds"].values()])
            self._points("common/particles", clouds - truth, GREY, 1.0)
        self._points("common/estimates", unpack(message["common_error_estimate_m"], 2) - truth, BLUE, 4.0)

    def _series(self, message: dict[str, Any]) -> None:
        for entity, (figure, _, _) in SERIES.items():
            value = message["figures"][figure]
            if value is not None:
                self._recording.log(f"series/{entity}", rr.Scalars(value))
        for outcome in OUTCOMES:
            count = message["outcomes"].get(outcome, 0)
            if count or outcome in self._seen:  # nothing of the kind so far: no line
                self._seen.add(outcome)
                self._recording.log(f"series/frames/{outcome}", rr.Scalars(count))

    def _points(
        self,
        entity: str,
        position: NDArray[np.float32],
        colour: tuple[int, int, int],
        radius: float,
        labels: list[str] | None = None,
    ) -> None:
        known = np.asarray(np.isfinite(position).all(axis=1))
        shown = labels if labels is None else [label for label, here in zip(labels, known, strict=True) if here]
        points = rr.Points2D(
            _flip(position[known]),
            colors=[colour],
            radii=rr.Radius.ui_points(radius),
            labels=shown,
            show_labels=False if labels is not None and len(labels) > 1 else None,
        )
        self._recording.log(entity, points)


def record(messages: Iterable[tuple[str, dict[str, Any]]], path: Path) -> None:
    """Write a recording from (stream, message) pairs."""
    with Recorder(path) as recorder:
        for stream, message in messages:
            if stream == "scene":
                recorder.scene(message)
            elif stream == "period":
                recorder.period(message)


def _flip(position: ArrayLike) -> NDArray[np.float32]:
    """East, north to Rerun's x right, y down."""
    return np.asarray(position, dtype=np.float32) * np.array([1, -1], dtype=np.float32)


def _blueprint() -> rrb.Blueprint:
    def around_truth(half_m: float) -> rrb.VisualBounds2D:
        return rrb.VisualBounds2D(x_range=[-half_m, half_m], y_range=[-half_m, half_m])

    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial2DView(origin="map", name="Vehicles, and links of the last period (m; east →, north ↑)"),
            rrb.Vertical(
                rrb.Spatial2DView(
                    origin="common",
                    name="Common error − truth: estimates, particles (m)",
                    visual_bounds=around_truth(COMMON_VIEW_M),
                ),
                rrb.Spatial2DView(
                    origin="errors",
                    name="Position − truth: raw fixes grey, estimates blue (m)",
                    visual_bounds=around_truth(ERRORS_VIEW_M),
                ),
            ),
            rrb.Vertical(
                rrb.TimeSeriesView(origin="series/error", name="Common error: RMSE, deviation, bias (m)"),
                rrb.TimeSeriesView(origin="series/position", name="RMSE of position (m)"),
                rrb.TimeSeriesView(origin="series/frames", name="Frames a period by outcome"),
            ),
            column_shares=[3, 2, 3],
        ),
        collapse_panels=True,
    )
