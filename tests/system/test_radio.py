"""A physical radio in whole runs: real processes do the same as their simulation, and so does the wall clock."""

from pathlib import Path

from tests.system.conftest import Vnet, heard_by, run_until

SCENARIO = "scenarios/80211p.toml"
SMALL = ("--set", "network.vehicles=6", "--duration", "1.5")
ANSWERING = ("--program", "tests.system.programs:answering")


def test_processes_on_one_channel_do_the_same_as_their_simulation(vnet: Vnet, tmp_path: Path) -> None:
    """Among buildings, too: a wall across the network."""
    wall = tmp_path / "wall.csv"
    wall.write_text("building,x_m,y_m\nwall,0,-9000\nwall,9,-9000\nwall,9,9000\nwall,0,9000\n")
    behind = (*SMALL, "--set", f"radio.buildings.path={wall}")
    live, simulated = (vnet(command, SCENARIO, *behind) for command in ("run", "simulate"))
    for run in (live, simulated):
        assert run.status == 0, run.stderr + run.stdout
        assert {run.check(name)["verdict"] for name in ("fading", "medium", "latency")} == {"valid"}
    assert live.fingerprint == simulated.fingerprint
    assert (live.folder / "busy.parquet").read_bytes() == (simulated.folder / "busy.parquet").read_bytes()


def test_whoever_answers_what_it_hears_is_woken_at_the_same_instant(vnet: Vnet) -> None:
    """Arrivals depend on what others send before: looking ahead must stop where anybody may answer."""
    few = ("--set", "network.vehicles=4", "--duration", "0.8", *ANSWERING)
    apart = vnet("run", SCENARIO, *few)
    together = vnet("run", SCENARIO, *few, "--set", "run.nodes_per_process=2")
    simulated = vnet("simulate", SCENARIO, *few)
    assert apart.status == together.status == simulated.status == 0, apart.stderr + apart.stdout
    assert simulated.fingerprint == apart.fingerprint == together.fingerprint
    answers = [row for row in simulated.trace() if row["size_bytes"] == 7]
    assert len(answers) > 20
    assert {(round(row["gain_db"], 6), row["bitrate_mbps"]) for row in answers} == {(-18.0, 12.0)}
    assert simulated.outcomes["delivered"] > 20


def test_on_the_wall_clock_frames_share_the_medium_too(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    options = ("--set", "network.vehicles=6", "--duration", "3600", "--pacing", "realtime")
    run = run_until(
        lambda: all(len(heard_by(folder, f"v0{number}")) >= 5 for number in range(1, 7)),
        folder,
        SCENARIO,
        *options,
        "--program",
        "tests.system.programs:names_neighbours",
    )
    assert run.status == 130, run.stderr + run.stdout
    assert run.outcomes["delivered"] >= 30
    checks = {name: run.check(name)["verdict"] for name in ("conservation", "range", "fading", "medium", "latency")}
    assert set(checks.values()) == {"valid"}, checks
