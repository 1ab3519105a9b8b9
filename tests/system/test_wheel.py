"""vnet without a clone: a wheel is built, installed into an environment of its own, and used in an empty folder."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.paths import ROOT

Command = Callable[..., str]
SEVERAL = """
import json, os, sys
from contextlib import redirect_stdout
from io import StringIO
os.environ["PYTHONHASHSEED"] = "0"  # otherwise a simulation starts the interpreter again
from emulator.cli.application import build_app
from emulator.terminal.console import run_app

app, told = build_app(), []
for line in sys.argv[1:]:
    with redirect_stdout(StringIO()) as printed:
        assert run_app(app, line.split()) == 0, line
    told.append(printed.getvalue())
print(json.dumps(told))
"""
"""Runs command lines of vnet in one interpreter; prints what each prints."""


def clean_environment() -> dict[str, str]:
    """Return the environment without what would lead to the clone."""
    return {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}


def run_pip(*arguments: object) -> None:
    command = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", *map(str, arguments)]
    subprocess.run(command, check=True, env=clean_environment())


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel; its dependencies are those that are installed here.

    A path in a .pth file is searched, but .pth files in it are not read: so nothing leads to the clone.
    """
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("vnet", "agents", "emulator", "scenarios", "docs", "studies"):
        shutil.copytree(ROOT / name, source / name, symlinks=True)  # a build leaves files beside its source
    run_pip("wheel", "--no-deps", "--no-build-isolation", "-w", folder, source)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder / "venv")], check=True)
    python = folder / "venv" / "bin" / "python"
    (wheel,) = folder.glob("*.whl")
    run_pip("--python", python, "install", "--no-deps", "--no-index", "--ignore-installed", "--no-compile", wheel)
    (site,) = (folder / "venv" / "lib").glob("python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    return folder / "venv" / "bin"


@pytest.fixture
def command(environment: Path, tmp_path: Path) -> Command:
    """Run a command of the environment in an empty folder; returns its standard output."""

    def run(*arguments: str, folder: str = ".") -> str:
        words = [str(environment / arguments[0]), *arguments[1:]]
        done = subprocess.run(
            words,
            cwd=tmp_path / folder,
            env=clean_environment(),
            capture_output=True,
            text=True,
            check=False,
            timeout=300,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


def test_it_is_the_wheel_that_runs(command: Command, environment: Path) -> None:
    found = command(
        "python", "-c", "import agents, emulator, vnet; print(agents.__file__, emulator.__file__, vnet.__file__)"
    )
    assert all(Path(name).is_relative_to(environment.parent) for name in found.split())
    assert command("vnet", "--version") == command("vnet-emulator", "--version")


def test_shipped_scenarios_run_by_their_names(command: Command, tmp_path: Path) -> None:
    assert "verdict: valid" in command("vnet", "simulate", "beacon", "--duration", "1", "--quiet", "--no-report")
    command("vnet", "demo", "--duration", "0.1", "--out", "demo")
    assert (tmp_path / "demo" / "recording.rrd").stat().st_size > 0


def test_a_new_project_runs_and_its_tests_pass(command: Command) -> None:
    command("vnet", "new", "mynet")
    assert "verdict: valid" in command("vnet", "simulate", "mynet.toml", "--quiet", folder="mynet")
    assert "2 passed" in command("python", "-m", "pytest", "-p", "no:cacheprovider", folder="mynet")


def test_pages_and_examples_come_with_the_wheel(command: Command, environment: Path) -> None:
    pages = [path for path in (ROOT / "docs").rglob("*.md") if "examples" not in path.parts]
    lines = (
        "docs",
        "docs tutorial",
        "docs --path",
        "new --example platoon",
        "simulate platoon/platoon.toml --duration 6 --quiet --no-report",
    )
    listed, tutorial, path, _, simulated = json.loads(command("python", "-c", SEVERAL, *lines))
    assert len(listed.splitlines()) == len(pages)
    assert tutorial == (ROOT / "docs" / "tutorial.md").read_text()
    assert Path(path.strip()).is_relative_to(environment.parent)
    assert "verdict: valid" in simulated


def test_the_wheel_has_no_studies_and_says_in_one_line_where_they_are(environment: Path, tmp_path: Path) -> None:
    """The entry point of the clone's installation is in sight here, as after a clone was removed."""
    with zipfile.ZipFile(next(environment.parents[1].glob("*.whl"))) as wheel:
        packages = {name.split("/")[0] for name in wheel.namelist()}
    assert sorted(name for name in packages if not name.endswith(".dist-info")) == ["agents", "emulator", "vnet"]
    for arguments in (["table1", "--seeds", "1"], ["--help"], []):
        words = [str(environment / "vnet"), "experiment", *arguments]
        done = subprocess.run(words, cwd=tmp_path, env=clean_environment(), capture_output=True, text=True)
        assert (done.returncode, done.stdout) == (2, "")
        (line,) = done.stderr.splitlines()
        assert "`pip install -e ./studies`" in line
