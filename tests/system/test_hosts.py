"""Several hosts: the same run as on one, and what becomes of it when a host goes."""

from pathlib import Path
from typing import Any

import tomli_w

from tests.system.conftest import Vnet

SCENARIO: dict[str, Any] = {
    "run": {"name": "hosts", "duration_s": 4.0, "settle_s": 0.5},
    "network": {"vehicles": 5},
    "radio": {"loss": 0.1},
    "program": {"entry": "tests.system.programs:counts_its_starts"},
    "fault": [
        {"kind": "kill", "at_s": 0.5, "duration_s": 1.0, "nodes": ["v02"]},
        {"kind": "pause", "at_s": 1.0, "duration_s": 0.5, "nodes": ["v05"]},
        {"kind": "emulator_restart", "at_s": 2.0, "down_s": 0.2},
    ],
}


def write(path: Path, **changes: Any) -> str:
    path.write_text(tomli_w.dumps({**SCENARIO, **changes}))
    return str(path)


def test_on_two_hosts_the_run_is_that_of_one_process(vnet: Vnet, tmp_path: Path) -> None:
    """With a restart on one of them, a pause on the other, and a restart of the emulator's router."""
    scenario = write(tmp_path / "hosts.toml")
    there, here = vnet("run", scenario, "--hosts", "2"), vnet("simulate", scenario)
    assert there.status == here.status == 0, there.stdout + there.stderr
    assert there.fingerprint == here.fingerprint
    kinds = ("log", "event", "restarted")
    assert [event for event in there.events if event["kind"] in kinds] == [
        event for event in here.events if event["kind"] in kinds
    ]
    for file in ("logs/v02.log", "files/v02/starts.txt", "files/v05/starts.txt"):
        assert (there.folder / file).read_text() == (here.folder / file).read_text(), file
    assert (there.folder / "files/v02/starts.txt").read_text() == "2"
    measured = {event["node"] for event in there.events_of("memory")}
    assert measured >= {"v01", "v02", "v03", "v04", "v05"}
    assert all(each["cpu_s"] > 0 for each in there.verdict["cost"]["vehicles"])
