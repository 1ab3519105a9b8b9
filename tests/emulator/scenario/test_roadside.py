"""Roadside units in a scenario: names, programs, and what is refused."""

from pathlib import Path

import pytest

from emulator.scenario.loading import dump_scenario, load_scenario
from vnet.errors import ScenarioError


def loaded(tmp_path: Path, text: str) -> str:
    path = tmp_path / "units.toml"
    path.write_text(text)
    return str(path)


def test_two_lines_declare_a_unit_which_runs_the_program_of_vehicles(tmp_path: Path) -> None:
    scenario = load_scenario(Path(loaded(tmp_path, "[[roadside]]\nposition_m = [10, 20]\n")))
    assert [unit.name for unit in scenario.roadside] == ["rsu01"]
    assert scenario.program.of("rsu01").entry == scenario.program.entry


def test_a_program_of_its_own_survives_recording(tmp_path: Path) -> None:
    (tmp_path / "unit.py").write_text("async def main(node): ...\n")
    text = '[[roadside]]\nposition_m = [0, 0]\nid = "gate"\nentry = "unit.py"\noptions = { green_s = 20 }\n'
    scenario = load_scenario(Path(loaded(tmp_path, text + "[[roadside]]\nposition_m = [1, 0]\n")))
    assert [unit.name for unit in scenario.roadside] == ["gate", "rsu02"]
    assert (scenario.program.of("gate").entry, scenario.program.of("gate").options) == (
        "unit:main",
        {"green_s": 20},
    )
    again = load_scenario(Path(loaded(tmp_path, dump_scenario(scenario))))
    assert again.program == scenario.program and dump_scenario(again) == dump_scenario(scenario)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[roadside]]\nid = 'a'\n", "roadside.0.position_m: is missing"),
        ("[[roadside]]\nposition_m = [0, 0]\nid = 'a b'\n", "roadside.0.id = 'a b': must match"),
        ("[[roadside]]\nposition_m = [0, 0]\noptions = {a = 1}\n", "options go with an entry"),
        ("[[roadside]]\nposition_m = [0, 0]\nhight_m = 2\n", "hight_m: unknown key (did you mean height_m?)"),
        ("[[roadside]]\nposition_m = [0, 0]\nentry = 'a'\n", "write it as package.module:function"),
        ("[backbone]\nlatency_ms = 0\n", "backbone.latency_ms = 0: must be greater than or equal to 0.001"),
        (
            "[[roadside]]\nposition_m = [0, 0]\nid = 'a'\n[[roadside]]\nposition_m = [1, 0]\nid = 'a'\n",
            "roadside: another unit is named a",
        ),
        (
            "[[roadside]]\nposition_m = [0, 0]\ntx_power_dbm = 30\n",
            "roadside.0.tx_power_dbm goes with radio.path_loss: without it no radio has a power",
        ),
        (
            "[[roadside]]\nposition_m = [0, 0]\nid = 'a'\nentry = 'm:f'\n"
            "[[program.exceptions]]\nnodes = ['a']\nentry = 'm:g'\n",
            "roadside: a has an entry, and is in program.exceptions",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(Path(loaded(tmp_path, text)))
    assert message in str(caught.value) and "\n" not in str(caught.value)
