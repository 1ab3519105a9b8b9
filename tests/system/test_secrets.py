"""Credentials stay where they belong: no command line, environment, log, recording or record of a run shows one."""

import asyncio
import base64
import tempfile
from pathlib import Path

import pytest

from emulator.drivers.attachment import LiveOptions
from emulator.drivers.conclude import conclude
from emulator.drivers.live import run_live
from emulator.scenario.loading import load_scenario
from emulator.viewer.sinks import Sinks
from tests.support.paths import ROOT
from tests.support.recorded import prepared
from tests.system.conftest import running_agents
from vnet.transport.access import Access, certifier
from vnet.transport.credentials import KeyPair
from vnet.transport.session import open_router

NODES = [["v01"], ["v02"], ["v03"]]
LISTEN = {"passwords": "tcp/127.0.0.1:0", "certificates": "tls/127.0.0.1:0"}
endpoints = pytest.mark.parametrize("listen", LISTEN.values(), ids=LISTEN.keys())


def create(listen: str) -> Access:
    return Access.create("beacon", NODES, certifier(listen) if listen.startswith("tls/") else None)


def secrets_of(access: Access) -> list[bytes]:
    """Every password, and enough of every private key to know it by, plain and as it is handed to Zenoh."""
    pairs: list[KeyPair] = [] if access.tls is None else [access.tls.router, *access.tls.users.values()]
    private = [pair.private_key for pair in pairs]
    lines = [line for key in private for line in key.splitlines()[1:-1]]
    coded = [base64.b64encode(key.encode()).decode()[60:160] for key in private]
    return [secret.encode() for secret in (*access.passwords.values(), *lines, *coded)]


@endpoints
def test_a_run_shows_no_secret(
    listen: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RUST_LOG", "debug")  # Zenoh in the agents says all it can
    access, folder = create(listen), tmp_path / "run"
    scenario = load_scenario(ROOT / "scenarios" / "beacon.toml", ["network.vehicles=3", "run.duration_s=2"])
    emulation = prepared(scenario, folder)
    seen: dict[int, bytes] = {}

    def look(_: object) -> None:
        for pid in running_agents(folder):
            process = Path("/proc") / str(pid)
            seen[pid] = (process / "cmdline").read_bytes() + (process / "environ").read_bytes()

    emulation.watch(look)
    wall_s, _ = asyncio.run(
        run_live(emulation, LiveOptions(access, listen, record=Sinks(folder / "recording.rrd")))
    )
    _, verdict = conclude(emulation, wall_s, "run")
    assert verdict["verdict"] == "valid"
    assert len(seen) == 3
    said = capfd.readouterr()
    texts = {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert {"recording.rrd", "events.jsonl", "verdict.json", "scenario.toml", "v01.log"} <= texts.keys()
    assert b"zenoh" in texts["v01.log"], "Zenoh's log was on"
    texts |= {f"process {pid}": text for pid, text in seen.items()}
    texts["terminal"] = (said.out + said.err).encode()
    secrets = secrets_of(access)
    assert {name for name, text in texts.items() for secret in secrets if secret in text} == set()


@endpoints
def test_an_embedded_router_leaves_nothing_on_the_disk(
    listen: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with open_router(listen, create(listen)):
        assert list(tmp_path.iterdir()) == []
