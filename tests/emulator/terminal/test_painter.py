"""A picture at the foot of a terminal: nothing that passes above it is lost, and nothing of it is left behind."""

import io
import os
import signal
import sys
import threading

import pytest
from rich.console import Console
from rich.text import Text

from emulator.terminal.painter import MOST_WAITING, Painter
from tests.support.screen import Screen


class Terminal(io.StringIO):
    """A file that is a terminal, and its screen."""

    def __init__(self, width: int = 40, height: int = 12) -> None:
        super().__init__()
        self.screen = Screen(width, height)
        self.written: list[str] = []
        self.console = Console(file=self, force_terminal=True, width=width, height=height, _environ={})

    def isatty(self) -> bool:
        return True

    def write(self, text: str) -> int:
        self.written.append(text)
        self.screen.feed(text)
        return len(text)

    def resize(self, width: int, height: int) -> None:
        self.screen.resize(width, height)
        self.console.size = (width, height)


class Pictures:
    """Return the lines that are drawn now."""

    def __init__(self, *lines: str) -> None:
        self.lines = list(lines)

    def __call__(self) -> Text:
        return Text("\n".join(self.lines), no_wrap=True, overflow="crop")


def test_a_picture_is_drawn_changed_and_taken_away() -> None:
    terminal, pictures = Terminal(), Pictures("one", "two", "three")
    terminal.screen.feed("$ vnet\n")
    painter = Painter(terminal.console, pictures)
    painter.draw()
    assert terminal.screen.text == "$ vnet\none\ntwo\nthree"
    pictures.lines[1] = "zwo"
    painter.draw()
    assert terminal.screen.text == "$ vnet\none\nzwo\nthree"
    assert "zwo" in terminal.written[-1]
    assert "one" not in terminal.written[-1], "only what has changed is written"
    painter.draw()
    assert len(terminal.written) == 2, "nothing has changed"
    pictures.lines = ["1"]
    painter.draw()
    assert terminal.screen.text == "$ vnet\n1"
    pictures.lines = ["1", "2", "3", "4"]
    painter.draw()
    assert terminal.screen.text == "$ vnet\n1\n2\n3\n4"
    painter.draw([])
    assert terminal.screen.text == "$ vnet"
    assert (terminal.screen.row, terminal.screen.column) == (1, 0)


def test_what_is_printed_passes_above_in_whole_lines() -> None:
    terminal, pictures = Terminal(), Pictures("one", "two")
    painter = Painter(terminal.console, pictures)
    painter.draw()
    painter.print_above("hello\nhalf a ")
    painter.draw()
    assert terminal.screen.text == "hello\none\ntwo"
    painter.print_above("line that is wider than the terminal is wide\n")
    painter.draw()
    broken = "half a line that is wider than the terminal is wide"
    assert terminal.screen.text == f"hello\n{broken[:40]}\n{broken[40:]}\none\ntwo"


def test_while_it_is_there_prints_pass_above_it(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setattr(sys, "stderr", terminal)
    with Painter(terminal.console, Pictures("a picture")):
        assert sys.stdout.isatty()
        print("a program says something")
        print("and another", file=sys.stderr)
        print("and ends in mid-line", end="")
    assert sys.stdout is terminal
    assert terminal.screen.text == "a program says something\nand another\nand ends in mid-line"


def test_what_goes_to_a_file_goes_there(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal, file = Terminal(), io.StringIO()
    monkeypatch.setattr(sys, "stdout", file)
    monkeypatch.setattr(sys, "stderr", terminal)
    with Painter(terminal.console, Pictures("a picture")):
        print("a result")
    assert file.getvalue() == "a result\n"
    assert terminal.screen.text == ""


def test_who_prints_much_waits_for_the_terminal() -> None:
    terminal = Terminal()
    painter = Painter(terminal.console, Pictures("a picture"))
    line = "x" * 39 + "\n"
    for _ in range(MOST_WAITING // len(line) + 1):
        painter.print_above(line)
    assert len(terminal.written) == 1
    assert terminal.written[0].count(line) == MOST_WAITING // len(line) + 1


@pytest.mark.parametrize("width", [39, 25, 13, 60])
def test_a_narrower_terminal_keeps_nothing_of_the_old_picture(width: int) -> None:
    terminal = Terminal(40, 50)
    terminal.screen.feed("before\n")
    pictures = Pictures("x" * 40, "short", "y" * 27, "")
    painter = Painter(terminal.console, pictures)
    painter.draw()
    terminal.resize(width, 50)
    pictures.lines = ["new", "picture"]
    painter.draw()
    assert terminal.screen.text == "before\nnew\npicture"


def test_after_a_stop_the_picture_goes_on_below_what_the_shell_said() -> None:
    terminal = Terminal()
    painter = Painter(terminal.console, Pictures("a picture"))
    before = signal.getsignal(signal.SIGCONT)
    with painter:
        painter.draw()
        terminal.screen.feed("[1]+ Stopped\n$ fg\n")
        os.kill(os.getpid(), signal.SIGCONT)
        painter.draw()
        assert terminal.screen.text == "a picture\n[1]+ Stopped\n$ fg\na picture"
    assert signal.getsignal(signal.SIGCONT) == before


def test_a_terminal_that_goes_away_harms_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setattr(sys, "stderr", terminal)
    pictures = Pictures("a picture")
    with Painter(terminal.console, pictures) as painter:
        painter.draw()

        def fail(text: str) -> int:
            raise OSError(5, "Input/output error")

        monkeypatch.setattr(terminal, "write", fail)
        pictures.lines = ["another"]
        print("said to nobody")
        painter.draw()
        print("x" * (MOST_WAITING + 1))
    assert terminal.screen.text == "a picture"


def test_a_terminal_that_stands_still_holds_up_nobody_who_prints() -> None:
    """As with Ctrl-S: a redraw hangs, and the run goes on."""
    terminal = Terminal()
    detach, hanging = threading.Event(), threading.Event()
    write = terminal.write

    def hang(text: str) -> int:
        hanging.set()
        assert detach.wait(60)
        return write(text)

    terminal.write = hang  # type: ignore[method-assign]
    with Painter(terminal.console, Pictures("a picture")) as painter:
        assert hanging.wait(60)
        painter.print_above("a line\n")
        detach.set()
    assert terminal.screen.text == "a line"
