"""Progress of a run, for its user: a live picture in a terminal, plain lines elsewhere, JSON for machines.

All of it goes to stderr, which a command has made tolerant: whatever becomes of it, the run goes on.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, TextIO

from rich.console import Console

from emulator.drivers.emulation import Emulation, PeriodView
from emulator.drivers.status import Course, Snapshot
from emulator.records.events import GROUPED, Event, key_of, kinds_of
from emulator.terminal.console import LogFormat
from emulator.terminal.dashboard import Dashboard
from emulator.terminal.live import EVERY_S, LivePicture, terminal
from vnet.errors import first_names, printable

PLAIN_LINE_EVERY_S = 5.0
JSON_LINE_EVERY_S = 1.0
LONGEST_LINE = 300
"""Characters of a line about a failure."""


class Progress:
    """Shows nothing: what the others have in common. A context manager around the run; `close` ends it early."""

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Show nothing more. Harmless if done twice."""

    def state(self, text: str) -> None:
        """Say what is going on before the first period."""

    def awaits(self, nodes: Sequence[str]) -> None:
        """These vehicles have not joined yet; none: all have."""

    def judging(self) -> None:
        """The run is over, and is being written down and judged."""

    def ended(self, verdict: dict[str, Any], folder: str, exit_status: int) -> None:
        """The run has been judged: the contents of its verdict.json, and with what status the command ends."""


def show_progress(emulation: Emulation, log_format: LogFormat, quiet: bool, picture: bool = True) -> Progress:
    """Return the display of this run's progress on stderr; without `picture` lines in a terminal, too."""
    if quiet:
        return Progress()
    if log_format is LogFormat.JSON:
        return JsonLines(emulation, sys.stderr)
    console = terminal(sys.stderr) if picture else None
    return PlainLines(emulation, sys.stderr) if console is None else Picture(emulation, console)


class Picture(Progress):
    """The live picture of a terminal."""

    def __init__(self, emulation: Emulation, console: Console) -> None:
        self._course = Course(emulation)
        self._shot = self._course.snapshot()
        self._taken_s = time.monotonic()
        self._live = LivePicture(console, self._picture)
        emulation.watch(self._look)

    def _picture(self) -> Dashboard:
        return Dashboard(self._shot, time.monotonic() - self._taken_s)

    def _look(self, view: PeriodView | None = None) -> None:
        """Have the figures of now drawn; as often as anybody could see."""
        now_s = time.monotonic()
        if view is None or now_s - self._taken_s >= EVERY_S:
            self._shot, self._taken_s = self._course.snapshot(), now_s

    def __enter__(self) -> Picture:
        self._live.start()
        return self

    def close(self) -> None:
        """Leave the terminal as it was."""
        self._live.stop()

    def state(self, text: str) -> None:
        """Leave it above the picture: one may want to copy it."""
        self._live.print_above(text + "\n")

    def awaits(self, nodes: Sequence[str]) -> None:
        """Draw who is missing."""
        self._course.awaits(nodes)
        self._look()

    def judging(self) -> None:
        """Draw that."""
        self._course.judging()
        self._look()


class _Lines(Progress):
    """Lines, as things happen and now and then."""

    every_s: float

    def __init__(self, emulation: Emulation, file: TextIO) -> None:
        self._course = Course(emulation)
        self._file = file
        self._told_events = 0
        self._last_s = 0.0
        self._closed = False
        self._emulation = emulation
        emulation.watch(self._period)

    def _write(self, line: str) -> None:
        self._file.write(line + "\n")  # a tolerant stream, which drops it if nobody reads
        self._file.flush()

    def _is_time(self) -> bool:
        now_s = time.monotonic()
        if now_s - self._last_s < self.every_s:
            return False
        self._last_s = now_s
        return True

    def _period(self, view: PeriodView) -> None:
        self._tell_events()
        if view.instant.period and self._is_time():  # the first period includes every program's own start
            self._progress(self._course.snapshot())

    def _tell_events(self) -> None:
        for event in self._course.news(self._told_events):
            self._event(event)
        self._told_events = len(self._emulation.folder.events)

    def close(self) -> None:
        """Tell what happened last."""
        if not self._closed:
            self._closed = True
            self._tell_events()

    def _progress(self, shot: Snapshot) -> None:
        """Print the run's progress."""

    def _event(self, event: Event) -> None:
        """Print an event."""


