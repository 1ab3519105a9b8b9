"""Texts of others reach a terminal as text; a picture at its foot loses nothing that is printed."""

import io
import json
import logging
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from rich.console import Console
from rich.panel import Panel
from rich.table import Table
from rich.text import Text
from typer.testing import CliRunner

from emulator.terminal.live import MOST_WAITING, LivePicture, SafeConsole
from tests.support.command_line import app
from tests.support.recorded import recorded
from tests.support.screen import Screen

Edit = Callable[[Path], None]
HOSTILE = "\x1b]0;owned\x07\x1b[2J\x9b31m\x00[/red] :smile:"


def printed(renderable: object) -> str:
    file = io.StringIO()
    console = SafeConsole(file)
    console.print(renderable)
    return file.getvalue()


def is_plain(text: str) -> bool:
    return all(character.isprintable() or character in "\n\t" for character in text)


def test_control_characters_are_shown_in_whatever_holds_them() -> None:
    table = Table("head")
    table.add_row(Text(HOSTILE))
    table.add_row(HOSTILE)
    for each in (HOSTILE, Text(HOSTILE), table, Panel(HOSTILE, title=Text(HOSTILE))):
        text = printed(each)
        assert is_plain(text), repr(text)
        assert "x1b]0;owned" in text
    assert "[/red] :smile:" in printed(HOSTILE)


@pytest.mark.parametrize("value", ["", "0", "00"])
def test_a_size_of_zero_in_the_environment_is_not_known(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    for name in ("COLUMNS", "LINES"):
        monkeypatch.delenv(name, raising=False)
    size = SafeConsole(io.StringIO()).size
    for name in ("COLUMNS", "LINES"):
        monkeypatch.setenv(name, value)
    assert SafeConsole(io.StringIO()).size == size and "all that there is" in printed("all that there is")
    monkeypatch.setenv("COLUMNS", "33")
    assert SafeConsole(io.StringIO()).width == 33


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    network, program = {"vehicles": 3}, {"entry": "agents.beacon:main"}
    scenario = {"run": {"duration_s": 1.0}, "network": network, "program": program}
    return recorded(scenario, tmp_path_factory.mktemp("safe") / "run")


def of_events(folder: Path) -> None:
    event = {
        "time_ns": 1,
        "kind": "crashed",
        "node": "v01",
        "error": HOSTILE,
        "where": HOSTILE,
        "log_tail": HOSTILE,
    }
    with (folder / "events.jsonl").open("a") as file:
        file.write(json.dumps(event) + "\n")


def of_verdict(folder: Path) -> None:
    path = folder / "verdict.json"
    data = json.loads(path.read_text())
    data["checks"].append(
        {"name": f"own:{HOSTILE}", "verdict": "invalid", "text": HOSTILE, "figures": {"rows": [{HOSTILE: HOSTILE}]}}
    )
    data["not_exercised"].append({"name": f"own:{HOSTILE}", "reason": HOSTILE})
    data["reproduce"] = f"vnet {HOSTILE}"
    path.write_text(json.dumps(data))


def of_manifest(folder: Path) -> None:
    (folder / "manifest.json").write_text(json.dumps({HOSTILE: HOSTILE}))


def of_states(folder: Path) -> None:
    path = folder / "states.parquet"
    states = pq.read_table(path)
    pq.write_table(states.append_column(f"a.{HOSTILE}", states["heading_rad"]), path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "edits"),
    [
        *((command, [of_events, of_verdict, of_states]) for command in ("check", "report", "compare")),
        *((command, [of_events, of_verdict, of_states]) for command in ("radio", "trace")),
        ("check", [of_manifest]),
    ],
    ids=["check", "report", "compare", "radio", "trace", "manifest"],
)
def test_no_command_sends_what_a_folder_holds(run: Path, tmp_path: Path, command: str, edits: list[Edit]) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    for edit in edits:
        edit(copy)
    arguments = [command, str(copy), *([str(run)] if command == "compare" else [])]
    done = CliRunner(env={"PYTHONHASHSEED": "0"}).invoke(app, arguments)
    assert done.exit_code in (0, 1, 2), done.output
    assert is_plain(done.output), repr(done.output)


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


