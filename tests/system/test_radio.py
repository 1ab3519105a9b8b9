"""A physical radio on the wall clock."""

from pathlib import Path

from tests.system.conftest import heard_by, run_until

SCENARIO = "scenarios/80211p.toml"


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
