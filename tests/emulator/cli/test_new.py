"""`vnet new`: what it writes works as it is, and nothing that exists is overwritten."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from emulator.cli.commands import app

runner = CliRunner()


def new(name: Path | str) -> tuple[int, str]:
    done = runner.invoke(app, ["new", str(name)])
    return done.exit_code, " ".join(done.output.split())


def test_it_writes_a_scenario_a_program_a_check_and_a_test(tmp_path: Path) -> None:
    """tests/system/test_wheel.py runs them."""
    assert new(tmp_path / "mynet")[0] == 0
    names = sorted(path.name for path in (tmp_path / "mynet").iterdir())
    assert names == ["README.md", "mynet.py", "mynet.toml", "mynet_check.py", "test_mynet.py"]


def test_a_folder_that_holds_something_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mynet").mkdir()
    (tmp_path / "mynet" / "mynet.py").write_text("mine")
    status, output = new(tmp_path / "mynet")
    assert status == 2 and "exists and is not an empty folder" in output
    assert (tmp_path / "mynet" / "mynet.py").read_text() == "mine"


@pytest.mark.parametrize("name", ["my-net", "7net", "class", "test_net", "net_check", "mün"])
def test_a_name_that_no_module_may_have_is_refused(tmp_path: Path, name: str) -> None:
    status, output = new(tmp_path / name)
    assert status == 2 and f"{name}: no name for a program" in output
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize("name", ["random", "numpy", "vnet", "sys"])
def test_a_name_that_would_hide_a_module_is_refused(tmp_path: Path, name: str) -> None:
    status, output = new(tmp_path / name)
    assert status == 2 and f"{name}: Python has a module of this name" in output
    assert not (tmp_path / name).exists()