def terminal_of(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Standard output and error, on a terminal; pictures are drawn when a test says so."""
    terminal = Terminal()
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, terminal)
    monkeypatch.setattr("emulator.terminal.live.EVERY_S", 3600.0)
    return terminal


def test_picture_is_drawn_changed_and_taken_away(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = terminal_of(monkeypatch)
    screen.screen.feed("$ vnet\n")
    with LivePicture(screen.console, pictures := Pictures("one", "two", "three")) as live:
        assert screen.screen.text == "$ vnet\none\ntwo\nthree"
        for lines in (["one", "zwo", "three"], ["1"], ["1", "2", "3", "4"]):
            pictures.lines = lines
            live.refresh()
            assert screen.screen.text == "\n".join(["$ vnet", *lines])
    assert screen.screen.text == "$ vnet"
    assert (screen.screen.row, screen.screen.column) == (1, 0)


def test_prints_pass_above_in_whole_lines_whatever_their_length(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = terminal_of(monkeypatch)
    with LivePicture(screen.console, Pictures("one", "two")) as live:
        assert sys.stdout.isatty()
        print("hello\nhalf a ", end="")
        live.refresh()
        assert screen.screen.text == "hello\none\ntwo"
        print("line that is wider than the terminal is wide", file=sys.stderr)
        live.refresh()
        broken = "half a line that is wider than the terminal is wide"
        assert screen.screen.text == f"hello\n{broken[:40]}\n{broken[40:]}\none\ntwo"
        print("and ends in mid-line", end="")
    assert sys.stdout is screen
    assert screen.screen.text == f"hello\n{broken[:40]}\n{broken[40:]}\nand ends in mid-line"


def test_handler_given_to_logging_meanwhile_goes_on_after_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = terminal_of(monkeypatch)
    with LivePicture(screen.console, Pictures("a picture")):
        handler = logging.StreamHandler()
    handler.handle(logging.makeLogRecord({"msg": "afterwards"}))
    assert screen.screen.text == "afterwards"


def test_what_goes_to_a_file_goes_there(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = terminal_of(monkeypatch)
    monkeypatch.setattr(sys, "stdout", file := io.StringIO())
    with LivePicture(screen.console, Pictures("a picture")):
        print("a result")
    assert (file.getvalue(), screen.screen.text) == ("a result\n", "")


def test_a_program_that_prints_much_waits_for_the_terminal_and_redraws_seldom(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    screen = terminal_of(monkeypatch)
    with LivePicture(screen.console, Pictures("a picture")):
        before = len(screen.written)
        for number in range(MOST_WAITING):
            sys.stdout.write(f"{number}\n")
        assert len(screen.written) == before
        sys.stdout.write("last\n")
        assert len(screen.written) == before + 1
        assert screen.screen.text.splitlines()[-3:] == [str(MOST_WAITING - 1), "last", "a picture"]


@pytest.mark.parametrize("width", [39, 25, 13, 60])
def test_a_narrower_terminal_keeps_nothing_of_the_old_picture(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = terminal_of(monkeypatch)
    screen.screen.feed("before\n")
    with LivePicture(screen.console, pictures := Pictures("x" * 40, "", "short", "y" * 27)) as live:
        screen.resize(width, 50)
        pictures.lines = ["new", "picture"]
        live.refresh()
        assert screen.screen.text == "before\nnew\npicture"


def test_after_a_stop_the_picture_goes_on_below_what_the_shell_said(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = terminal_of(monkeypatch)
    before = signal.getsignal(signal.SIGCONT)
    with LivePicture(screen.console, Pictures("a picture")) as live:
        screen.screen.feed("\n[1]+ Stopped\n$ fg\n")
        os.kill(os.getpid(), signal.SIGCONT)
        live.refresh()
        assert screen.screen.text == "a picture\n[1]+ Stopped\n$ fg\na picture"
    assert signal.getsignal(signal.SIGCONT) == before


def test_a_terminal_that_stands_still_holds_up_nobody_who_prints(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with Ctrl-S: a redraw hangs, and the run goes on."""
    screen = terminal_of(monkeypatch)
    detach, hanging = threading.Event(), threading.Event()
    write = screen.write

    def hang(text: str) -> int:
        hanging.set()
        assert detach.wait(60)
        return write(text)

    with LivePicture(screen.console, Pictures("a picture")) as live:
        monkeypatch.setattr(screen, "write", hang)
        redraw = threading.Thread(target=live.refresh)
        redraw.start()
        assert hanging.wait(60)
        print("a line")
        detach.set()
        redraw.join()
    assert screen.screen.text == "a line"
