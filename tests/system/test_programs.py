"""Whole runs of programs that behave and misbehave, live and simulated."""

from pathlib import Path

import pytest

from tests.support import forked_commands
from tests.support.forked_commands import VNET
from tests.support.paths import ROOT
from tests.system.conftest import TIMEOUT_S, Finished, Vnet, heard_by, run_until

OPTIONS = ["--duration", "2", "--set", "network.vehicles=4"]


def run(vnet: Vnet, command: str, program: str, *options: str) -> Finished:
    entry = f"tests.system.programs:{program}"
    return vnet(command, "scenarios/beacon.toml", "--program", entry, *OPTIONS, *options)


@pytest.mark.parametrize("command", ["run", "simulate"])
def test_a_program_that_raises_is_named_with_its_traceback(vnet: Vnet, command: str) -> None:
    done = run(vnet, command, "raises")
    assert done.status == 1
    assert "v02 crashed at 0.5 s" in done.check("agents_alive")["text"]
    (crash,) = done.events_of("crashed")
    assert crash["node"] == "v02"
    assert "the battery is flat" in crash["error"]
    assert "in raises" in crash["where"]
    assert done.outcomes["receiver_down"] > 0


@pytest.mark.parametrize("command", ["run", "simulate"])
def test_a_program_that_spins_is_invalid_and_shown(vnet: Vnet, command: str) -> None:
    done = run(vnet, command, "spins")
    assert done.status == 1
    (spun,) = done.events_of("spun")
    assert (spun["node"], spun["time_ns"]) == ("v02", 500_000_000)
    assert "in spins" in spun["where"]


@pytest.mark.parametrize(("command", "options"), [("run", []), ("simulate", ["--processes", "2"])])
def test_a_program_that_hangs_makes_the_run_unknown_and_is_shown(
    vnet: Vnet, command: str, options: list[str]
) -> None:
    done = run(vnet, command, "hangs", "--set", "run.stall_timeout_s=3", *options)
    assert done.status == 3
    assert done.verdict["verdict"] == "unknown"
    (stalled,) = done.events_of("stalled")
    assert stalled["node"] == "v02"
    assert "in hangs" in stalled["where"]


def test_a_process_that_ends_itself_asks_before(vnet: Vnet) -> None:
    done = run(vnet, "run", "dies", "--option", "exits=true")
    (death,) = done.events_of("died")
    assert (death["node"], death["how"], death["time_ns"]) == ("v02", "exit status 7", 500_000_000)


def test_a_killed_process_is_survived_and_named_with_its_last_words(vnet: Vnet) -> None:
    done = run(vnet, "run", "dies")
    assert done.status == 1
    (death,) = done.events_of("died")
    assert (death["node"], death["how"]) == ("v02", "SIGKILL")
    assert death["time_ns"] == 400_000_000, "when it asked last: it went on by itself for a period"
    assert "about to be killed" in death["log_tail"]
    assert "about to be killed" in done.stdout
    assert done.outcomes["receiver_down"] > 0
    assert done.verdict["emulated_s"] == 2.0, "the others went on to the end"
    senders = {row["sender"] for row in done.trace() if row["sent_ns"] > 500_000_000}
    assert "v02" not in senders
    assert len(senders) == 3


def test_real_time_runs_on_the_wall_clock(tmp_path: Path) -> None:
    nodes, folder = ["v01", "v02", "v03", "v04"], tmp_path / "run"
    options = ("--duration", "3600", "--pacing", "realtime", "--set", "network.vehicles=4")
    program = ("--program", "tests.system.programs:names_neighbours")

    def all_have_reported_lateness() -> bool:
        """Every vehicle hears the others in two seconds: in between each has acknowledged what it received."""
        return all(len({second for _, second in heard_by(folder, node)}) >= 2 for node in nodes)

    done = run_until(all_have_reported_lateness, folder, "scenarios/beacon.toml", *options, *program)
    (interrupted,) = done.events_of("interrupted")
    assert done.verdict["wall_s"] * 1e9 >= interrupted["time_ns"] > 0
    assert done.outcomes["delivered"] > 0
    assert {"conservation", "range", "loss_rate", "agents_alive"} <= {
        check["name"] for check in done.verdict["checks"] if check["verdict"] == "valid"
    }
    (late,) = done.events_of("late_deliveries")
    assert late["total"] > 0
    assert set(late["worst"]) == {f"{node}.0" for node in nodes}
    assert sum(late["worst"].values()) == sum(late["worst_s"].values()) == late["count"]


@pytest.mark.parametrize(("command", "package"), [("run", "agents"), ("simulate", "emulator")])
def test_a_program_that_a_package_of_vnet_s_own_hides_is_named_in_one_line(
    command: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # found before the current folder, as where vnet is installed
    file = tmp_path / f"{package}.py"
    file.write_text("async def main(node):\n    pass\n")
    scenario = str(ROOT / "scenarios" / "beacon.toml")
    arguments = [command, scenario, "--program", f"{package}:main", "--out", "run", "--quiet", *OPTIONS]
    done = forked_commands.run([*VNET, *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert done.returncode != 0
    assert done.stderr.count("\n") == 1
    assert done.stderr.endswith(f"{package} is a package of vnet's own: rename {file}\n")


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


@pytest.mark.parametrize("command", ["run", "simulate"])
def test_a_program_that_errs_as_it_is_told_to_end_has_not_failed(vnet: Vnet, command: str) -> None:
    done = run(vnet, command, "is_told_to_end_in_its_end")
    assert done.status == 0, done.stdout
    assert not [file for file in (done.folder / "logs").iterdir() if "exception" in file.read_text()]
