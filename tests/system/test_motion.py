"""Vehicles that drive in whole runs: five of them, of which one enters late and one leaves early."""

import subprocess
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from tests.support.forked_commands import AGENT, VNET, Command
from tests.support.motion import Stay, along, still, write_trips
from tests.support.paths import ROOT
from tests.system.by_hand import line_of
from tests.system.conftest import TIMEOUT_S, Finished, Vnet, running_agents

PROGRAM = "tests.support.fault_programs:minds_the_order"
VEHICLES: dict[str, list[Stay]] = {
    "v1": [(0, 4, along(0, 10))],
    "v2": [(0, 4, still(0, 50))],
    "v3": [(0, 4, along(80, -10, 10))],
    "v4": [(1.2, 4, along(-30, 10, 20))],  # enters
    "v5": [(0, 2, still(100, 20))],  # leaves
}


@pytest.fixture
def scenario(tmp_path: Path) -> str:
    write_trips(tmp_path / "trips.csv", VEHICLES)
    data: dict[str, Any] = {
        "run": {"name": "driving", "duration_s": 3.5, "settle_s": 0.5},
        "network": {"kind": "trips", "path": "trips.csv", "longest_gap_s": 1.0},
        "world": {"gnss": {"rate_hz": 5}},
        "radio": {"loss": 0.1},
        "program": {"entry": PROGRAM},
    }
    path = tmp_path / "driving.toml"
    path.write_text(tomli_w.dumps(data))
    return str(path)


def comings_and_goings(run: Finished) -> list[tuple[str, str, int]]:
    events = [*run.events_of("entered"), *run.events_of("left")]
    return [(event["kind"], event["node"], event["time_ns"]) for event in events]


def test_on_the_wall_clock_vehicles_come_and_go_as_well(vnet: Vnet, scenario: str) -> None:
    run = vnet("run", scenario, "--pacing", "realtime")
    assert run.status in (0, 3), run.stderr + run.stdout  # the machine may not keep up
    assert not [check for check in run.verdict["checks"] if check["verdict"] == "invalid"]
    left = [event for event in comings_and_goings(run) if event[0] == "left"]
    assert left == [("left", "v5", 2_200_000_000)]
    assert not running_agents(run.folder)


def test_agents_started_by_hand_wait_until_they_enter(vnet: Vnet, scenario: str, tmp_path: Path) -> None:
    folder = tmp_path / "by hand"
    command = [*VNET, "emulator", scenario, "--out", str(folder), "--listen", "tcp/127.0.0.1:0"]
    with ExitStack() as stack:
        emulator = stack.enter_context(
            Command(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        )
        stack.callback(emulator.kill)
        found = line_of(emulator, r"at (tcp\S+); waiting for 4")
        agents = {}
        for node in VEHICLES:
            credentials = folder / "access" / "credentials" / f"{node}.json"
            agent = [*AGENT, "--connect", found[1], "--run", "driving", "--node", node]
            agent += ["--credentials", str(credentials)]
            agents[node] = stack.enter_context(Command(agent, cwd=ROOT))
        stdout, stderr = emulator.communicate(timeout=TIMEOUT_S)
        by_hand = Finished(emulator.returncode, stdout, stderr, folder)
        assert {node: agent.wait(TIMEOUT_S) for node, agent in agents.items()} == dict.fromkeys(VEHICLES, 0)
    assert by_hand.status == 0, stderr + stdout
    assert comings_and_goings(by_hand) == [("entered", "v4", 1_200_000_000), ("left", "v5", 2_200_000_000)]
    assert by_hand.fingerprint == vnet("simulate", scenario).fingerprint
