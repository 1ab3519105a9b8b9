"""A picture kept at the foot of a terminal, redrawn a few times a second by a thread of its own.

What is printed meanwhile passes above it. rich's `Live` does much the same, but redraws at every printed line,
leaves half the old picture behind when the window is made narrower, and ends the program when the terminal goes
away. Here only the lines that have changed are written, each redraw in one piece, and a terminal that blocks
or goes away never holds up those who print.
"""

from __future__ import annotations

import re
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from itertools import zip_longest
from typing import Any, TextIO, cast

from rich.cells import cell_len
from rich.color import ColorSystem
from rich.console import COLOR_SYSTEMS, Console, RenderableType
from rich.segment import Segment

EVERY_S = 0.25
MOST_WAITING = 1 << 20
"""Characters that wait for the next redraw; who prints more waits for the terminal, as one always does."""
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_BEGIN, _END = "\x1b[?2026h", "\x1b[?2026l"  # show it when all is there; terminals that cannot pass it over
_ERASE_LINE, _ERASE_BELOW = "\x1b[K", "\x1b[J"


class Painter:
    """Draws what `picture` returns, on a console that is a terminal, as a context manager."""

    def __init__(self, console: Console, picture: Callable[[], RenderableType]) -> None:
        self._console = console
        self._file = console.file
        self._picture = picture
        self._lines: list[str] = []
        self._columns = 0
        self._waiting: list[str] = []
        self._waiting_characters = 0
        self._gone = False
        self._adding = threading.Lock()  # held for moments only
        self._drawing = threading.Lock()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._draw_on, name="painter", daemon=True)
        self._restore = ExitStack()

    def __enter__(self) -> Painter:
        if sys.stdout.isatty():  # or it is a file or a pipe, and none of the terminal's business
            self._restore.enter_context(redirect_stdout(cast(TextIO, _Above(self, sys.stdout))))
        self._restore.enter_context(redirect_stderr(cast(TextIO, _Above(self, sys.stderr))))
        if threading.current_thread() is threading.main_thread():
            before = signal.signal(signal.SIGCONT, lambda number, frame: self._forget())
            self._restore.callback(signal.signal, signal.SIGCONT, before)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._done.set()
        self._restore.close()
        self._thread.join()
        if self._waiting and not self._waiting[-1].endswith("\n"):
            self.print_above("\n")
        self.draw([])

    def print_above(self, text: str) -> None:
        """Have text pass above the picture, at the next redraw."""
        with self._adding:
            self._waiting.append(text)
            self._waiting_characters += len(text)
        if self._waiting_characters > MOST_WAITING:
            self.draw()

    def _take_waiting(self) -> str:
        """The whole lines of what is to pass above."""
        with self._adding:
            lines, newline, rest = "".join(self._waiting).rpartition("\n")
            self._waiting = [rest] if rest else []
            self._waiting_characters = 0  # a line may be as long as it likes
        return lines + newline

    def _forget(self) -> None:
        """After Ctrl-Z the shell has written below the picture: the next one is drawn below that."""
        self._lines, self._columns = [], 0

    def _draw_on(self) -> None:
        self.draw()
        while not self._done.wait(EVERY_S):
            self.draw()

    def draw(self, lines: list[str] | None = None) -> None:
        """Draw these lines, or the picture of now, if anything has changed."""
        with self._drawing:
            above = self._take_waiting()
            if self._gone:
                return
            columns = self._console.size.width
            lines = self._rendered() if lines is None else lines
            if (lines, columns, above) == (self._lines, self._columns, ""):
                return
            text = self._redraw(lines, above, columns)
            self._lines, self._columns = lines, columns
            try:
                self._file.write(text)
                self._file.flush()
            except (OSError, ValueError):  # the terminal is gone; the run is not
                self._gone = True

    def _rendered(self) -> list[str]:
        """The picture's lines, with their colours."""
        name = self._console.color_system
        colours = None if name is None else COLOR_SYSTEMS[name]
        lines = self._console.render_lines(self._picture(), pad=False)
        return ["".join(_coloured(segment, colours) for segment in line) for line in lines]

    def _redraw(self, lines: list[str], above: str, columns: int) -> str:
        """Return the text that turns the old picture, with the cursor on the line below it, into the new one."""
        rows = sum(self._rows(line, columns) for line in self._lines)
        parts = [_BEGIN, "\r", f"\x1b[{rows}A" if rows else ""]
        old = self._lines
        if above or columns != self._columns:
            parts += [_ERASE_BELOW, above]
            old = []
        for before, line in zip_longest(old[: len(lines)], lines):
            parts += ["\n"] if before == line else [line, _ERASE_LINE, "\n"]
        return "".join([*parts, _ERASE_BELOW, _END])

    def _rows(self, line: str, columns: int) -> int:
        """Rows that a line takes up now: a terminal that has become narrower has broken it."""
        if columns >= self._columns:
            return 1
        return max(1, -(-cell_len(_COLOURS.sub("", line)) // columns))


def _coloured(segment: Segment, colours: ColorSystem | None) -> str:
    style = segment.style
    return segment.text if colours is None or style is None else style.render(segment.text, color_system=colours)


class _Above:
    """Stands for stdout or stderr while there is a picture."""

    def __init__(self, painter: Painter, stream: TextIO) -> None:
        self._painter = painter
        self._stream = stream

    def write(self, text: str) -> int:
        """Print above the picture."""
        self._painter.print_above(text)
        return len(text)

    def writelines(self, lines: list[str]) -> None:
        """Print above the picture."""
        self._painter.print_above("".join(lines))

    def flush(self) -> None:
        """The next redraw does."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
