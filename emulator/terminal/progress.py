"""Progress of a run, for its user: a live picture in a terminal, plain lines elsewhere, JSON for machines.

All of it goes to stderr, which a command has made tolerant: whatever becomes of it, the run goes on.

The picture is drawn from a `Snapshot` alone, for any width and height. Everything that has a course stands over one
axis, the duration of the run: how far it has come, the errors, the faults. What there is no room for is left out,
the least important first; no line is ever wider than the terminal, and the rows stay where they are for as long as
the terminal keeps its size. Nothing is told by colour alone.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import groupby, pairwise
from typing import Any, TextIO

from rich.console import Console, ConsoleOptions, RenderResult
from rich.style import Style
from rich.text import Text

from emulator.drivers.emulation import Emulation, PeriodView
from emulator.drivers.status import BINS, Course, FaultState, Snapshot
from emulator.pages.palette import PALETTE
from emulator.radio.outcomes import DRAWN
from emulator.records.events import GROUPED, Event, key_of, kinds_of
from emulator.terminal.console import LogFormat
from emulator.terminal.live import EVERY_S, LivePicture, terminal
from vnet.errors import first_names, printable
from vnet.units import unit_of

Words = tuple[str, Style]

GREEN, RED, ORANGE, SKY = (Style(color=PALETTE[name].either) for name in ("green", "red", "orange", "sky"))
PLAIN, BOLD, DIM = Style(), Style(bold=True), Style(dim=True)
BAD = RED + BOLD
OUTCOMES = {outcome.name: (Style(color=PALETTE[outcome.colour].either), outcome.sign) for outcome in DRAWN}
"""Style and sign of each outcome; signs tell them apart where there are no colours."""
HEIGHTS = "▁▂▃▄▅▆▇"  # and not the full block, which would run into the row above
SMALLEST_FACTOR = 4.0
"""Between the foot and the top of a sparkline, so that what is steady does not look wild."""
IDLE_S = 5.0
"""So long without a period that has ended is worth telling."""

MOST_FAULTS = MOST_EVENTS = 6
"""Rows at most."""
PATIENCE_S = 1.0
"""Emulated time after which a value that is not reported has no row."""


class Dashboard:
    """A run as a rich renderable; `later_s` is the age of the snapshot.

    `steady`: room is kept for events to come, so that nothing moves when they do.
    """

    def __init__(self, snapshot: Snapshot, later_s: float = 0.0, steady: bool = True) -> None:
        self._snapshot = snapshot
        self._later_s = later_s
        self._steady = steady

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        width, height = options.max_width, options.height or options.size.height
        draw = _Rows(self._snapshot, self._later_s, width, console.color_system is not None)
        for line in self._lines(draw, height - 1):  # the line below the picture is the cursor's
            line.truncate(width, overflow="crop")
            line.no_wrap = True
            yield line

    def _lines(self, draw: _Rows, height: int) -> list[Text]:
        """Return the rows, at most `height` of them: the most important first."""
        shot = self._snapshot
        if shot.phase == "starting":
            return [draw.title()]
        if shot.phase == "joining":
            return [draw.title(), draw.joined(), draw.vehicles(), draw.missing()][:height]
        groups = [[draw.title(), draw.time()], [draw.vehicles()], draw.figures(), [draw.frames(), draw.legend()]]
        room = max(0, height - sum(map(len, groups)))
        faults = min(len(shot.faults), room // 2)
        events = min(MOST_EVENTS, room - faults)
        faults = min(len(shot.faults), MOST_FAULTS, room - events)
        groups += [draw.faults(faults)] if faults else []
        groups += [draw.events(events, self._steady)] if events else []
        gap = [Text()] if sum(map(len, groups)) + len(groups) - 1 <= height else []
        return [line for group in groups for line in [*gap, *group]][len(gap) :][:height]


class _Rows:
    """The rows of the picture, by subject."""

    def __init__(self, shot: Snapshot, later_s: float, width: int, coloured: bool) -> None:
        self._shot = shot
        self._later_s = later_s
        self._width = width
        self._coloured = coloured
        self._label = 18 if width >= 90 else 13
        words = 34 if width >= 90 else 26
        self._axis = max(4, min(width - self._label - words - 2, BINS))

    def _row(self, label: str, axis: Text, *words: Words, label_style: Style = DIM) -> Text:
        """A row over the axis."""
        start = (_cut_middle(label, self._label - 1).ljust(self._label), label_style)
        return Text.assemble(start, axis, " " * (self._axis - axis.cell_len + 2), *words)

    def title(self) -> Text:
        """Line with the run's name, pacing and speed."""
        shot = self._shot
        about = [shot.pacing, f"seed {shot.seed}", f"{len(shot.node_ids)} vehicles"]
        if shot.emulator_memory_mb is not None:
            about.append(f"emulator {shot.emulator_memory_mb:.0f} MB")
        right = Text.assemble(*self._headline())
        while about and len(" · ".join(about)) > self._width - len(shot.run) - right.cell_len - 4:
            about.pop()
        left = Text.assemble((shot.run, BOLD), ("  " + " · ".join(about), DIM))
        return left.append(" " * max(self._width - left.cell_len - right.cell_len, 2)).append(right)

    def _headline(self) -> list[Words]:
        shot = self._shot
        idle_s = shot.idle_s + self._later_s
        if shot.phase == "judging":
            return [("judging the run", PLAIN)]
        if shot.phase != "running":
            return [(f"{shot.phase} …", PLAIN)]
        if idle_s >= IDLE_S:
            return [(f"no period for {_duration(idle_s)}", ORANGE + BOLD)]
        if shot.real_time_factor is None or shot.remaining_s is None:
            return []
        left = f"{_duration(shot.remaining_s)} left" if shot.remaining_s > 0 else "ending"
        return [(f"{shot.real_time_factor:.1f}× real time", BOLD), (f" · {left}", PLAIN)]

    def time(self) -> Text:
        """Progress bar of the emulated time."""
        shot = self._shot
        done = shot.emulated_s / shot.duration_s
        words = ((f"{shot.emulated_s:.1f}", BOLD), (f" of {shot.duration_s:g} s", PLAIN), (f"  {done:4.0%}", DIM))
        return self._row("time", self._bar(done), *words)

    def _bar(self, share: float) -> Text:
        done = min(int(share * self._axis), self._axis)
        return Text.assemble(("━" * done, SKY), ("─" * (self._axis - done), DIM))

    def joined(self) -> Text:
        """Line with the number of vehicles that have joined and the time left to join."""
        shot = self._shot
        count = len(shot.node_ids)
        joined = count - len(shot.missing)
        waited = f"  {shot.wall_s + self._later_s:.0f} s, at most {shot.join_timeout_s:g} s"
        return self._row("joined", self._bar(joined / count), (f"{joined} of {count}", BOLD), (waited, DIM))

    def missing(self) -> Text:
        """Line with the vehicles that have not joined."""
        return self._cut(Text.assemble(("missing".ljust(self._label), DIM), ", ".join(self._shot.missing)))

    def vehicles(self) -> Text:
        """A dot a vehicle, fainter for those that are not there, and the names of those who are down."""
        shot = self._shot
        away = shot.missing or shot.down
        strip = self._strip(shot.node_ids, set(away))
        if shot.phase == "joining":
            return self._row("vehicles", strip)
        words = [(f"{len(shot.node_ids) - len(away) - len(shot.absent)} up", BOLD)]
        words += [(f"  {len(shot.absent)} not there", DIM)] if shot.absent else []
        words += [(f"  {len(away)} down: ", BAD), (", ".join(away), RED)] if away else []
        return self._cut(self._row("vehicles", strip, *words))

    def _strip(self, node_ids: Sequence[str], away: set[str]) -> Text:
        """Dots for the vehicles; with more vehicles than room a dot stands for several, hollow if any is away."""
        dots = min(len(node_ids), self._axis)
        hollow = DIM if self._shot.phase == "joining" else RED
        absent = set(self._shot.absent)
        parts = (node_ids[n * len(node_ids) // dots : (n + 1) * len(node_ids) // dots] for n in range(dots))
        cells = (
            ("○", hollow) if away.intersection(part) else ("·", DIM) if absent.issuperset(part) else ("●", GREEN)
            for part in parts
        )
        return Text.assemble(*((sign * len([*same]), style) for (sign, style), same in groupby(cells)))

    def figures(self) -> list[Text]:
        """The figures that the program declares, and the RMSE of the positions beside that of the raw fixes."""
        shot = self._shot
        lines = [
            self._figure(label, name, about)
            for name, (label, about) in shot.lines.items()
            if shot.emulated_s < PATIENCE_S or not shot.never_reported(name)
        ]
        if shot.never_reported("position_rmse_m"):
            return [*lines, self._figure("raw fixes", "fix_rmse_m", "RMSE")]
        raw_m = shot.figures["fix_rmse_m"]
        raw = "" if raw_m is None else f"raw fixes {_short(raw_m)} m"
        return [*lines, self._figure("position", "position_rmse_m", raw)]

    def _figure(self, label: str, name: str, about: str) -> Text:
        value = self._shot.figures[name]
        line = Text(sparkline(self._shot.over_time[name], self._axis), SKY)
        shown = () if value is None else ((f"{_short(value):>5} {unit_of(name)}", BOLD), (f"  {about}", DIM))
        return self._row(label, line, *shown)

    def frames(self) -> Text:
        """Shares of the outcomes of the last second."""
        rates = _shown(self._shot.frames_per_s)
        total = sum(rates.values())
        bar = Text()
        for outcome, cells in zip(rates, _edges(list(rates.values()), self._axis), strict=True):
            style, sign = OUTCOMES[outcome]
            bar.append(("█" if self._coloured else sign) * cells, style)
        return self._row("frames", bar, (f"{total:,.0f}", BOLD), (" a second, in range", DIM))

    def legend(self) -> Text:
        """The legend of the bar above; without rates where there is no room for them."""
        rates = _shown(self._shot.frames_per_s)
        total = sum(rates.values())
        rated, short = Text(" " * (self._label - 2)), Text(" " * (self._label - 2))
        for outcome, rate in rates.items():
            style, sign = OUTCOMES[outcome]
            mark = ("■" if self._coloured else sign, style)
            words = Text.assemble("  ", mark, f" {outcome.replace('_', ' ')} ", (f"{rate / total:.1%}", BOLD))
            short.append(words)
            rated.append(words).append(f" {rate:,.0f}/s", DIM)
        return rated if rated.cell_len <= self._width else self._cut(short)

    def faults(self, rows: int) -> list[Text]:
        """Those that act, then the next, then the last that were; in the order in which they begin."""
        order = {"acting": 0, "to come": 1, "ended": 2}
        now_s = self._shot.emulated_s
        by_worth = sorted(
            self._shot.faults,
            key=lambda f: (order[f.state], f.start_s if f.state == "to come" else now_s - f.end_s),
        )
        shown = sorted(by_worth[:rows], key=lambda f: (f.start_s, f.fault))
        lines = [self._fault(fault) for fault in shown]
        if more := len(self._shot.faults) - len(shown):
            lines[-1].append(f"  +{more}", DIM)
        return lines

    def _fault(self, fault: FaultState) -> Text:
        scale = self._axis / self._shot.duration_s
        first = min(int(fault.start_s * scale), self._axis - 1)
        last = max(first + 1, min(math.ceil(fault.end_s * scale), self._axis))
        now_s = self._shot.emulated_s
        sign, style, words = {
            "acting": ("━", ORANGE + BOLD, f"acting, {fault.end_s - now_s:.1f} s more"),
            "to come": ("┄", DIM, f"in {fault.start_s - now_s:.1f} s"),
            "ended": ("─", DIM, "over"),
        }[fault.state]
        axis = Text.assemble(" " * first, (sign * (last - first), style))
        return self._row(fault.fault, axis, (words, style), label_style=style)

    def events(self, rows: int, steady: bool) -> list[Text]:
        """The last ones, the newest at the foot; if `steady`, all the rows, for those to come."""
        lines = [
            Text.assemble(
                (("" if number else "events").ljust(self._label), DIM),
                (f"{event.time_ns / 1e9:>6.1f} s  ", DIM),
                (printable(event.text, 300), BAD if event.is_bad else PLAIN),
            )
            for number, event in enumerate(self._shot.events[-rows:])
        ]
        lines = [self._cut(line) for line in lines] or [Text("events".ljust(self._label) + "none yet", DIM)]
        return lines + [Text()] * (rows - len(lines)) if steady else lines

    def _cut(self, line: Text) -> Text:
        """The line, whose end is an ellipsis where it is too long."""
        line.truncate(self._width, overflow="ellipsis")
        return line


def sparkline(values: Sequence[float | None], width: int) -> str:
    """Values over the parts of the run so far as blocks, their heights by logarithm, from least to greatest."""
    starts = [n * BINS // width for n in range(width + 1)]
    columns = [_mean(values[start : max(end, start + 1)]) for start, end in pairwise(starts)]
    known = [math.log(max(value, 1e-9)) for value in columns if value is not None and math.isfinite(value)]
    if not known:
        return ""
    slack = max(0.0, math.log(SMALLEST_FACTOR) - (max(known) - min(known))) / 2
    foot, top = min(known) - slack, max(known) + slack

    def block(value: float | None) -> str:
        if value is None:
            return " "
        height = 1.0 if not math.isfinite(value) else (math.log(max(value, 1e-9)) - foot) / (top - foot)
        return HEIGHTS[round(height * (len(HEIGHTS) - 1))]

    return "".join(map(block, columns)).rstrip()


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _shown(rates: Mapping[str, float]) -> dict[str, float]:
    """The outcomes of pairs in range, in their order."""
    return {outcome: rates[outcome] for outcome in OUTCOMES if rates.get(outcome)}


def _edges(values: Sequence[float], width: int) -> list[int]:
    """Cells for each value, `width` together."""
    total, so_far, ends = sum(values), 0.0, [0]
    for value in values:
        so_far += value
        ends.append(round(so_far / total * width))
    return [after - before for before, after in pairwise(ends)]


def _cut_middle(text: str, width: int) -> str:
    """Cut a long name, but not the number at its end."""
    return text if len(text) <= width else f"{text[: width - 4]}…{text[-3:]}"


def _short(value: float) -> str:
    """A figure to three digits or so, without an exponent where one can do without."""
    if not math.isfinite(value):
        return "∞"
    return f"{value:.2f}" if value < 100 else (f"{value:.0f}" if value < 1e5 else f"{value:.1e}")


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02} min"


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
        self._catch_up()
        if view.instant.period and self._is_time():  # the first period includes every program's own start
            self._progress(self._course.snapshot())

    def _catch_up(self) -> None:
        news = self._course.news(self._told_events)
        self._told_events = len(self._emulation.folder.events)
        self._tell_events(news)

    def close(self) -> None:
        """Tell what happened last."""
        if not self._closed:
            self._closed = True
            self._catch_up()

    def _progress(self, shot: Snapshot) -> None:
        """Print the run's progress."""

    def _tell_events(self, news: Sequence[Event]) -> None:
        """Print what has happened."""


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

    def _tell_events(self, news: Sequence[Event]) -> None:
        """A line for each event, and one for each kind of failure, however many vehicles it befalls."""
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

    def _tell_events(self, news: Sequence[Event]) -> None:
        for event in news:
            line = {"time_ns": event.time_ns, "kind": event.kind, "node": event.node, **event.details}
            self._say("event", event=line)
