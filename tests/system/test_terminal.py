"""Terminal output for users, through the commands they type: a picture, one line for each mistake, JSON."""

import fcntl
import json
import os
import re
import signal
import socket
import struct
import termios
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path

import pytest

from emulator.drivers.control import ask, control_endpoint
from emulator.drivers.status import Snapshot
from tests.support.forked_commands import VNET, Command, run
from tests.support.paths import ROOT
from tests.support.screen import Screen
from tests.system.conftest import TIMEOUT_S, read_terminal
from tests.system.test_failures import long_run
from vnet.errors import TransportError
from vnet.transport import session
from vnet.transport.access import Access

DOCS = (ROOT / "docs" / "viewing.md").read_text()
SHORT = ["scenarios/beacon.toml", "--duration", "3", "--set", "network.vehicles=4"]
WIDTH, HEIGHT = 90, 24
CONTROL = re.compile(r"\x1b\[(\??)[\d;]*([A-Za-z])")


def at_a_terminal(
    *arguments: str, awaited: str = "", then: Callable[[], None] = lambda: None, **environment: str
) -> tuple[int, str]:
    """A vnet command on a pseudo-terminal: its status, and what it wrote; once it writes `awaited`, do `then`."""
    master, slave = os.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", HEIGHT, WIDTH, 0, 0))
    kept = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES", "NO_COLOR")}
    environment = {**kept, "TERM": "xterm-256color", "PYTHONHASHSEED": "0", **environment}
    with Command([*VNET, *arguments], cwd=ROOT, stdout=slave, stderr=slave, env=environment) as process:
        os.close(slave)
        written = b""
        done = False
        while part := read_terminal(master, written):
            written += part
            if awaited and not done and awaited in written.decode(errors="ignore"):
                done = True
                then()
        os.close(master)
    return process.returncode, written.decode().replace("\r\n", "\n")


def on_screen(written: str) -> str:
    screen = Screen(WIDTH, HEIGHT)
    screen.feed(written)
    return screen.text


def test_a_picture_is_shown_and_the_summary_follows_on_a_clean_screen(tmp_path: Path) -> None:
    status, written = at_a_terminal("simulate", *SHORT, "--out", str(tmp_path / "run"))
    assert status == 0
    assert "lockstep · seed 1 · 4 vehicles" in CONTROL.sub("", written)
    shown = on_screen(written)
    first, second = shown.splitlines()[:2]
    assert first == "beacon: lockstep, seed 1, 3 s of emulated time"
    assert second.startswith("verdict: valid  checks: ")
    assert "lockstep · seed" not in shown
    assert f"files        {tmp_path}" in shown


def fields_in_the_docs(heading: str) -> set[str]:
    """The names in the first column of the table under a heading of docs/viewing.md."""
    _, _, after = DOCS.partition(heading)
    rows = re.findall(r"^\| (`.*?) \|", after.partition("\n\n##")[0].partition("\n\nOn stdout")[0], re.MULTILINE)
    return {name for row in rows for name in re.findall(r"`(\w+)`", row)}


def test_the_docs_name_every_field(tmp_path: Path) -> None:
    told = run(
        [*VNET, "simulate", *SHORT, "--out", str(tmp_path / "run"), "--log-format", "json"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    lines = [json.loads(line) for line in told.stderr.splitlines()]
    (progress, *_) = [line for line in lines if line["kind"] == "progress"]
    assert fields_in_the_docs("A `progress` object:") == progress.keys() - {"kind", "wall_s"}
    in_status = {field.name for field in fields(Snapshot)}
    beside = in_status - progress.keys()
    section = DOCS.partition("## A running emulator")[2].partition("\n## ")[0]
    assert beside <= {*re.findall(r"`(\w+)`", section)}
    figures = {"position_rmse_m", "fix_rmse_m"}  # in a status they are its `figures`
    assert progress.keys() - in_status == {"kind", "vehicles", "faults_acting"} | figures
    kinds = {line["kind"] for line in lines} | {"error"}
    assert kinds <= fields_in_the_docs("## JSON for machines")


def test_the_status_of_a_run_is_its_picture_or_json(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with long_run(folder) as process:
        told = run([*VNET, "status", "--run", str(folder)], cwd=ROOT, capture_output=True, text=True)
        assert told.returncode == 0, told.stderr
        rows = [line.split() for line in told.stdout.splitlines()]
        assert rows[0][:6] == ["beacon", "lockstep", "·", "seed", "1", "·"]
        (vehicles,) = [row for row in rows if row and row[0] == "vehicles"]
        assert vehicles == ["vehicles", "●●●", "3", "up"]
        assert "\x1b" not in told.stdout
        asked = run([*VNET, "status", "--run", str(folder), "--json"], capture_output=True, text=True)
        status = json.loads(asked.stdout)
        assert (status["run"], status["phase"], status["node_ids"]) == ("beacon", "running", ["v01", "v02", "v03"])
        assert 0 < status["emulated_s"] < status["duration_s"] == 3600
        assert status["real_time_factor"] > 0
        assert status["figures"]["fix_rmse_m"] > 0
        assert ask(folder, "status")["emulated_s"] >= status["emulated_s"]
        ends = partial(process.send_signal, signal.SIGINT)
        watch = ("status", "--run", str(folder), "--watch")
        exit_status, written = at_a_terminal(*watch, awaited="vehicles", then=ends)
        assert exit_status == 0
        last = "".join(on_screen(written).split())  # a long name of the folder breaks the line, at a space or not
        assert last == f"{folder}:therunisover"
        process.communicate(timeout=TIMEOUT_S)


def test_a_run_that_was_killed_is_said_to_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It leaves its control file behind."""
    monkeypatch.setattr(session, "CONNECT_TIMEOUT_S", 0.1)
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))  # and does not listen
        endpoint = f"tcp/127.0.0.1:{nobody.getsockname()[1]}"
        with (
            control_endpoint(tmp_path, endpoint, Access.create("town", [["v01"]])),
            pytest.raises(
                TransportError, match=r"the run does not answer \(was it killed\?\): cannot connect to tcp/"
            ),
        ):
            ask(tmp_path, "status")
