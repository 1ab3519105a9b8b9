"""SUMO stepped with a run of real processes, with a stand-in for libsumo: the same as simulated."""

from pathlib import Path

import pytest
import tomli_w

from tests.support.sumo import install_fake, write_scenario
from tests.system.conftest import Vnet


def test_processes_drive_in_sumo_as_their_simulation_does(
    vnet: Vnet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install_fake(tmp_path / "packages", monkeypatch)
    program = {"entry": "tests.support.driving_programs:brakes_and_releases"}
    sumo = {"lights_to": ["late"]}
    data = write_scenario(tmp_path, network={"sumo": sumo}, program=program, world={"ranging": {}})
    path = tmp_path / "town.toml"
    path.write_text(tomli_w.dumps(data))
    live = vnet("run", str(path))
    simulated = vnet("simulate", str(path))
    assert live.status == simulated.status == 0, live.stderr + simulated.stderr
    assert live.fingerprint == simulated.fingerprint
    assert (live.folder / "driven.parquet").read_bytes() == (simulated.folder / "driven.parquet").read_bytes()


def test_a_sumo_that_dies_ends_the_processes(vnet: Vnet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_fake(tmp_path / "packages", monkeypatch)
    program = {"entry": "tests.support.driving_programs:brakes_and_releases"}
    data = write_scenario(tmp_path, {"dies": 1.0}, network={"sumo": {"nodes": ["behind"]}}, program=program)
    path = tmp_path / "town.toml"
    path.write_text(tomli_w.dumps(data))
    live = vnet("run", str(path))
    assert live.status == 2
    assert "town.sumocfg: SUMO: it was ended by signal 6" in live.stderr
    assert "Traceback" not in live.stderr
