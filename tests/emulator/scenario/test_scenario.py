"""Scenario files: what is wrong is said in one line that names file, key, value and what is allowed."""

import math
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel

from emulator.scenario.loading import dump_scenario, input_digests, load_scenario
from emulator.scenario.network import Map
from emulator.scenario.scenario import Scenario
from vnet import extras
from vnet.errors import ScenarioError, did_you_mean

CSV = "id,x_m,y_m,heading_rad\na,0,0,0\n"


def write(folder: Path, text: str) -> Path:
    path = folder / "s.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("[radio", ["not valid TOML"]),
        ("[radio]\nloss = 0.1\nloss = much\n", ["not valid TOML", "line 3"]),
        ("[run]\nseed = " + "9" * 5000, ["not valid TOML"]),
        ("[run]\nseed = 0x" + "f" * 5000, ["run.seed = (int)", "64 bits"]),
        ('[program]\nkind = "zenoh"\ncommand = ["a", "{car}"]', ["program.command", "{car} is none of {id}"]),
        ("[program.options]\na = " + "[" * 1000, ["not valid TOML", "nested more than 32 deep"]),
        ("a" + ".a" * 100_000 + " = 1", ["not valid TOML", "a key of more than 32 parts"]),
        ("[radio]\nlinks = '" + "a" * 5000 + "'", ["radio.links = 'aaa", "cannot be the name of a file"]),
        ("#" * (4 * 2**20 + 1), ["not valid TOML", "larger than"]),
    ],
)
def test_what_is_no_toml_or_much_too_large_is_one_line(tmp_path: Path, text: str, parts: list[str]) -> None:
    path = write(tmp_path, text)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(path))
    assert all(part in message for part in parts), message


def test_overrides_win_the_last_of_two_and_bare_words_are_strings(tmp_path: Path) -> None:
    path = write(tmp_path, "[radio]\nloss = 0.1")
    scenario = load_scenario(path, ["radio.loss=.3", "program.options.fusion=random", "run.seed=2", "run.seed=7"])
    assert scenario.radio.loss == 0.3
    assert scenario.program.options == {"fusion": "random"}
    assert scenario.run.seed == 7


@pytest.mark.parametrize("folder", [True, False])
def test_bytes_that_are_no_scenario_are_one_line(tmp_path: Path, folder: bool) -> None:
    path = tmp_path / "s.toml"
    path.mkdir() if folder else path.write_bytes(b"\xff\xfe")
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    assert str(caught.value).startswith(f"{path}: {'cannot be read' if folder else 'not valid TOML'}")


def test_a_dumped_scenario_is_the_same_scenario(tmp_path: Path) -> None:
    (tmp_path / "n.csv").write_text(CSV)
    original = load_scenario(write(tmp_path, "[network]\nkind = 'file'\npath = 'n.csv'\n[radio]\nloss = 0.123"))
    again = tmp_path / "elsewhere.toml"
    again.write_text(dump_scenario(original))
    assert load_scenario(again) == original


def keys(section: BaseModel, prefix: str = "") -> list[str]:
    """Every key of a scenario, as it stands after --set; those that have no default are left out."""
    found: list[str] = []
    for name in type(section).model_fields:
        value = getattr(section, name)
        inner = keys(value, f"{prefix}{name}.") if isinstance(value, BaseModel) else [f"{prefix}{name}"]
        found += inner if value is not None else []
    return found


def test_a_dump_spells_out_every_default(tmp_path: Path) -> None:
    dumped = tomllib.loads(dump_scenario(Scenario()))
    for key in keys(Scenario()):
        value = dumped
        for part in key.split("."):
            assert part in value, key
            value = value[part]


OPTIONS = st.recursive(
    st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**63 - 1),
    loss=st.floats(0, 1),
    duration_s=st.floats(1e-9, 86_400),
    layout=st.sampled_from(["urban", "dense"]),
    options=st.dictionaries(st.text(), OPTIONS, max_size=4),
)
def test_any_scenario_survives_its_dump(
    tmp_path_factory: Any, seed: int, loss: float, duration_s: float, layout: str, options: dict[str, object]
) -> None:
    run, program = {"seed": seed, "duration_s": duration_s}, {"options": options}
    sections = {"run": run, "network": {"layout": layout}, "radio": {"loss": loss}, "program": program}
    original = Scenario.model_validate(sections)
    path = tmp_path_factory.mktemp("dump") / "s.toml"
    path.write_bytes(dump_scenario(original).encode())
    again = load_scenario(path)
    assert again == original
    assert math.copysign(1, again.radio.loss) == math.copysign(1, loss)


def test_an_input_file_that_has_changed_or_is_gone_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "n.csv").write_text(CSV)
    original = load_scenario(write(tmp_path, "[network]\nkind = 'file'\npath = 'n.csv'"))
    recorded = tmp_path / "recorded.toml"
    recorded.write_text(dump_scenario(original))
    (tmp_path / "n.csv").write_text(CSV.replace("0,0,0", "0,1,0"))
    with pytest.raises(ScenarioError, match=r"n\.csv has changed"):
        load_scenario(recorded)
    (tmp_path / "n.csv").unlink()
    with pytest.raises(ScenarioError, match=r"n\.csv'?: no such file"):
        load_scenario(recorded)


def test_a_digest_is_the_sha256_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "n.csv").write_bytes(b"abc")
    scenario = load_scenario(write(tmp_path, "[network]\nkind = 'file'\npath = 'n.csv'"))
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-2's own example
    assert input_digests(scenario) == {str((tmp_path / "n.csv").resolve()): known}


