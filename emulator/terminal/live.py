"""rich's console and live display, for texts of others, programs that print, and windows that are resized."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from typing import IO, TextIO, cast

from rich.console import Console, ConsoleOptions, ConsoleRenderable, RenderableType
from rich.control import Control
from rich.file_proxy import FileProxy
from rich.live import Live
from rich.segment import ControlType, Segment, SegmentLines, Segments

from emulator.pages.text import as_text

EVERY_S = 0.25
MOST_WAITING = 10_000
"""Pieces of text that wait for the next redraw; a thread that prints more redraws, at the terminal's speed."""
_BEGIN, _END = "\x1b[?2026h", "\x1b[?2026l"  # show it when all is there; terminals that cannot pass it over
_ERASE_AND_UP = ((ControlType.ERASE_IN_LINE, 2), (ControlType.CURSOR_UP, 1))


class SafeConsole(Console):
    """A console whose own colours are the only escape sequences that reach the terminal.

    Control characters are shown as escapes, and markup in texts has no effect. A size of 0 in the environment is
    one that is not known.
    """

    def __init__(self, file: IO[str] | None = None, stderr: bool = False, colours: bool = True) -> None:
        unknown = [name for name in ("COLUMNS", "LINES") if not os.environ.get(name, "").strip("0")]
        super().__init__(
            file=file,
            stderr=stderr,
            markup=False,
            emoji=False,
            color_system="auto" if colours else None,
            _environ={name: value for name, value in os.environ.items() if name not in unknown},
        )

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments of a renderable, with the control characters of its texts as escapes."""
        for segment in super().render(renderable, options):
            plain = segment.control is not None or segment.text.isprintable() or segment.text == "\n"
            yield segment if plain else segment._replace(text=as_text(segment.text))


def terminal(file: TextIO) -> Console | None:
    """Return a console on a terminal that can show a picture; None for anything else."""
    console = SafeConsole(file)
    able = file.isatty() and console.is_interactive and not console.options.ascii_only
    if able and console.no_color:  # neither bold nor dim
        console = SafeConsole(file, colours=False)
    return console if able else None


class LivePicture(Live):
    """rich's `Live` on what `picture` returns; as a context manager it redraws itself and takes itself away.

    `Live` alone redraws once for each printed line, and after a window was made narrower leaves half of the picture
    behind.
    """

    def __init__(self, console: Console, picture: Callable[[], RenderableType]) -> None:
        self._picture = picture
        self._printed: deque[str] = deque()
        self._unfinished = ""
        self._widths: list[int] = []  # columns of the lines on the screen
        self._next_widths: list[int] = []
        self._stopped = False  # by Ctrl-Z
        self._restore = ExitStack()
        super().__init__(
            console=console,
            refresh_per_second=1 / EVERY_S,
            transient=True,
            vertical_overflow="crop",
            redirect_stdout=False,
            redirect_stderr=False,
        )

    def start(self, refresh: bool = False) -> None:
        """Show the picture at once, and have what is printed from now on pass above it."""
        if sys.stdout.isatty():  # a file or a pipe is not on the terminal
            self._restore.enter_context(redirect_stdout(cast(TextIO, _Above(self, sys.stdout))))
        self._restore.enter_context(redirect_stderr(cast(TextIO, _Above(self, sys.stderr))))
        if threading.current_thread() is threading.main_thread():
            before = signal.signal(signal.SIGCONT, self._continued)
            self._restore.callback(signal.signal, signal.SIGCONT, before)
        super().start(refresh=True)
        self.console.show_cursor(True)  # a process that is killed or stopped cannot show it again

    def stop(self) -> None:
        """Take the picture away. Harmless if done twice."""
        self._restore.close()
        super().stop()

    def print_above(self, text: str) -> None:
        """Have text pass above the picture, at the next redraw."""
        self._printed.append(text)
        if len(self._printed) > MOST_WAITING:
            self.refresh()

    def _continued(self, number: int, frame: object) -> None:
        """After Ctrl-Z the shell has written below the picture: the next one is drawn below that."""
        self._stopped = True

    def get_renderable(self) -> RenderableType:
        """Return the picture of now."""
        lines = self.console.render_lines(self._picture(), pad=False)
        self._next_widths = [Segment.get_line_length(line) for line in lines]
        return SegmentLines(lines, new_lines=True)

    def process_renderables(self, renderables: list[ConsoleRenderable]) -> list[ConsoleRenderable]:
        """Return what is written: the way back over the old picture, what was printed, and the new picture."""
        erase, *_, picture = super().process_renderables(renderables)
        columns = self.console.width
        broken = sum((width - 1) // columns for width in self._widths if width)  # rows, as lines became too wide
        way_back = [Control(ControlType.CARRIAGE_RETURN, *_ERASE_AND_UP * broken), erase]
        if self._stopped:
            way_back, self._stopped = [], False
        self._widths = self._next_widths
        return [_raw(_BEGIN), *way_back, _raw(self._whole_lines()), picture, _raw(_END)]

    def _whole_lines(self) -> str:
        """Return the whole lines that were printed since the last redraw, as they are."""
        text = self._unfinished + "".join(self._printed.popleft() for _ in range(len(self._printed)))
        if text and not self.is_started:  # the last redraw
            text = text.removesuffix("\n") + "\n"
        lines, newline, self._unfinished = text.rpartition("\n")
        return lines + newline


def _raw(text: str) -> Segments:
    """Text that is neither cut nor wrapped, nor loses its escape sequences: to rich, controls are that."""
    return Segments([Segment(text, None, [(ControlType.CARRIAGE_RETURN,)])])


class _Above(FileProxy):
    """Stands for stdout or stderr while there is a picture."""

    def __init__(self, live: LivePicture, stream: TextIO) -> None:
        super().__init__(live.console, stream)
        self._live = live

    encoding = property(lambda self: self.rich_proxied_file.encoding)
    errors = property(lambda self: self.rich_proxied_file.errors)

    def write(self, text: str) -> int:
        """Print above the picture; or as ever if it is gone, as for a handler that a program gave to `logging`."""
        if not self._live.is_started:
            return self.rich_proxied_file.write(text)
        self._live.print_above(text)
        return len(text)
