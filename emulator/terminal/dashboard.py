"""The picture of a run in a terminal, drawn from a `Snapshot` alone, for any width and height.

Everything that has a course stands over one axis, the duration of the run: how far it has come, the errors, the
faults. What there is no room for is left out, the least important first; no line is ever wider than the terminal,
and the rows stay where they are for as long as the terminal keeps its size. Nothing is told by colour alone.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.segment import Segment
from rich.style import Style

from emulator.drivers.status import BINS, FaultState, Snapshot
from emulator.pages.palette import PALETTE
from emulator.radio.outcomes import DRAWN
from vnet.errors import printable

Line = list[Segment]

GREEN, RED, ORANGE, SKY = (Style(color=PALETTE[name].either) for name in ("green", "red", "orange", "sky"))
PLAIN, BOLD, DIM = Style(), Style(bold=True), Style(dim=True)
BAD = RED + BOLD
OUTCOMES = {
    outcome.name: (Style(color=PALETTE[outcome.facts.colour].either), outcome.facts.sign) for outcome in DRAWN
}
"""Style and sign of each outcome; signs tell them apart where there are no colours."""
HEIGHTS = "▁▂▃▄▅▆▇"  # and not the full block, which would run into the row above
SMALLEST_FACTOR = 4.0
"""Between the foot and the top of a sparkline, so that what is steady does not look wild."""
IDLE_S = 5.0
"""So long without a period that has ended is worth telling."""

# The rows in the order in which they are worth having.
ROWS = ["title", "time", "vehicles", "declared", "frames", "events", "faults", "declared", "shares", "position"]
MORE_ROWS = ["events", "faults"] * 5
GROUPS = (
    ("title", "time"),
    ("vehicles",),
    ("declared", "position"),
    ("frames", "shares"),
    ("faults",),
    ("events",),
)
PATIENCE_S = 1.0
"""Emulated time after which a value that is not reported has no row."""
EARLY_ROWS = {"starting": ["title"], "joining": ["title", "joined", "vehicles", "missing"]}


class Dashboard:
    """A run as a rich renderable; `later_s` is the age of the snapshot.

    `steady`: room is kept for events to come, so that nothing moves when they do.
    """

    def __init__(self, snapshot: Snapshot, later_s: float = 0.0, steady: bool = True) -> None:
        self._snapshot = snapshot
        self._later_s = later_s
        self._steady = steady

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        # The line below the picture is the cursor's.
        height = (options.height or options.size.height) - 1
        for number, line in enumerate(self.lines(options.max_width, height, console.color_system is not None)):
            if number:
                yield Segment.line()
            yield from Segment.adjust_line_length(line, options.max_width, pad=False)
        yield Segment.line()

    def lines(self, width: int, height: int, coloured: bool = True) -> list[Line]:
        """The rows, at most `height` of them; the caller cuts what is wider than `width`."""
        shot = self._snapshot
        draw = _Rows(shot, self._later_s, width, coloured)
        if shot.phase in EARLY_ROWS:
            return [line for row in EARLY_ROWS[shot.phase][:height] for line in getattr(draw, row)(1)]
        count = self._allot(height)
        groups = [[row for row in group if count[row]] for group in GROUPS]
        groups = [group for group in groups if group]
        gap: list[Line] = [[]] if count.total() + len(groups) - 1 <= height else []
        found: list[Line] = []
        for number, group in enumerate(groups):
            found += gap if number else []
            for row in group:
                found += getattr(draw, row)(count[row])
        spare = height - len(found) if self._steady else 0
        return found + [[]] * min(spare, count["events"] - max(1, len(shot.events)))

    def _allot(self, height: int) -> Counter[str]:
        """Rows given to each part."""
        shot = self._snapshot
        most = {**dict.fromkeys(ROWS, height), "faults": len(shot.faults), "declared": len(_declared(shot))}
        count: Counter[str] = Counter()
        for row in ROWS + MORE_ROWS:
            if count[row] < most[row] and count.total() < height:
                count[row] += 1
        return count


def _declared(shot: Snapshot) -> list[tuple[str, tuple[str, str]]]:
    """The figures that the program declares to have a line, but for those that nobody reports."""
    return [each for each in shot.lines.items() if shot.emulated_s < PATIENCE_S or not shot.never_reported(each[0])]


class _Rows:
    """The rows of the picture: each method draws one, or as many as it is given."""

    def __init__(self, shot: Snapshot, later_s: float, width: int, coloured: bool) -> None:
        self._shot = shot
        self._later_s = later_s
        self._width = width
        self._coloured = coloured
        self._label = 18 if width >= 90 else 13
        words = 34 if width >= 90 else 26
        self._axis = max(4, min(width - self._label - words - 2, BINS))

    def _row(self, label: str, axis: Line, words: Sequence[Segment], label_style: Style = DIM) -> Line:
        """A row over the axis."""
        filled = sum(segment.cell_length for segment in axis)
        start = Segment(_cut_middle(label, self._label - 1).ljust(self._label), label_style)
        return [start, *axis, Segment(" " * (self._axis - filled + 2)), *words]

    def title(self, rows: int) -> list[Line]:
        """Line with the run's name, pacing and speed."""
        shot = self._shot
        about = [shot.pacing, f"seed {shot.seed}", f"{len(shot.node_ids)} vehicles"]
        if shot.emulator_memory_mb is not None:
            about.append(f"emulator {shot.emulator_memory_mb:.0f} MB")
        right = self._headline()
        room = self._width - len(shot.run) - 2 - sum(cell_len(segment.text) for segment in right) - 2
        while about and len(" · ".join(about)) > room:
            about.pop()
        left = [Segment(shot.run, BOLD), Segment("  " + " · ".join(about), DIM)]
        gap = self._width - sum(cell_len(segment.text) for segment in [*left, *right])
        return [[*left, Segment(" " * max(gap, 2)), *right]]

    def _headline(self) -> Line:
        shot = self._shot
        idle_s = shot.idle_s + self._later_s
        if shot.phase == "judging":
            return [Segment("judging the run")]
        if shot.phase != "running":
            return [Segment(f"{shot.phase} …")]
        if idle_s >= IDLE_S:
            return [Segment(f"no period for {_duration(idle_s)}", ORANGE + BOLD)]
        if shot.real_time_factor is None or shot.remaining_s is None:
            return []
        left = f"{_duration(shot.remaining_s)} left" if shot.remaining_s > 0 else "ending"
        return [Segment(f"{shot.real_time_factor:.1f}× real time", BOLD), Segment(f" · {left}")]

    def time(self, rows: int) -> list[Line]:
        """Progress bar of the emulated time."""
        shot = self._shot
        done = shot.emulated_s / shot.duration_s
        words = [Segment(f"{shot.emulated_s:.1f}", BOLD), Segment(f" of {shot.duration_s:g} s")]
        return [self._row("time", self._bar(done), [*words, Segment(f"  {done:4.0%}", DIM)])]

    def _bar(self, share: float) -> Line:
        done = min(int(share * self._axis), self._axis)
        return [Segment("━" * done, SKY), Segment("─" * (self._axis - done), DIM)]

    def joined(self, rows: int) -> list[Line]:
        """Line with the number of vehicles that have joined and the time left to join."""
        shot = self._shot
        count = len(shot.node_ids)
        joined = count - len(shot.missing)
        words = [Segment(f"{joined} of {count}", BOLD)]
        waited_s = shot.wall_s + self._later_s
        words.append(Segment(f"  {waited_s:.0f} s, at most {shot.join_timeout_s:g} s", DIM))
        return [self._row("joined", self._bar(joined / count), words)]

    def missing(self, rows: int) -> list[Line]:
        """Line with the vehicles that have not joined."""
        named = _names(self._shot.missing, self._width - self._label)
        return [[Segment("missing".ljust(self._label), DIM), Segment(named)]]

    def vehicles(self, rows: int) -> list[Line]:
        """A dot a vehicle, fainter for those that are not there, and the names of those who are down."""
        shot = self._shot
        away = shot.missing or shot.down
        strip = self._strip(shot.node_ids, set(away))
        if shot.phase == "joining":
            return [self._row("vehicles", strip, [])]
        words = [Segment(f"{len(shot.node_ids) - len(away) - len(shot.absent)} up", BOLD)]
        if shot.absent:
            words.append(Segment(f"  {len(shot.absent)} not there", DIM))
        if away:
            words.append(Segment(f"  {len(away)} down: ", BAD))
            room = self._width - self._label - self._axis - 2 - sum(segment.cell_length for segment in words)
            words.append(Segment(_names(away, room), RED))
        return [self._row("vehicles", strip, words)]

    def _strip(self, node_ids: Sequence[str], away: set[str]) -> Line:
        """Dots for the vehicles; with more vehicles than room a dot stands for several, hollow if any is away."""
        dots = min(len(node_ids), self._axis)
        hollow = DIM if self._shot.phase == "joining" else RED
        absent = set(self._shot.absent)
        parts = (node_ids[n * len(node_ids) // dots : (n + 1) * len(node_ids) // dots] for n in range(dots))
        return _joined(
            ("○", hollow)
            if any(node in away for node in part)
            else ("·", DIM)
            if all(node in absent for node in part)
            else ("●", GREEN)
            for part in parts
        )

    def declared(self, rows: int) -> list[Line]:
        """Lines of the figures that the program declares."""
        return [self._figure(label, name, about) for name, (label, about) in _declared(self._shot)[:rows]]

    def position(self, rows: int) -> list[Line]:
        """RMSE of the positions, beside that of the raw fixes; or that alone."""
        if self._shot.never_reported("position_rmse_m"):
            return [self._figure("raw fixes", "fix_rmse_m", "RMSE")]
        raw_m = self._shot.figures["fix_rmse_m"]
        raw = "" if raw_m is None else f"raw fixes {_short(raw_m)} m"
        return [self._figure("position", "position_rmse_m", raw)]

    def _figure(self, label: str, name: str, about: str) -> Line:
        value = self._shot.figures[name]
        line = sparkline(self._shot.over_time[name], self._axis)
        shown = () if value is None else (Segment(f"{_short(value):>5} m", BOLD), Segment(f"  {about}", DIM))
        return self._row(label, [Segment(line, SKY)], shown)

    def frames(self, rows: int) -> list[Line]:
        """Shares of the outcomes of the last second."""
        rates = _shown(self._shot.frames_per_s)
        total = sum(rates.values())
        bar: Line = []
        if total:
            edges = _edges(list(rates.values()), self._axis)
            for outcome, cells in zip(rates, edges, strict=True):
                style, sign = OUTCOMES[outcome]
                bar.append(Segment(("█" if self._coloured else sign) * cells, style))
        words = [Segment(f"{total:,.0f}", BOLD), Segment(" a second, in range", DIM)]
        return [self._row("frames", bar, words)]

    def shares(self, rows: int) -> list[Line]:
        """The legend of the bar above; where there is no room, first without rates, then without the least."""
        rates = _shown(self._shot.frames_per_s)
        named = list(rates)
        line = self._legend(rates, named, rated=True)
        while sum(segment.cell_length for segment in line) > self._width:
            line = self._legend(rates, named, rated=False)
            if not named:
                break
            named.remove(min(named, key=rates.__getitem__))
        return [line]

    def _legend(self, rates: Mapping[str, float], named: Sequence[str], rated: bool) -> Line:
        total = sum(rates.values())
        line: Line = [Segment(" " * (self._label - 2))]
        for outcome in named:
            style, sign = OUTCOMES[outcome]
            mark = Segment("■" if self._coloured else sign, style)
            number = Segment(f" {rates[outcome]:,.0f}/s" if rated else "", DIM)
            name, share = Segment(f" {outcome.replace('_', ' ')} "), Segment(f"{rates[outcome] / total:.1%}", BOLD)
            line += [Segment("  "), mark, name, share, number]
        return line if len(named) == len(rates) else [*line, Segment("  …", DIM)]

    def faults(self, rows: int) -> list[Line]:
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
            lines[-1].append(Segment(f"  +{more}", DIM))
        return lines

    def _fault(self, fault: FaultState) -> Line:
        scale = self._axis / self._shot.duration_s
        first = min(int(fault.start_s * scale), self._axis - 1)
        last = max(first + 1, min(math.ceil(fault.end_s * scale), self._axis))
        now_s = self._shot.emulated_s
        sign, style, words = {
            "acting": ("━", ORANGE + BOLD, f"acting, {fault.end_s - now_s:.1f} s more"),
            "to come": ("┄", DIM, f"in {fault.start_s - now_s:.1f} s"),
            "ended": ("─", DIM, "over"),
        }[fault.state]
        axis = [Segment(" " * first), Segment(sign * (last - first), style)]
        return self._row(fault.fault, axis, [Segment(words, style)], style)

    def events(self, rows: int) -> list[Line]:
        """The last ones, the newest at the foot."""
        lines: list[Line] = []
        for event in self._shot.events[-rows:]:
            label = "" if lines else "events"
            when = f"{event.time_ns / 1e9:>6.1f} s  "
            about = _cut(printable(event.text, 300), max(1, self._width - self._label - len(when)))
            style = BAD if event.is_bad else PLAIN
            lines.append([Segment(label.ljust(self._label), DIM), Segment(when, DIM), Segment(about, style)])
        if not lines:
            lines.append([Segment("events".ljust(self._label), DIM), Segment("none yet", DIM)])
        return lines


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


def _joined(cells: Iterator[tuple[str, Style]]) -> Line:
    """Cells of one character, neighbours of one style as one segment."""
    line: Line = []
    for text, style in cells:
        if line and line[-1].style is style:
            line[-1] = Segment(line[-1].text + text, style)
        else:
            line.append(Segment(text, style))
    return line


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


def _names(names: Sequence[str], room: int) -> str:
    """As many names as fit, and how many there are if they do not."""
    text = ", ".join(names)
    if len(text) <= room:
        return text
    shown = 0
    ending = f", … ({len(names)})"
    while shown < len(names) and len(", ".join(names[: shown + 1])) + len(ending) <= room:
        shown += 1
    return ", ".join(names[:shown]) + ending if shown else "…"


def _cut(text: str, width: int) -> str:
    return text if cell_len(text) <= width else text[: max(width - 1, 0)] + "…"


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