def test_a_network_file_is_looked_for_beside_its_scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "n.csv").write_text(CSV)
    path = write(tmp_path, "[network]\nkind = 'file'\npath = 'n.csv'")
    (tmp_path / "else").mkdir()
    monkeypatch.chdir(tmp_path / "else")
    assert load_scenario(path).network.path == (tmp_path / "n.csv").resolve()


def test_links_of_a_file_are_found_recorded_and_held_to_their_digest(tmp_path: Path) -> None:
    (tmp_path / "n.csv").write_text(CSV)
    links = tmp_path / "links.csv"
    links.write_text("0\n")
    text = "[network]\nkind = 'file'\npath = 'n.csv'\n[radio]\nlinks = 'links.csv'"
    original = load_scenario(write(tmp_path, text))
    assert original.radio.links == links.resolve()
    assert set(input_digests(original)) == {str((tmp_path / name).resolve()) for name in ("n.csv", "links.csv")}
    (tmp_path / "else").mkdir()
    recorded = write(tmp_path / "else", dump_scenario(original))
    assert load_scenario(recorded) == original
    links.write_text("1\n")
    with pytest.raises(ScenarioError, match=r"links\.csv has changed"):
        load_scenario(recorded)


@pytest.mark.parametrize("by", ["file", "override"])
def test_links_written_out_survive_their_dump(tmp_path: Path, by: str) -> None:
    key = "links = [[0, 1], [0, 0]]"
    text, overrides = (f"[radio]\n{key}", []) if by == "file" else ("", [f"radio.{key.replace(' = ', '=')}"])
    original = load_scenario(write(tmp_path, text), overrides)
    assert original.radio.links == ((0, 1), (0, 0))
    assert input_digests(original) == {}
    assert load_scenario(write(tmp_path, dump_scenario(original))) == original


def test_a_long_wrong_value_is_shown_by_its_beginning(tmp_path: Path) -> None:
    links = [[0] * 50 for _ in range(49)]
    with pytest.raises(ScenarioError, match="not square: row 1 of 49") as caught:
        load_scenario(write(tmp_path, f"[radio]\nlinks = {links}"))
    assert len(str(caught.value)) < len(str(tmp_path)) + 250


def test_a_scenario_cannot_be_changed(tmp_path: Path) -> None:
    scenario = load_scenario(write(tmp_path, ""))
    with pytest.raises(ValueError, match="frozen"):
        setattr(scenario.radio, "loss", 1.0)  # noqa: B010 - a type checker refuses the plain assignment


@pytest.mark.parametrize(("rate_hz", "period_ns"), [(10, 100_000_000), (3, 333_333_333), (1000, 1_000_000)])
def test_times_are_whole_nanoseconds(rate_hz: float, period_ns: int) -> None:
    scenario = Scenario.model_validate({"run": {"duration_s": 0.3}, "world": {"gnss": {"rate_hz": rate_hz}}})
    assert scenario.period_ns == period_ns
    assert scenario.duration_ns == 300_000_000


def test_an_empty_file_is_a_valid_scenario(tmp_path: Path) -> None:
    assert load_scenario(write(tmp_path, "")) == Scenario()


def test_some_vehicles_may_run_another_program(tmp_path: Path) -> None:
    text = '[program]\nentry = "a:b"\n[[program.exceptions]]\nnodes = ["v1"]\nentry = "c:d"\noptions = {x = 1}\n'
    program = load_scenario(write(tmp_path, text)).program
    assert (program.of("v1").entry, program.of("v1").options) == ("c:d", {"x": 1})
    assert (program.of("v2").entry, program.of("v2").options) == ("a:b", {})
    with pytest.raises(ScenarioError, match="'v1' is in two exceptions"):
        load_scenario(write(tmp_path, text + '[[program.exceptions]]\nnodes = ["v1"]\nentry = "c:d"\n'))


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("partion", " (did you mean partition?)"),
        ("DOS", " (did you mean DoS?)"),
        ("quake", ""),
        ("", ""),
        ("partition" * 100_000, ""),
        (7, ""),
    ],
)
def test_what_may_have_been_meant(word: object, meant: str) -> None:
    assert did_you_mean(word, ["kill", "partition", "DoS", "range"]) == meant


def test_a_key_with_several_types_is_named_without_them() -> None:
    with pytest.raises(ScenarioError, match=r"network\.driven\.speed_mps = -1: "):
        load_scenario(Path("beacon"), ["network.kind=driven", "network.driven.speed_mps=-1"])


def test_a_file_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text("[network]\nvehicles = 7\n", encoding="utf-8-sig")
    assert load_scenario(path).network.vehicles == 7


@pytest.mark.parametrize(
    ("changes", "library"),
    [
        ({"map": {"path": "town.osm"}}, "osmium and pyproj"),
        ({"network": {"kind": "sumo", "step": True}}, "libsumo"),
    ],
)
def test_missing_extras_of_maps_and_sumo_are_named_before_the_world_is_built(
    changes: dict[str, Any], library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "is_installed", lambda name: False)
    parts = {name: getattr(Scenario(), name) for name in ("network", "map")}
    scenario = Scenario().model_copy(
        update={
            "map": Map(**changes["map"]) if "map" in changes else parts["map"],
            "network": parts["network"].model_copy(update=changes.get("network", {})),
        }
    )
    with pytest.raises(ScenarioError, match=library):
        scenario.require_extras()


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
