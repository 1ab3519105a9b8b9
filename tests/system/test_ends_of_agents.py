"""A live process counts until it has ended: deaths once the run is over make the run invalid."""

from pathlib import Path

import pytest

from emulator.drivers.live import session
from tests.system.conftest import Finished, Vnet, in_this_process

SHORT = ["--duration", "1.5", "--set", "network.vehicles=3"]


def of(program: str) -> list[str]:
    return ["--program", f"tests.system.dies_at_the_end:{program}", *SHORT]


def dead(done: Finished) -> dict[str, str]:
    return {event["node"]: event["how"] for event in done.events_of("died")}


DEATHS = [
    ("segfaults", "SIGSEGV", "lockstep"),
    ("exits_3", "status 3", "realtime"),
    ("exits_0", "status 71", "lockstep"),
    ("exits_at_exit", "status", "realtime"),
]


@pytest.mark.parametrize(("program", "how", "pacing"), DEATHS)
def test_a_death_once_the_run_is_over_counts_and_what_was_unhandled_is_told(
    vnet: Vnet, program: str, how: str, pacing: str
) -> None:
    done = vnet("run", "scenarios/beacon.toml", *of(program), "--set", f"run.pacing={pacing}")
    assert done.status == 1, done.stdout + done.stderr
    assert done.check("agents_alive")["verdict"] == "invalid"
    assert list(dead(done)) == ["v02"] and how in dead(done)["v02"]
    told = [event["node"] for event in done.events_of("exception") if "LookupError" in event["error"]]
    assert sorted(told) == ["v01", "v02", "v03"], "each once"


def test_a_death_on_a_host_counts(vnet: Vnet) -> None:
    done = vnet("run", "scenarios/beacon.toml", *of("segfaults"), "--hosts", "1")
    assert done.check("agents_alive")["verdict"] == "invalid"
    assert list(dead(done)) == ["v02"]


def test_a_death_counts_for_each_vehicle_of_its_process(vnet: Vnet) -> None:
    done = vnet("run", "scenarios/beacon.toml", *of("segfaults"), "--set", "run.nodes_per_process=3")
    assert list(dead(done)) == ["v01", "v02", "v03"]


def test_an_end_that_never_comes_is_named_with_its_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "END_LIMIT_S", 3.0)
    folder = tmp_path / "run"
    words = ["run", "scenarios/beacon.toml", "--out", str(folder), "--no-report", *of("never_ends")]
    done = Finished(*in_this_process(words), folder)
    assert done.status == 1, done.stdout + done.stderr
    assert "v02" in dead(done) and "did not end within 3 s" in dead(done)["v02"]


@pytest.mark.parametrize("pacing", ["lockstep", "realtime"])
def test_what_a_program_handles_as_it_ends_is_handled(vnet: Vnet, pacing: str) -> None:
    done = vnet("run", "scenarios/beacon.toml", *of("handles_at_the_end"), "--set", f"run.pacing={pacing}")
    assert done.check("agents_alive")["verdict"] == "valid"
    assert done.check("no_exceptions")["verdict"] == "valid"
