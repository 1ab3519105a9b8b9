"""Rules of the user's own over real processes: the emulator asks them, so live runs are simulated ones."""

from pathlib import Path

from tests.system.conftest import Vnet

SCENARIO = """
[run]
name = "ruled"
duration_s = 2.0
settle_s = 0.5
[network]
vehicles = 4
[radio]
loss = 0.1
[[fault]]
kind = "custom"
rule = "tests.support.rules:everything"
duration_s = 1.2
[[fault]]
kind = "custom_sender"
rule = "tests.support.rules:babbles"
at_s = 0.3
duration_s = 1.0
nodes = ["v02"]
[[fault]]
kind = "custom_sender"
rule = "tests.support.rules:silences"
at_s = 0.2
duration_s = 1.0
nodes = ["v03"]
"""


def test_rules_do_the_same_live_and_simulated(vnet: Vnet, tmp_path: Path) -> None:
    scenario = tmp_path / "ruled.toml"
    scenario.write_text(SCENARIO)
    live = vnet("run", str(scenario), "--set", "run.nodes_per_process=2")
    simulated = vnet("simulate", str(scenario))
    assert (live.status, simulated.status) == (0, 0), live.stderr + live.stdout
    assert live.fingerprint == simulated.fingerprint
    assert {row["cause"] for row in live.trace()} == {"", "everything-0", "babbles-1", "silences-2"}
