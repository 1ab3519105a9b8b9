"""Scenario files: what is wrong is said in one line that names file, key, value and what is allowed."""

from pathlib import Path

import pytest

from vnet.errors import ScenarioError
from vnet.scenario import Scenario, dump_scenario, load_scenario

ROOT = Path(__file__).parents[1]
CSV = "id,x_m,y_m,heading_rad\na,0,0,0\n"


def write(folder: Path, text: str) -> Path:
    path = folder / "s.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("[radio]\nlos = 0.1", ["radio.los", "unknown key", "loss", "max_peers"]),
        ("[radoi]\nloss = 0.1", ["radoi", "unknown key", "radio"]),
        ("[world.gnss]\nrate = 1", ["world.gnss.rate", "unknown key", "rate_hz"]),
        ("[radio]\nloss = 2", ["radio.loss = 2", "less than or equal to 1"]),
        ("[radio]\nloss = nan", ["radio.loss = nan", "finite"]),
        ("[radio]\nloss = 'much'", ["radio.loss = 'much'", "number"]),
        ("[run]\npacing = 'fast'", ["run.pacing = 'fast'", "'lockstep' or 'realtime'"]),
        ("[run]\nname = 'a/b'", ["run.name = 'a/b'", "pattern"]),
        ("[network]\nkind = 'file'", ["network", "path is required"]),
        ("[network]\nkind = 'file'\npath = 'no.csv'", ["network.path = 'no.csv'", "no such file"]),
        ("radio = 3", ["radio = 3"]),
        ("[radio", ["not valid TOML"]),
        ("[program]\nentry = 'beacon'", ["program.entry = 'beacon'", "package.module:function"]),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path: Path, text: str, parts: list[str]) -> None:
    path = write(tmp_path, text)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(path))
    assert all(part in message for part in parts), message


def test_a_missing_scenario_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"no\.toml: cannot be read: No such file"):
        load_scenario(tmp_path / "no.toml")


def test_overrides_win_and_bare_words_are_strings(tmp_path: Path) -> None:
    path = write(tmp_path, "[radio]\nloss = 0.1")
    scenario = load_scenario(path, ["radio.loss=0.3", "program.options.fusion=random", "run.seed=7"])
    assert scenario.radio.loss == 0.3
    assert scenario.program.options == {"fusion": "random"}
    assert scenario.run.seed == 7


@pytest.mark.parametrize("override", ["radio", "radio.loss", "loss=3", ".x=1", "radio.loss.x=1"])
def test_a_wrong_override_says_how_it_is_written(tmp_path: Path, override: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(write(tmp_path, "[radio]\nloss = 0.1"), [override])
    assert override in str(caught.value)


def test_a_dumped_scenario_is_the_same_scenario(tmp_path: Path) -> None:
    (tmp_path / "n.csv").write_text(CSV)
    original = load_scenario(write(tmp_path, "[network]\nkind = 'file'\npath = 'n.csv'\n[radio]\nloss = 0.123"))
    again = tmp_path / "elsewhere.toml"
    again.write_text(dump_scenario(original))
    assert load_scenario(again) == original


def test_a_changed_input_file_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "n.csv").write_text(CSV)
    original = load_scenario(write(tmp_path, "[network]\nkind = 'file'\npath = 'n.csv'"))
    recorded = tmp_path / "recorded.toml"
    recorded.write_text(dump_scenario(original))
    (tmp_path / "n.csv").write_text(CSV.replace("0,0,0", "0,1,0"))
    with pytest.raises(ScenarioError, match=r"n\.csv has changed"):
        load_scenario(recorded)


def test_an_empty_file_is_a_valid_scenario(tmp_path: Path) -> None:
    assert load_scenario(write(tmp_path, "")) == Scenario()


@pytest.mark.parametrize("path", sorted((ROOT / "scenarios").glob("*.toml")), ids=lambda path: path.stem)
def test_every_scenario_that_is_shipped_loads(path: Path) -> None:
    assert load_scenario(path).run.name == path.stem
