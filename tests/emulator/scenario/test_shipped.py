"""Shipped scenarios: found by name, after any file of that name, from a clone and from a wheel alike."""

import tomllib
from pathlib import Path

import pytest

from emulator.scenario.loading import find_scenario, load_scenario, recorded_code, shipped_names
from tests.support.paths import ROOT
from vnet.errors import ScenarioError


def test_every_scenario_of_the_repository_is_shipped_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names = sorted(path.stem for path in (ROOT / "scenarios").glob("*.toml"))
    assert shipped_names() == names and "twelve" in names
    for name in names:
        assert load_scenario(Path(name)) == load_scenario(ROOT / "scenarios" / f"{name}.toml")


def test_the_shipped_scenarios_are_data_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "scenarios/*.toml" in project["tool"]["setuptools"]["package-data"]["emulator"]


def test_a_path_that_exists_wins_over_a_shipped_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("twelve").write_text("[run]\nname = 'mine'\n[code]\nentries = 'mine:main'\n")
    assert load_scenario(Path("twelve")).run.name == "mine"
    assert recorded_code(Path("twelve")) == {"entries": "mine:main"}


def test_a_name_that_is_neither_a_path_nor_shipped_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_scenario("twelv") == Path("twelv")
    with pytest.raises(ScenarioError, match=r"^twelv: cannot be read: .* \(did you mean twelve\?\)$"):
        load_scenario(Path("twelv"))
    with pytest.raises(ScenarioError):
        load_scenario(Path("x" * 5000))
