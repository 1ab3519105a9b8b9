"""A run that is refused leaves nothing: no folder, no number used up, and `runs/latest` where it was."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from emulator.terminal.console import run_app
from tests.support.command_line import app
from tests.support.paths import ROOT

pytestmark = pytest.mark.slow

BEACON = str(ROOT / "scenarios" / "beacon.toml")
SHORT = ["--duration", "0.5", "--set", "network.vehicles=2", "--quiet", "--no-report"]
UNKNOWN = 3
"""Exit status of a run in which nobody sends, so that there is nothing to judge."""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A current folder with programs, one of which is good; this process forgets them."""
    programs = {"good": "async def main(node):\n    pass\n", "leaves_early": "import os\nos._exit(7)\n"}
    for name, code in programs.items():
        (tmp_path / f"{name}.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    for name in programs:
        sys.modules.pop(name, None)


def vnet(*arguments: str) -> tuple[int, str]:
    """Run `vnet ARGUMENTS` in this process; returns the exit status and stderr."""
    done = CliRunner(env={"PYTHONHASHSEED": "0"}).invoke(app, list(arguments))
    return done.exit_code, done.stderr


@pytest.mark.parametrize("command", ["run", "simulate"])
def test_a_debugger_needs_a_terminal(command: str) -> None:
    status, stderr = vnet(command, BEACON, "--duration", "1", "--debug", "v03")
    assert status == 2 and stderr.endswith("--debug v03: needs a terminal on standard input and output\n")
    assert not Path("runs").exists()


@pytest.mark.parametrize("command", ["run", "simulate"])
def test_a_missing_extra_is_the_only_line(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vnet.extras.is_installed", lambda library: library != "scipy")
    status, stderr = vnet(command, "80211p", "--duration", "1")
    assert status == 2 and stderr.startswith("vnet: a physical radio (radio.path_loss, radio.mac) needs scipy: pip")
    assert stderr.count("\n") == 1


def test_a_current_folder_that_is_gone_is_one_line(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONHASHSEED", "0")
    (here / "gone").mkdir()
    os.chdir(here / "gone")
    (here / "gone").rmdir()
    assert run_app(app, ["simulate", BEACON, *SHORT]) == 2
    assert capsys.readouterr().err == "vnet: the current folder is not there any more\n"


def test_users_of_a_run_are_made_for_its_program(here: Path) -> None:
    assert vnet("access", BEACON, "--program", "good:main", "--out", "access")[0] == 0
    assert (here / "access" / "credentials").is_dir()


def test_the_number_is_not_used_up_and_latest_stays() -> None:
    assert vnet("simulate", BEACON, *SHORT, "--program", "good:main")[0] == UNKNOWN
    assert vnet("simulate", BEACON, *SHORT, "--program", "good:mainn")[0] == 2
    assert vnet("run", BEACON, *SHORT, "--program", "leaves_early:main") == (
        2,
        "vnet: program.entry = 'leaves_early:main': importing it ended the process (exit status 7)\n",
    )
    assert sorted(path.name for path in Path("runs").iterdir()) == ["beacon-1", "latest"]
    assert vnet("simulate", BEACON, *SHORT, "--program", "good:main")[0] == UNKNOWN
    assert Path("runs/latest").readlink() == Path("beacon-1-2")


@pytest.mark.parametrize("leave", ["sys.exit()", "os._exit(0)", "os.execv('/bin/true', ['true'])"])
@pytest.mark.parametrize("command", ["simulate", "run"])
def test_a_program_that_leaves_as_it_is_imported_is_no_valid_run(here: Path, command: str, leave: str) -> None:
    (here / "exits.py").write_text(f"import os, sys\nasync def main(node): ...\n{leave}\n")
    said = "vnet: program.entry = 'exits:main': importing it ended the process (exit status 0)\n"
    assert vnet(command, BEACON, *SHORT, "--program", "exits:main") == (2, said)


def test_an_import_that_does_not_end_is_ended(here: Path) -> None:
    (here / "waits_for_ever.py").write_text("import threading\nthreading.Event().wait()\n")
    options = ["--program", "waits_for_ever:main", "--set", "run.join_timeout_s=0.1"]
    assert vnet("run", BEACON, *SHORT, *options) == (
        2,
        "vnet: program.entry = 'waits_for_ever:main': not imported within run.join_timeout_s = 0.1\n",
    )
    assert not Path("runs").exists()


def test_an_endpoint_that_cannot_be_listened_at_leaves_nothing() -> None:
    status, stderr = vnet("emulator", BEACON, *SHORT, "--listen", "tcp/192.0.2.1:7447")
    assert status == 2
    assert "cannot listen on tcp/192.0.2.1:7447: no such address on this machine" in stderr
    assert not Path("runs").exists()
