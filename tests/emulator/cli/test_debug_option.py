"""`--debug` is refused in one line where no debugger can be."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from emulator.cli import options as command_options
from emulator.cli.commands import app
from tests.support.paths import ROOT

pytestmark = pytest.mark.slow

BEACON = str(ROOT / "scenarios" / "beacon.toml")
REFUSED = [
    (["--debug", "v3"], "--debug v3: no such vehicle (did you mean v03?)"),
    (["--debug", "v03:12"], "--debug v03:12: write it as NODE or NODE:FILE:LINE, as v03:hello.py:12"),
    (["--debug", "v03:none.py:12"], "--debug v03:none.py:12: none.py: no such file"),
    (["--debug", "v03", "--quiet"], "--debug v03: cannot be combined with --quiet or --log-format json"),
    (["--debug", "v03", "--log-format", "json"], "cannot be combined with --quiet or --log-format json"),
]


@pytest.mark.parametrize("command", ["run", "simulate"])
@pytest.mark.parametrize(("options", "message"), REFUSED)
def test_a_debugger_that_cannot_be_is_refused(
    command: str, options: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command_options, "_at_a_terminal", lambda: True)
    refused(command, options, message, tmp_path, monkeypatch)


def test_real_time_cannot_be_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    message = "--debug v03: real time cannot be stopped; use --pacing lockstep"
    refused("run", ["--debug", "v03", "--pacing", "realtime"], message, tmp_path, monkeypatch)


def test_hosts_have_no_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    message = "--debug and --hosts exclude each other"
    refused("run", ["--debug", "v03", "--hosts", "2"], message, tmp_path, monkeypatch)


def test_a_debugger_is_in_one_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    message = "--debug and --processes exclude each other"
    refused("simulate", ["--debug", "v03", "--processes", "2"], message, tmp_path, monkeypatch)


@pytest.mark.parametrize("command", ["run", "simulate"])
def test_a_debugger_needs_a_terminal(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    message = "--debug v03: needs a terminal on standard input and output"
    refused(command, ["--debug", "v03"], message, tmp_path, monkeypatch)


def refused(command: str, options: list[str], message: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    done = CliRunner(env={"PYTHONHASHSEED": "0"}).invoke(app, [command, BEACON, "--duration", "1", *options])
    last = done.stderr.splitlines()[-1]
    assert (done.exit_code, message in last) == (2, True), done.stderr
    assert list(folder.iterdir()) == [], "and leaves nothing"
