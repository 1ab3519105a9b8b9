"""SUMO drives: it is asked for the run's time, with the scenario's seed; what it drives, or says, is taken."""

import json
import sys
from pathlib import Path

import pytest

from emulator.scenario.loading import load_scenario
from emulator.scenario.network import input_files, read_begin_s
from emulator.scenario.scenario import Scenario
from emulator.world.world import build_world
from tests.emulator.world.trips.test_files import FCD
from vnet.errors import ScenarioError

CONFIGURATION = """<?xml version="1.0"?>
<sumoConfiguration>
    <input><net-file value="a.net.xml"/><route-files value="a.rou.xml, b.rou.xml,none.xml"/></input>
    <output><fcd-output value="fcd.xml"/></output>
    <time><begin value="0"/></time>
</sumoConfiguration>
"""
FAKE = """#!{python}
import json, pathlib, sys
here = pathlib.Path(__file__).parent
(here / "asked.json").write_text(json.dumps(sys.argv[1:]))
answer = json.loads((here / "answer.json").read_text())
print(answer["says"], file=sys.stderr)
if answer["drives"] is not None:
    pathlib.Path(sys.argv[sys.argv.index("--fcd-output") + 1]).write_text(answer["drives"])
sys.exit(answer["status"])
"""


@pytest.fixture
def sumo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program in place of SUMO, in a folder of its own, that drives two vehicles."""
    folder = tmp_path / "bin"
    folder.mkdir()
    program = folder / "sumo"
    program.write_text(FAKE.format(python=sys.executable))
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder))
    answer(folder, drives=FCD)
    return folder


def answer(folder: Path, drives: str | None = None, says: str = "", status: int = 0) -> None:
    (folder / "answer.json").write_text(json.dumps({"drives": drives, "says": says, "status": status}))


def write(folder: Path, configuration: str = CONFIGURATION, more: str = "") -> Path:
    (folder / "town.sumocfg").write_text(configuration)
    for name in ("a.net.xml", "a.rou.xml", "b.rou.xml"):
        (folder / name).write_text(f"<{name}/>")
    path = folder / "town.toml"
    path.write_text(f"[run]\nduration_s = 2.0\n[network]\nkind = 'sumo'\npath = 'town.sumocfg'\nseed = 7\n{more}")
    return path


def load(folder: Path, more: str = "") -> Scenario:
    return load_scenario(write(folder, more=more))


def asked(folder: Path, option: str) -> str:
    arguments: list[str] = json.loads((folder / "asked.json").read_text())
    return arguments[arguments.index(option) + 1]


@pytest.mark.slow
def test_vehicles_are_where_sumo_drove_them(tmp_path: Path, sumo: Path) -> None:
    world = build_world(load(tmp_path))
    assert world.node_ids == ("a", "b")
    assert world.at(5).position_m[0] == pytest.approx([5, 0])
    assert world.at(15).position_m[1] == pytest.approx([0, 40])
    assert asked(sumo, "--seed") == "7" and float(asked(sumo, "--end")) == pytest.approx(2.0, abs=0.2)
    assert asked(sumo, "-c") == str(tmp_path / "town.sumocfg")
    assert world.moves and not world.present(12)[0] and world.present(12)[1]


@pytest.mark.slow
def test_what_sumo_writes_can_be_read_whatever_the_configuration_says(tmp_path: Path, sumo: Path) -> None:
    """Options that are in the configuration alone are set back: old versions of SUMO do not have them."""
    build_world(load(tmp_path))
    assert asked(sumo, "--fcd-output.attributes") == "x,y,angle,speed" and asked(sumo, "--output-prefix") == ""
    with pytest.raises(ValueError, match=r"fcd-output\.utm"):
        asked(sumo, "--fcd-output.utm")
    named = CONFIGURATION.replace("<time>", '<fcd-output.utm value="true"/><time>')
    build_world(load_scenario(write(tmp_path, named)))
    assert asked(sumo, "--fcd-output.utm") == "false"


@pytest.mark.parametrize(
    ("text", "begin_s"), [("25200", 25200.0), ("07:00:00", 25200.0), ("1:00:00:30", 86430.0), ("12.5", 12.5)]
)
def test_the_run_begins_where_the_configuration_does(tmp_path: Path, text: str, begin_s: float) -> None:
    write(tmp_path, CONFIGURATION.replace('begin value="0"', f'begin value="{text}"'))
    assert read_begin_s(tmp_path / "town.sumocfg") == begin_s


@pytest.mark.slow
def test_or_where_the_scenario_says(tmp_path: Path, sumo: Path) -> None:
    world = build_world(load(tmp_path, "start_s = 1.0"))
    assert float(asked(sumo, "--end")) == pytest.approx(3.0, abs=0.2)
    assert world.at(0).position_m[world.node_ids.index("b")] == pytest.approx([0, 50])


def test_what_sumo_reads_belongs_to_the_run(tmp_path: Path, sumo: Path) -> None:
    load(tmp_path)
    names = [path.name for path in input_files(tmp_path / "town.sumocfg")]
    assert names == ["a.net.xml", "a.rou.xml", "b.rou.xml"], "what it writes, or is not there, does not"
    short = {"net-file": "n", "route-files": "routes", 'begin value="0"': 'b value="3"'}
    configuration = CONFIGURATION
    for name, other in short.items():
        configuration = configuration.replace(name, other)
    write(tmp_path, configuration)
    assert [path.name for path in input_files(tmp_path / "town.sumocfg")] == names
    assert read_begin_s(tmp_path / "town.sumocfg") == 3.0
    path = write(tmp_path)
    inputs = '[inputs]\n"{}" = "another"\n'.format(tmp_path / "b.rou.xml")
    path.write_text(path.read_text() + inputs)
    with pytest.raises(ScenarioError, match=r"b\.rou\.xml has changed since this run was recorded"):
        load_scenario(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("drives", "says", "status", "named"),
    [
        (
            None,
            "Loading\nError: No such file 'a.net.xml'.\nQuitting (on error).",
            1,
            "status 1): Error: No such file",
        ),
        (None, "", 0, "SUMO failed (exit status 0)"),
        (FCD[:300], "", 0, "output of SUMO: "),
        ("<fcd-export/>", "", 0, "no samples"),
    ],
)
def test_what_sumo_cannot_do_is_said_in_one_line(
    tmp_path: Path, sumo: Path, drives: str | None, says: str, status: int, named: str
) -> None:
    answer(sumo, drives, says, status)
    with pytest.raises(ScenarioError) as caught:
        build_world(load(tmp_path))
    assert named in str(caught.value) and "\n" not in str(caught.value)


def test_without_sumo_it_is_said_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("SUMO_HOME", raising=False)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    with pytest.raises(ScenarioError, match="SUMO is not installed: pip install"):
        build_world(load(tmp_path))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "not a SUMO configuration"),
        ("<routes/>", "line 1: element 'routes'"),
        ("<!DOCTYPE a>\n<configuration/>", "line 1: a document type"),
        (CONFIGURATION.replace('begin value="0"', 'begin value="dawn"'), "begin = 'dawn'"),
        (CONFIGURATION.replace("</input>", ""), "not a SUMO configuration: mismatched tag"),
    ],
)
def test_a_wrong_configuration_is_refused(tmp_path: Path, sumo: Path, text: str, named: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        build_world(load_scenario(write(tmp_path, text)))
    assert named in str(caught.value) and "\n" not in str(caught.value)
