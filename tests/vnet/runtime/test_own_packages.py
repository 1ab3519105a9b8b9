"""A file of a user's that bears the name of one of vnet's packages is named in the one line of the error."""

import colorsys
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT
from vnet.errors import ProgramError
from vnet.runtime.own_packages import foreign_on_path, name_clash
from vnet.runtime.programs import load_program, search_programs_in

PROGRAM = "async def main(node):\n    pass\n"


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("package", ["agents", "emulator"])
def test_a_program_in_a_file_that_vnet_s_own_package_hides(package: str, tmp_path: Path) -> None:
    file = tmp_path / f"{package}.py"
    file.write_text(PROGRAM)
    with pytest.raises(ProgramError) as caught:
        load_program(f"{package}:main")
    assert str(caught.value) == (
        f"program.entry = '{package}:main': module {package} ({ROOT}/{package}/__init__.py) has no 'main'; "
        f"{package} is a package of vnet's own: rename {file}"
    )


@pytest.mark.parametrize(
    ("module", "found"), [("colorsys", "colorsys is found at "), ("time", "time is a module of Python's own")]
)
def test_a_program_in_a_file_that_a_module_of_python_s_hides(module: str, found: str, tmp_path: Path) -> None:
    (tmp_path / f"{module}.py").write_text(PROGRAM)
    with pytest.raises(ProgramError) as caught:
        load_program(f"{module}:main")
    where = "built into Python" if module == "time" else colorsys.__file__
    assert f"module {module} ({where}) has no 'main'" in str(caught.value)
    assert found in str(caught.value)
    assert str(caught.value).endswith(f": rename {tmp_path}/{module}.py")


def test_a_module_that_the_program_imports_and_another_hides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "random.py").touch()
    (tmp_path / "imports_random.py").write_text("from random import my_own\n")
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    with pytest.raises(ProgramError, match=rf"random is found at .*random\.py: rename {tmp_path}/random\.py$"):
        load_program("imports_random:main")


def test_a_module_of_a_package_that_vnet_s_own_hides(tmp_path: Path) -> None:
    (tmp_path / "agents").mkdir()
    (tmp_path / "agents" / "__init__.py").touch()
    (tmp_path / "agents" / "mine.py").write_text(PROGRAM)
    with pytest.raises(ProgramError, match=f"rename {tmp_path}/agents/__init__.py$"):
        load_program("agents.mine:main")


def test_a_program_of_another_folder_with_the_name_of_one_before_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "same_name.py").write_text("async def main(node): ...\n")
    monkeypatch.setattr(sys, "path", [*sys.path])
    search_programs_in([Path("one")])
    load_program("same_name:main")
    search_programs_in([Path("two")])
    with pytest.raises(ProgramError, match=r"same_name is already one/same_name\.py: rename .*two/same_name\.py$"):
        load_program("same_name:main")
    del sys.modules["same_name"]


def test_without_such_a_file_nothing_is_said_of_it(tmp_path: Path) -> None:
    assert name_clash("agents.none", tmp_path) == name_clash("mine", tmp_path) == ""
    (tmp_path / "mine.py").touch()
    assert name_clash("mine.none", tmp_path) == ""
    assert name_clash("agents.none", ROOT) == "", "vnet's own"
    assert load_program("agents.beacon:main") is not None


def test_a_file_that_is_found_in_place_of_vnet_s_own_package(tmp_path: Path) -> None:
    assert foreign_on_path("agents") == ""
    assert foreign_on_path("agents", []) == ""
    (tmp_path / "agents.py").touch()
    (tmp_path / "json.py").touch()
    file = tmp_path / "agents.py"
    assert foreign_on_path("agents", [str(tmp_path)]) == (
        f"agents: found {file}, which is not vnet's package of this name: rename it"
    )
    assert foreign_on_path("json", [str(tmp_path)]) == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("package", "arguments"),
    [
        ("emulator", ["-m", "emulator", "simulate", "beacon.toml"]),
        ("agents", ["-m", "agents.cli", "--connect", "tcp/127.0.0.1:1", "--run", "r", "--node", "v01"]),
    ],
)
def test_a_command_that_would_start_again_as_something_else_says_so(
    package: str, arguments: list[str], tmp_path: Path
) -> None:
    """The command itself was found in the current folder, and the other one lies on the path that follows."""
    file = tmp_path / f"{package}.py"
    file.touch()
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONHASHSEED"}
    environment["PYTHONPATH"] = os.pathsep.join([str(tmp_path), str(ROOT)])
    done = subprocess.run([sys.executable, *arguments], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == f"vnet: {package}: found {file}, which is not vnet's package of this name: rename it\n"
