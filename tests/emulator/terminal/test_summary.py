"""Summaries: what programs warned of; commands can be typed as shown: quoted, and relative to the folder."""

import shlex
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from emulator.terminal.summary import as_typed
from tests.support.command_line import app


@pytest.mark.parametrize(
    ("command", "typed"),
    [
        ("vnet run {here}/runs/one-1/scenario.toml", "vnet run runs/one-1/scenario.toml"),
        ("vnet run '{here}/my runs/scenario.toml' --program a:b", "vnet run 'my runs/scenario.toml' --program a:b"),
        ("vnet check '/far away/run'", "vnet check '/far away/run'"),
        ("vnet check runs/one-1", "vnet check runs/one-1"),
        ("vnet check 'not closed", "vnet check 'not closed"),
        ("vnet run 'a;b' $c", "vnet run 'a;b' '$c'"),
        ("vnet check {here}/-r --last", "vnet check ./-r --last"),
        ("vnet check 'a\tü'\\''\\'", "vnet check $'a\\011\\303\\274\\047\\134'"),
    ],
)
def test_paths_are_quoted_and_relative(
    command: str, typed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("shutil.which", lambda program: f"/bin/{program}")
    assert as_typed(command.format(here=tmp_path)) == typed


def test_a_program_that_is_not_on_the_path_is_named_with_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("shutil.which", lambda program: None)
    monkeypatch.setattr(sys, "executable", str(tmp_path / ".venv" / "bin" / "python"))
    assert as_typed("vnet check run") == ".venv/bin/vnet check run"
    monkeypatch.setattr(sys, "executable", "/opt/my env/bin/python")
    assert as_typed("vnet check run") == f"{shlex.quote('/opt/my env/bin/vnet')} check run"


def test_the_first_line_that_is_no_mere_note_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    says = ["log('quiet')", "log('first', 'warning')", "log('second', 'error')"]
    Path("loud.py").write_text("async def main(node):\n" + "".join(f"    node.{each}\n" for each in says))
    done = CliRunner().invoke(app, ["simulate", "twelve", "--program", "loud.py", "--no-report", "--duration=0.1"])
    (line,) = [line for line in done.output.splitlines() if line.startswith("log ")]
    assert "v01: first" in line
    assert "24 warnings" in line
