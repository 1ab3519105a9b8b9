"""Roadside units in a scenario: names, programs, and what is refused."""

from pathlib import Path

from emulator.scenario.loading import dump_scenario, load_scenario


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
