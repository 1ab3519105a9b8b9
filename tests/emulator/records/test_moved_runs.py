"""A finished run is complete in its folder: moved to where none of its inputs is, it reads the same."""

import ast
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from emulator.checks.judge import check_run
from emulator.records import run_folder
from emulator.records.recorded_run import RecordedRun
from emulator.records.tables import TABLES
from emulator.scenario.loading import load_scenario
from emulator.scenario.scenario import Scenario
from emulator.stream import messages
from tests.emulator.checks.test_judge import run_scenario
from tests.emulator.scenario.test_sumo import load as sumo_scenario
from tests.emulator.scenario.test_sumo import sumo
from tests.emulator.world.maps.test_city_map import driving
from tests.support.folders import READERS, readings, rendered
from tests.support.paths import ROOT
from vnet.errors import ScenarioError, VnetError

__all__ = ["sumo"]  # a fixture

NETWORK = "id,x_m,y_m,heading_rad\n" + "".join(f"v{n},{400 * n},0,0\n" for n in range(5))
LINKS = "0,1,0,0,1\n1,0,1,0,0\n0,1,0,1,0\n0,0,1,0,1\n1,0,0,1,0\n"
PROGRAM = """
from moved_helper import NAME

async def main(node):
    async for fix in node.gnss:
        await node.radio.broadcast(NAME)
        node.report(fix.position_m, fix.covariance_m2, common_error_m=[0.5, 0.5], heard=len(node.radio.drain()))
"""
FAULTS = [
    {"kind": "kill", "at_s": 0.4, "duration_s": 0.5, "nodes": {"count": 1}},
    {"kind": "loss", "at_s": 0.3, "duration_s": 0.8, "probability": 0.5},
    {"kind": "gnss_jump", "at_s": 0.6, "duration_s": 0.5, "nodes": {"degree": [1, 4]}, "offset_m": [30.0, -5.0]},
]


