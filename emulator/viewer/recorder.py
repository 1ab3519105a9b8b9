"""A Rerun recording of a run, from what the emulator tells observers.

Few batched entities: one for all vehicles, one for all links, one for all points. Periods are drawn several at
a time. `blueprints` says how it is laid out; lengths are in metres, times in emulated seconds, east is right and
north is up.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Any

import rerun as rr

from emulator.records.period_figures import NO_VIEWS, views_of
from emulator.viewer.blueprints import Content, blueprint
from emulator.viewer.drawing import Canvas, PeriodArrays
from emulator.viewer.overview_scene import OverviewScene
from emulator.viewer.radio_scene import RadioScene
from emulator.viewer.sinks import CLOSE_TIMEOUT_S, Sinks, open_recording
from emulator.viewer.vehicle_scene import ProgramScene, VehicleScene
from vnet.errors import VnetError, first_names

DRAWN_TOGETHER_S = 1.0
"""Periods are drawn some at a time: ten take hardly longer than three that come apart."""


class Recorder:
    """Writes into `sinks` as a context manager; `take` messages in order.

    `missed` counts the periods that never came. Raises VnetError if the file cannot be written, or nobody is called
    as the vehicle that `sinks` want to be looked at closely.
    """

    def __init__(self, sinks: Sinks, name: str) -> None:
        self._stack = ExitStack()
        self._recording = self._stack.enter_context(open_recording(sinks, name))
        self._canvas = Canvas(self._recording)
        self._vehicle = sinks.vehicle
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
        self._recording.send_blueprint(blueprint(vehicle, content=self._content))
        self._recording.flush(timeout_sec=CLOSE_TIMEOUT_S)  # whatever happens now, it can be looked at

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
            self._recording.send_blueprint(blueprint(self._vehicle, content=content))

    def _tell_gap(self, count: int) -> None:
        self.missed += count
        text = f"{count} periods before this one are missing: the recording could not keep up"
        self._canvas.log("events", rr.TextLog(text, level="ERROR"))
