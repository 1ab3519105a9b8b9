"""The command line as a whole: what is imported for a command, and what help looks like."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import typer
import typer.main

from docs.generate.commands import contexts
from emulator.cli.application import build_app
from emulator.cli.table import COMMANDS, find
from emulator.learning.environment import environment
from emulator.terminal.console import run_app
from tests.support.command_line import app
from tests.support.paths import ROOT

ALL = {context.command_path: context.command for context in contexts("vnet", typer.main.get_command(app))}
SLOW_TO_IMPORT = [
    "numpy", "scipy", "pydantic", "zenoh", "pyarrow", "matplotlib", "rerun", "rich", "msgspec", "asyncio",
]  # fmt: skip
# Imported at the start of Python: prints at its end, or where it would start again, which modules were imported.
SPY = """
import atexit, json, os, sys

def execve(path, arguments, environment):
    print(json.dumps(["again", environment["PYTHONHASHSEED"], *sorted(sys.modules)]), flush=True)
    os._exit(0)

os.execve = execve
atexit.register(lambda: print(json.dumps(["end", "", *sorted(sys.modules)])))
"""


def spied(tmp_path: Path, *arguments: str) -> tuple[str, str, set[str]]:
    """Run a command; return whether it ended or starts again, with which hash seed, and the modules imported."""
    (tmp_path / "sitecustomize.py").write_text(SPY)
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    environment.pop("PYTHONHASHSEED", None)
    command = [sys.executable, "-P", "-m", "emulator", *arguments]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=True)
    how, seed, *modules = json.loads(done.stdout.splitlines()[-1])
    return how, seed, set(modules)


@pytest.mark.slow
@pytest.mark.parametrize("argument", ["--help", "--version"])
def test_what_needs_no_command_imports_none(argument: str, tmp_path: Path) -> None:
    how, _, modules = spied(tmp_path, argument)
    assert how == "end"
    assert modules & set(SLOW_TO_IMPORT) == set()
    assert "typer" in modules, "the spy sees imports"


@pytest.mark.slow
@pytest.mark.parametrize("name", [command.name for command in COMMANDS if command.runs_programs])
def test_what_runs_programs_starts_again_before_it_imports_anything(name: str, tmp_path: Path) -> None:
    how, seed, modules = spied(tmp_path, name, "--help")
    assert (how, seed) == ("again", "0")
    assert modules & {*SLOW_TO_IMPORT, "typer"} == set()


def test_a_command_line_names_its_command() -> None:
    named = find(["run", "simulate"])
    assert named is not None and named.name == "run"
    assert find(["--help"]) is None
    assert find(["runn"]) is None
    assert find([]) is None


def test_help_lists_every_command_on_a_line_of_eighty_columns(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert run_app(build_app([]), ["--help"]) == 0
    shown = capsys.readouterr().out
    headings = [line for line in shown.splitlines() if line and not line.startswith((" ", "Usage", "Options"))]
    assert headings == ["Run:", "Look:", "Break:", "Study:", "Files:"]
    lines = {line.split()[0]: line for line in shown.split("Run:")[1].splitlines() if line.startswith("  ")}
    assert {name: line.split(maxsplit=1)[1] for name, line in lines.items()} == {
        command.name: command.summary for command in COMMANDS
    }
    assert next(iter(lines)) == "run"
    assert max(map(len, lines.values())) <= 80


def test_a_command_alone_shows_its_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(build_app([]), []) == 2
    told = capsys.readouterr()
    assert "Run a scenario" in told.out
    assert told.err == ""


def failing(error: Exception) -> typer.Typer:
    """A command line whose only command fails."""
    app = typer.Typer(add_completion=False)

    @app.command()
    def fail(log_format: str = "text") -> None:
        raise error

    return app


def test_a_bug_is_one_line_with_its_traceback_in_a_file(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert run_app(failing(ZeroDivisionError("by \udce9")), []) == 70
    (file,) = tmp_path.iterdir()
    assert capsys.readouterr().err == (
        f"vnet: a bug in vnet: ZeroDivisionError: by \\udce9; please report it with its traceback, {file}\n"
    )
    assert "raise error\nZeroDivisionError: by \\udce9" in file.read_text()


@pytest.mark.parametrize(("folder", "arguments"), [("b\udce9", []), (".", ["--log-format", "b\udce9"])])
def test_names_that_are_not_utf8_are_refused(
    folder: str,
    arguments: list[str],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / folder).mkdir(exist_ok=True)
    monkeypatch.chdir(tmp_path / folder)
    assert run_app(failing(ZeroDivisionError()), arguments) == 2
    assert capsys.readouterr().err.endswith("b\\udce9: not UTF-8, as paths must be; rename it\n")


def test_what_the_system_refuses_is_no_bug(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(failing(OSError(errno.ENOSPC, "No space left on device", "runs/a")), []) == 2
    assert capsys.readouterr().err == "vnet: runs/a: No space left on device\n"


def test_an_interrupt_that_an_import_hides_is_one(capsys: pytest.CaptureFixture[str]) -> None:
    hidden = ImportError("initialization failed")
    hidden.__cause__ = KeyboardInterrupt()
    assert run_app(failing(hidden), []) == 130
    assert capsys.readouterr().err == ""


def test_what_may_change_or_go_in_any_version_is_marked_in_help_and_reference() -> None:
    marked = {path for path, command in ALL.items() if "(experimental)" in str(command.help)}
    marked |= {
        f"{path} {option.opts[0]}"
        for path, command in ALL.items()
        for option in command.params
        if "(experimental)" in (getattr(option, "help", None) or "")
    }
    assert marked == {"vnet host", "vnet run --hosts", "vnet emulator --hosts", "vnet access --hosts"}
    assert "(experimental)" in str(environment.__doc__).splitlines()[0]
