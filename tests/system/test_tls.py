"""TLS with client certificates: who holds one of this run's authority joins, and nobody else."""

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from tests.support.forked_commands import VNET, run
from tests.support.paths import ROOT
from tests.system.by_hand import OPTIONS, ROUTER, SCENARIO, finish, start_agents, start_emulator
from tests.system.conftest import TIMEOUT_S, Vnet
from vnet.errors import TransportError
from vnet.transport import keys, session
from vnet.transport.access import Access, certifier, node_user
from vnet.transport.authority import issue_certificates
from vnet.transport.credentials import Certificates, Credentials, Identity
from vnet.transport.session import open_client, open_router, router_endpoint

LISTEN = "tls/127.0.0.1:0"
LEASE_MS = 10_000
V01, V02 = node_user("v01"), node_user("v02")


def create() -> Access:
    return Access.create("r", [["v01"], ["v02"]], certifier(LISTEN))


@pytest.fixture
def access(monkeypatch: pytest.MonkeyPatch) -> Access:
    monkeypatch.setattr(session, "CONNECT_TIMEOUT_S", 1.0)
    return create()


@pytest.fixture
def router(access: Access) -> Iterator[zenoh.Session]:
    with open_router(LISTEN, access) as opened:
        yield opened


def joins(router: zenoh.Session, credentials: Credentials) -> bool:
    """Return True if the router accepts these credentials."""
    try:
        with open_client(router_endpoint(router), credentials, LEASE_MS):
            return True
    except TransportError as error:
        assert "refused the credentials" in str(error)
        return False


def with_identity(credentials: Credentials, **changes: object) -> Credentials:
    assert credentials.tls is not None
    return replace(credentials, tls=replace(credentials.tls, **changes))  # type: ignore[arg-type]


def own_key_pair(access: Access, user: str) -> object:
    identity = access.credentials(user).tls
    assert identity is not None
    return identity.own


def test_a_certificate_of_this_run_joins(router: zenoh.Session, access: Access) -> None:
    assert router_endpoint(router).startswith("tls/127.0.0.1:")
    assert joins(router, access.credentials(V01))


def test_none_and_one_of_another_authority_do_not_join(
    router: zenoh.Session, access: Access, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = access.credentials(V01)
    assert not joins(router, with_identity(own, own=own_key_pair(create(), V01)))
    assert not joins(router, replace(own, password="guessed"))

    def without_certificate(identity: Identity) -> dict[str, object]:
        tls = identify(identity)["tls"]
        return {"tls": {key: value for key, value in tls.items() if not key.startswith(("connect", "enable"))}}

    identify = session._identification
    monkeypatch.setattr(session, "_identification", without_certificate)
    assert not joins(router, own)
    monkeypatch.undo()
    assert joins(router, own), "the same client, with its certificate, is let in"


def test_a_client_believes_only_its_own_runs_router(access: Access, router: zenoh.Session) -> None:
    stranger = create().tls
    assert stranger is not None
    assert not joins(router, with_identity(access.credentials(V01), authority=stranger.authority))


def test_a_client_verifies_the_name_of_the_router(access: Access) -> None:
    elsewhere: Certificates = issue_certificates(access.passwords, ["elsewhere.example"])
    moved = replace(access, tls=elsewhere)
    with open_router(LISTEN, moved) as router:
        assert not joins(router, moved.credentials(V01))


def test_anothers_certificate_gives_no_rights(router: zenoh.Session, access: Access) -> None:
    """A password goes with its own user's certificate: either alone opens nothing."""
    heard: list[str] = []
    received: zenoh.handlers.FifoChannel[zenoh.Sample] = zenoh.handlers.FifoChannel(10)
    subscriber = router.declare_subscriber(keys.node_tx("r", "*"), received)
    stolen = with_identity(access.credentials(V01), own=own_key_pair(access, V02))
    for credentials in (stolen, access.credentials(V02)):
        with open_client(router_endpoint(router), credentials, LEASE_MS) as client:
            for node in ("v01", "v02"):
                client.put(keys.node_tx("r", node), credentials.user.encode())
    heard.append(subscriber.recv().payload.to_string())  # v02's own comes last: nothing is before it
    assert heard == [V02]
    assert subscriber.try_recv() is None


def test_agents_and_a_separate_router_over_tls_do_the_same_as_one_process(vnet: Vnet, tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tls/127.0.0.1:{free.getsockname()[1]}"
    access = tmp_path / "access"
    command = [*VNET, "access", SCENARIO, *OPTIONS[2:], "--out", str(access), "--listen", endpoint]
    assert run(command, cwd=ROOT, timeout=TIMEOUT_S, capture_output=True).returncode == 0
    assert all(path.stat().st_mode & 0o077 == 0 for path in access.rglob("*") if path.is_file())
    with ExitStack() as stack:
        router = stack.enter_context(
            subprocess.Popen(
                [sys.executable, "-c", ROUTER, str(access / "zenohd.json5")],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        )
        assert router.stdout is not None
        assert router.stdout.readline() == "up\n"
        folder = tmp_path / "separate"
        there = ["--connect", endpoint, "--access", str(access)]
        emulator, _ = start_emulator(stack, folder, *there)
        command = [*VNET, "emulator", SCENARIO, *OPTIONS, *there, "--out", str(tmp_path / "second")]
        second = run(command, cwd=ROOT, timeout=TIMEOUT_S, capture_output=True, text=True)
        assert second.returncode == 2
        assert "run beacon has an emulator there already" in second.stderr
        start_agents(stack, endpoint, access)
        separate = finish(emulator, folder)
        router.communicate("\n", timeout=TIMEOUT_S)
    assert separate.status == 0, separate.stderr + separate.stdout
    assert separate.fingerprint == vnet("simulate", SCENARIO, *OPTIONS).fingerprint
