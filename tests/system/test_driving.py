"""Programs that drive, and roadside units, in real processes: the same as simulated."""

from pathlib import Path

from tests.system.conftest import Vnet

SCENARIO = """
[run]
name = "platoon"
duration_s = 4.0
control_hz = 20.0

[network]
kind = "driven"
vehicles = 6

[network.driven]
road = "ring"
length_m = 400.0

[world.gnss]
rate_hz = 20

[world.ranging]

[radio]
loss = 0.1

[program]
entry = "tests.support.driving_programs:platoon"

[[roadside]]
position_m = [0.0, 10.0]
entry = "tests.support.roadside_programs:relay"

[[roadside]]
position_m = [0.0, 60.0]
entry = "tests.support.roadside_programs:relay"

[backbone]
latency_ms = 1.5
jitter_ms = 20.0
"""


def test_processes_drive_as_their_simulation_does(vnet: Vnet, tmp_path: Path) -> None:
    path = tmp_path / "platoon.toml"
    path.write_text(SCENARIO)
    live = vnet("run", str(path), "--set", "run.nodes_per_process=2")
    simulated = vnet("simulate", str(path))
    assert live.status == simulated.status == 0, live.stderr + simulated.stderr
    assert live.fingerprint == simulated.fingerprint
    for name in ("driven.parquet", "backbone.parquet"):
        assert (live.folder / name).read_bytes() == (simulated.folder / name).read_bytes()