class PlainLines(_Lines):
    """For logs: a line every few seconds, and one at once for what goes wrong."""

    every_s = PLAIN_LINE_EVERY_S

    def __init__(self, emulation: Emulation, file: TextIO) -> None:
        super().__init__(emulation, file)
        self._told_kinds: set[tuple[str, ...]] = set()

    def state(self, text: str) -> None:
        """A line."""
        self._last_s = time.monotonic()
        self._write(text)

    def awaits(self, nodes: Sequence[str]) -> None:
        """A line now and then."""
        self._course.awaits(nodes)
        if nodes and self._is_time():
            total = len(self._emulation.world.node_ids)
            self._write(f"{total - len(nodes)} of {total} vehicles have joined; missing: {first_names(nodes)}")
        if not nodes:
            self._last_s = 0.0

    def _progress(self, shot: Snapshot) -> None:
        delivered = shot.frames_by_outcome.get("delivered", 0)
        known = ((*words, shot.figures[name]) for name, words in shot.lines.items())
        first = next((f"{label} {value:.2f} m  " for label, _, value in known if value is not None), "")
        lost = sum(shot.frames_by_outcome.values()) - delivered
        lost -= sum(shot.frames_by_outcome.get(name, 0) for name in ("out_of_range", "pending"))
        factor = f"{shot.real_time_factor or 0:4.1f}× real time"
        down = f"  down {', '.join(shot.down)}" if shot.down else ""
        receptions = f"delivered {delivered:,} of {delivered + lost:,}"
        self._write(f"{shot.emulated_s:6.1f} s  {factor}  {first}{receptions}{down}")

    def _tell_events(self) -> None:
        """A line for each event, and one for each kind of failure, however many vehicles it befalls."""
        news = self._course.news(self._told_events)
        self._told_events = len(self._emulation.folder.events)
        for kind in kinds_of(event for event in news if event.has(GROUPED)):
            if (key := key_of(kind.first)) not in self._told_kinds:
                self._told_kinds.add(key)
                self._write(f"{kind.first.time_ns / 1e9:6.1f} s  {printable(kind.untimed, LONGEST_LINE)}")
        for event in news:
            if event.is_bad and not event.has(GROUPED):
                self._write(f"{event.time_ns / 1e9:6.1f} s  {printable(event.text, LONGEST_LINE)}")


class JsonLines(_Lines):
    """One JSON object a line; docs/viewing.md says what is in them."""

    every_s = JSON_LINE_EVERY_S
    _phase_told = ""

    def _say(self, kind: str, **fields: Any) -> None:
        self._write(json.dumps({"kind": kind, "wall_s": round(self._course.wall_s, 3), **fields}))

    def _state(self, **text: str) -> None:
        shot = self._course.snapshot()
        self._phase_told = shot.phase
        self._say("state", phase=shot.phase, vehicles=len(shot.node_ids), missing=shot.missing, **text)

    def _period(self, view: PeriodView) -> None:
        if self._phase_told != "running":
            self._state()
        super()._period(view)

    def __enter__(self) -> JsonLines:
        self._state()
        return self

    def state(self, text: str) -> None:
        """An object with a text."""
        self._state(text=text)

    def awaits(self, nodes: Sequence[str]) -> None:
        """An object when joining begins, when it is over, and now and then."""
        began = self._course.snapshot().phase
        self._course.awaits(nodes)
        if not nodes or began == "starting" or self._is_time():
            self._state()

    def judging(self) -> None:
        """The last figures, and an object."""
        self._progress(self._course.snapshot())
        self._course.judging()
        self._state()

    def ended(self, verdict: dict[str, Any], folder: str, exit_status: int) -> None:
        """The last object."""
        self.close()
        told = {key: verdict[key] for key in ("verdict", "emulated_s", "real_time_factor", "seed")}
        self._say("ended", exit_status=exit_status, folder=folder, **told)

    def _progress(self, shot: Snapshot) -> None:
        acting = [fault.fault for fault in shot.faults if fault.state == "acting"]
        left_out = {"node_ids", "phase", "missing", "over_time", "faults", "events", "figures", "lines"}
        left_out |= {"join_timeout_s", "idle_s", "wall_s"}
        fields = {key: value for key, value in asdict(shot).items() if key not in left_out} | shot.figures
        self._say("progress", **fields, vehicles=len(shot.node_ids), faults_acting=acting)

    def _event(self, event: Event) -> None:
        line = {"time_ns": event.time_ns, "kind": event.kind, "node": event.node, **event.details}
        self._say("event", event=line)
