"""The tutorial's program is what it says: the page's own code runs on ten vehicles."""

import re
from pathlib import Path

import pytest

from emulator.observe.run_folder import RunFolder
from emulator.run.conclude import conclude
from emulator.run.emulation import Emulation
from emulator.run.simulate import simulate
from emulator.world.world import build_world
from vnet.scenario import load_scenario

ROOT = Path(__file__).parents[1]


def blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "tutorial.md").read_text(), re.DOTALL)


def run(code: str, entry: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict:
    (tmp_path / f"{entry}.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    overrides = [f'program.entry="{entry}:main"']
    scenario = load_scenario(ROOT / "scenarios" / "beacon.toml", overrides)
    emulation = Emulation(scenario, build_world(scenario), RunFolder.create(tmp_path / "run", scenario))
    wall_s, _ = simulate(emulation)
    return conclude(emulation, wall_s, "simulate")[1]


def test_the_last_program_runs_on_ten_vehicles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    verdict = run(blocks()[-1], "tutorial_last", tmp_path, monkeypatch)
    assert verdict["verdict"] == "valid"
    assert verdict["vehicles"] == 10
    texts = {check["name"]: check["text"] for check in verdict["checks"]}
    page = (ROOT / "docs" / "tutorial.md").read_text()
    for name in ("conservation", "loss_rate", "agents_alive"):
        assert texts[name] in page, "the page shows what the program does"


def test_the_first_program_sends_nothing_and_is_unknown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(blocks()[0], "tutorial_first", tmp_path, monkeypatch)["verdict"] == "unknown"


def test_the_beacon_is_small() -> None:
    assert len((ROOT / "agents" / "beacon.py").read_text().splitlines()) <= 42
