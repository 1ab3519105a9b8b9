"""Unmodified Zenoh programs as vehicles of a live run."""

import re
from collections import Counter
from pathlib import Path

from tests.support.paths import ROOT
from tests.system.conftest import Vnet

PAGE = (ROOT / "docs/how-to/zenoh.md").read_text()


def scenario(folder: Path, command: str) -> str:
    """Write the page's scenario, without a loss and with other commands; returns its path."""
    blocks = dict(re.findall(r"```\w+\n# (\S+)\n(.*?)```", PAGE, re.DOTALL))
    (folder / "talker.py").write_text(blocks["talker.py"])
    text = blocks["talkers.toml"].replace('["python", "talker.py", "{id}"]', command)
    (folder / "talkers.toml").write_text(text)
    return str(folder / "talkers.toml")


def test_a_program_hears_of_other_vehicles_what_the_radio_has_delivered_and_no_more(
    vnet: Vnet, tmp_path: Path
) -> None:
    path = scenario(tmp_path, f'["python", "{tmp_path}/talker.py", "{{id}}"]')
    done = vnet("run", path)
    assert done.status in (0, 3), "a slow machine makes a run in real time unknown"
    assert done.check("conservation")["verdict"] == "valid"
    assert done.check("partition_respected")["verdict"] != "invalid"
    delivered = Counter((row["receiver"], row["sender"]) for row in done.trace() if row["outcome"] == "delivered")
    for node in ("v01", "v02", "v03", "v04"):
        heard = Counter(re.findall(r"heard car/(\w+)/pose", (done.folder / f"logs/{node}.log").read_text()))
        assert node in heard, "programs of one vehicle talk past the radio"
        for other in heard.keys() - {node}:
            assert heard[other] <= delivered[node, other]
    assert sum(delivered.values()) > 0


def test_a_command_that_fails_is_a_crash_of_its_vehicle_alone(vnet: Vnet, tmp_path: Path) -> None:
    fails = '["python", "-c", "import sys; sys.exit(3 if sys.argv[1] == \'v02\' else 0)", "{id}"]'
    done = vnet("run", scenario(tmp_path, fails))
    (crash,) = done.events_of("crashed")
    assert (done.status, crash["node"]) == (1, "v02")
    assert "ended with status 3" in crash["error"]


def test_lockstep_is_refused_by_name(vnet: Vnet, tmp_path: Path) -> None:
    done = vnet("simulate", scenario(tmp_path, "[]"))
    assert done.status == 1
    assert "run.pacing" in done.events_of("crashed")[0]["error"]