@pytest.fixture
def inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of input files from which programs can be imported; what they leave in this process is removed."""
    folder = tmp_path / "inputs"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    yield folder
    for name in ("moved_program", "moved_helper"):
        sys.modules.pop(name, None)


def with_files(folder: Path) -> Scenario:
    """A run with a network, a matrix of links, a program of two modules, and faults."""
    (folder / "network.csv").write_text(NETWORK)
    (folder / "links.csv").write_text(LINKS)
    (folder / "moved_program.py").write_text(PROGRAM)
    (folder / "moved_helper.py").write_text("NAME = b'twelve bytes'\n")
    return Scenario.model_validate(
        {
            "run": {"duration_s": 2.0, "settle_s": 0.5, "name": "moved"},
            "network": {"kind": "file", "path": str(folder / "network.csv")},
            "radio": {"links": str(folder / "links.csv"), "loss": 0.1},
            "program": {"entry": "moved_program:main"},
            "fault": FAULTS,
        }
    )


def on_roads(folder: Path) -> Scenario:
    """A run with trips and a map, whose vehicles share a medium."""
    scenario = driving(folder, "agents.beacon:main", 3.0)
    data = scenario.model_dump(mode="json", exclude_none=True)
    return Scenario.model_validate(
        {**data, "radio": {"path_loss": {"kind": "log_distance"}, "fading": {}, "mac": {}}}
    )


@pytest.mark.slow
@pytest.mark.parametrize("make", [with_files, on_roads])
def test_a_moved_run_reads_the_same_without_its_inputs(
    make: object, inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert callable(make)
    scenario = make(inputs)
    run, other = tmp_path / "run", tmp_path / "other"
    run_scenario(run, scenario)
    run_scenario(other, scenario.model_copy(update={"run": scenario.run.model_copy(update={"seed": 2})}))
    before = {**readings(run, other, tmp_path / "scratch"), "render": rendered(run)}
    moved = take_away(run, inputs, tmp_path)
    shutil.move(other, moved.parent / "other")
    after = readings(moved, moved.parent / "other", tmp_path / "scratch")
    after = {name: _renamed(read, other, moved.parent / "other") for name, read in after.items()}
    monkeypatch.setenv("RERUN_FLUSH_NUM_ROWS", "1")  # as on a slow machine: Rerun writes each row by itself
    after["render"] = rendered(moved)
    assert before.keys() == after.keys() == {*READERS, "render"}
    assert [name for name in before if before[name] != after[name]] == []
    assert len(before["play"]) > 10_000 and "invalid" not in before["check"]


def _renamed(read: str | bytes, old: Path, new: Path) -> str | bytes:
    return read.replace(str(new), str(old)) if isinstance(read, str) else read


def take_away(run: Path, inputs: Path, tmp_path: Path) -> Path:
    """Move a run, and delete what it was made from, in this process, too."""
    moved = tmp_path / "elsewhere" / "run"
    moved.parent.mkdir()
    shutil.move(run, moved)
    shutil.rmtree(inputs)
    for name in ("moved_program", "moved_helper"):
        sys.modules.pop(name, None)
    return moved


@pytest.mark.slow
def test_a_run_of_sumo_reads_the_same_where_sumo_is_not_installed(
    tmp_path: Path, sumo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    run_scenario(run, sumo_scenario(tmp_path))
    before = readings(run, run, tmp_path / "scratch")
    for name in ("town.sumocfg", "a.net.xml", "a.rou.xml", "b.rou.xml"):
        (tmp_path / name).unlink()
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    shutil.rmtree(sumo)
    after = readings(run, run, tmp_path / "scratch")
    assert [name for name in before if before[name] != after[name]] == []


@pytest.mark.slow
def test_running_it_again_without_an_input_names_it(inputs: Path, tmp_path: Path) -> None:
    run_scenario(tmp_path / "run", with_files(inputs))
    (inputs / "links.csv").write_text(LINKS.replace("1", "0", 1))
    with pytest.raises(ScenarioError, match=r"links\.csv has changed since this run was recorded"):
        load_scenario(tmp_path / "run" / "scenario.toml")
    (inputs / "links.csv").unlink()
    with pytest.raises(ScenarioError, match=r"radio\.links = '.*links\.csv': no such file"):
        load_scenario(tmp_path / "run" / "scenario.toml")


def test_an_input_that_changes_during_a_run_is_recorded_as_it_was_read(inputs: Path, tmp_path: Path) -> None:
    folder = run_folder.RunFolder.create(tmp_path / "run", with_files(inputs))
    before = folder.scenario_text
    (inputs / "links.csv").write_text("")
    folder.put_scenario(RecordedRun.open(folder.path).scenario)
    assert folder.scenario_text == before == folder.scenario_path.read_text()


# Damage, and folders of other versions.


def with_short_receivers(path: Path) -> None:
    """Give a world receivers of one period."""
    arrays = dict(np.load(path)) | {"receiver_m": np.zeros((1, 1, 2))}
    np.savez_compressed(path, allow_pickle=False, **arrays)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda path: path.unlink(), r"no world\.npz in it"),
        (lambda path: path.write_bytes(path.read_bytes()[:200]), r"world\.npz: not an NPZ file"),
        (lambda path: path.write_bytes(b""), r"world\.npz: not an NPZ file"),
        (with_short_receivers, r"world\.npz: receiver_m has the shape \(1, 1, 2\) in \d+ periods"),
    ],
)
def test_a_world_that_cannot_be_read_is_told_in_one_line(
    damage: object, says: str, inputs: Path, tmp_path: Path
) -> None:
    assert callable(damage)
    run_scenario(tmp_path / "run", with_files(inputs))
    damage(tmp_path / "run" / "world.npz")
    with pytest.raises(VnetError, match=says) as refused:
        check_run(tmp_path / "run")
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_a_folder_of_a_later_format_is_refused(inputs: Path, tmp_path: Path) -> None:
    run_scenario(tmp_path / "run", with_files(inputs))
    path = tmp_path / "run" / "verdict.json"
    path.write_text(path.read_text().replace('"format": 5', '"format": 6', 1))
    run = RecordedRun.open(tmp_path / "run")
    for read in (lambda: check_run(run.folder), lambda: list(messages(run.folder)), lambda: run.states):
        with pytest.raises(VnetError, match=r"format 6, of vnet [\w.]+; this vnet reads 1 to 5"):
            read()


# Who opens the files.


NAMES = {getattr(run_folder, name) for name in dir(run_folder) if name.endswith("_FILE")}
NAMES |= {table.file for table in TABLES}
READ = ("read_table", "ParquetFile", "read_schema")
ELSEWHERE = {"emulator/cells/cells.py", "emulator/world/trips/drive.py"}
"""Modules that read Parquet files, and none of a run's folder."""


def strings(tree: ast.Module) -> set[str]:
    return {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}


def readers(tree: ast.Module) -> set[str]:
    return {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute) and n.attr in READ}


@pytest.mark.slow
def test_only_records_opens_the_files_of_a_folder() -> None:
    paths = [*(ROOT / "emulator").rglob("*.py")]
    outside = [path for path in paths if path.parent != ROOT / "emulator" / "records"]
    assert len(NAMES) == 14 and len(outside) > 100
    found = {}
    for path in outside:
        text, name = path.read_text(), str(path.relative_to(ROOT))
        if not any(word in text for word in (*NAMES, *READ)):
            continue
        tree = ast.parse(text)
        if (named := strings(tree) & NAMES) or (readers(tree) and name not in ELSEWHERE):
            found[name] = named
    assert found == {}
