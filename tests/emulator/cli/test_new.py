"""`vnet new` and `vnet docs`: what is written works as it is, and nothing that exists is overwritten."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from emulator.cli.new import examples
from emulator.scenario.loading import load_scenario
from tests.support.command_line import app
from tests.support.paths import ROOT

pytestmark = pytest.mark.slow

runner = CliRunner()


def new(*words: Path | str) -> tuple[int, str]:
    done = runner.invoke(app, ["new", *map(str, words)])
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


@pytest.mark.parametrize("example", examples())
def test_an_example_is_copied_so_that_it_stands_alone(example: str, tmp_path: Path) -> None:
    assert new(tmp_path / "mine", "--example", example)[0] == 0
    source = ROOT / "docs" / "examples" / example
    copied = {path.name: path.read_text() for path in (tmp_path / "mine").iterdir()}
    assert copied.keys() == {path.name for path in source.iterdir() if path.is_file()} - {"__init__.py"}
    assert not any(place in text for text in copied.values() for place in ("docs.examples", "docs/examples"))
    if example != "sumo_loop":  # reads the version of libsumo
        for scenario in (tmp_path / "mine").glob("*.toml"):
            program = load_scenario(scenario).program
            assert program.folders == (() if program.entry.startswith("agents.") else (tmp_path / "mine",))


def test_all_pages_are_listed_and_printed_as_they_are() -> None:
    listed = [line.split()[0] for line in runner.invoke(app, ["docs"]).output.splitlines()]
    pages = [path for path in (ROOT / "docs").rglob("*.md") if "examples" not in path.parts]
    assert sorted(listed) == sorted(str(path.relative_to(ROOT / "docs").with_suffix("")) for path in pages)
    for name in ("how-to/debugging", "debugging", "docs/how-to/debugging.md"):
        assert runner.invoke(app, ["docs", name]).output == (ROOT / "docs" / "how-to" / "debugging.md").read_text()
    assert Path(runner.invoke(app, ["docs", "--path"]).output.strip()) == ROOT / "docs"


def test_a_name_that_is_not_ascii_is_refused_with_what_is_allowed(tmp_path: Path) -> None:
    status, output = new(tmp_path / "ünï")[:2]
    assert status == 2 and "ASCII letters, digits and _" in output
