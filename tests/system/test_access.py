"""The router's rules: a cheater with valid credentials of its own receives nothing and changes nothing."""

import asyncio
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from emulator.drivers.attachment import LiveOptions
from emulator.drivers.conclude import conclude
from emulator.drivers.live import run_live
from emulator.scenario.loading import load_scenario
from tests.support.paths import ROOT
from tests.support.recorded import prepared
from tests.system.conftest import TIMEOUT_S
from vnet.errors import VnetError
from vnet.transport.access import Access, node_user

NODES = [["v01"], ["v02"], ["v03"], ["v04"]]


class Cheat:
    """Starts the cheater as soon as the router listens, and has it attack until the run is over."""

    def __init__(self, access: Access) -> None:
        self._access = access
        self._process: subprocess.Popen[str] | None = None

    def on_state(self, text: str) -> None:
        endpoint = text.split()[2].rstrip(";")
        command = [sys.executable, "-m", "tests.system.cheater", endpoint, self._access.run]
        self._process = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        own = self._access.credentials(node_user("v05"))
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps([own.user, own.password, node_user("v01")]) + "\n")
        self._process.stdin.flush()
        assert self._process.stdout.readline() == "ready\n"

    def end(self) -> dict[str, Any]:
        assert self._process is not None
        stdout, _ = self._process.communicate("", timeout=TIMEOUT_S)
        return json.loads(stdout)


def run(folder: Path, access: Access, cheat: Cheat | None) -> tuple[dict[str, Any], list[str], Any]:
    """A live run; with what the cheater says of it."""
    overrides = ["network.vehicles=4", "run.duration_s=5"]
    scenario = load_scenario(ROOT / "scenarios" / "beacon.toml", overrides)
    emulation = prepared(scenario, folder)
    said: list[dict[str, Any]] = []
    on_state = cheat.on_state if cheat else (lambda text: None)
    if cheat:
        emulation.watch(lambda view: said.append(cheat.end()) if view.instant.period == 48 else None)
    wall_s, _ = asyncio.run(run_live(emulation, LiveOptions(access), on_state))
    _, verdict = conclude(emulation, wall_s, "run")
    kinds = [event.kind for event in emulation.folder.events]
    return verdict, kinds, said[0] if said else None


def test_a_cheater_with_valid_credentials_gets_and_changes_nothing(tmp_path: Path) -> None:
    access = Access.create("beacon", [*NODES, ["v05"]])
    honest, _, _ = run(tmp_path / "honest", access, None)
    cheated, kinds, said = run(tmp_path / "cheated", access, Cheat(access))
    assert said["rounds"] > 1
    assert said["received"] == []
    assert said["logins"] == {"as the victim": False, "as nobody": False, "as itself again": True}
    assert cheated["verdict"] == honest["verdict"] == "valid"
    assert cheated["trace_sha256"] == honest["trace_sha256"]
    assert cheated["metrics_sha256"] == honest["metrics_sha256"]
    assert "refused" in kinds, "what it put on its own key reached the emulator, and was refused there"


def test_a_cheater_with_the_victims_rights_is_seen(tmp_path: Path) -> None:
    """The same cheater, let in to the victim's keys, does harm: the test above can fail."""
    access = Access.create("beacon", [*NODES, ["v05", "v01"]])
    cheat = Cheat(access)
    with pytest.raises(VnetError, match="v01 is already present"):
        run(tmp_path / "open", access, cheat)
    assert cheat.end()["received"] != []
