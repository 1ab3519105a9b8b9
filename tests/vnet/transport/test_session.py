"""An embedded router and a client of it, on a port that the system chooses."""

import gc
import os
import queue
import socket
import subprocess
import sys
from contextlib import ExitStack, closing, suppress
from itertools import takewhile
from pathlib import Path

import pytest
import zenoh

from tests.support.paths import ROOT
from vnet.errors import TransportError
from vnet.transport import keys, session, wire
from vnet.transport.access import Access, certifier, node_user
from vnet.transport.session import open_client, open_local_router, open_router, router_endpoint

LEASE_MS = 10_000


def test_what_is_too_large_does_not_reach_the_emulator(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire, "LARGEST_BUNDLE_BYTES", 2**20)
    access, key = Access.create("r", [["v01"]]), keys.node_tx("r", "v01")
    received: zenoh.handlers.FifoChannel[zenoh.Sample] = zenoh.handlers.FifoChannel(10)
    with open_router("tcp/127.0.0.1:0", access) as router:
        subscriber = router.declare_subscriber(key, received)
        with open_client(router_endpoint(router), access.credentials(node_user("v01")), LEASE_MS) as client:
            for size in (2**20 - 1000, 2**21, 7):
                client.put(key, bytes(size), congestion_control=zenoh.CongestionControl.BLOCK)
            sizes = [len(subscriber.recv().payload) for _ in range(2)]
    assert sizes == [2**20 - 1000, 7], "the session goes on without the one in between"


@pytest.mark.parametrize(("user", "may"), [("v01", False), ("v02", False), ("rsu01", True)])
def test_only_a_unit_has_rights_on_its_keys_of_the_backbone(user: str, may: bool) -> None:
    """A vehicle has none, whether it comes with its own credentials (v01) or with those of another one (v02)."""
    access = Access.create("r", [["v01"], ["v02", "v03"], ["rsu01", "v04"]], units=["rsu01"])
    tx, rx = keys.backbone_tx("r", "rsu01"), keys.backbone_rx("r", "rsu01")
    own_tx, own_rx = keys.node_tx("r", user), keys.node_rx("r", user)
    heard: queue.SimpleQueue[str] = queue.SimpleQueue()
    got: queue.SimpleQueue[str] = queue.SimpleQueue()

    def take(sample: zenoh.Sample) -> None:
        got.put(str(sample.key_expr))

    with open_router("tcp/127.0.0.1:0", access) as router:
        router.declare_subscriber("vnet/r/**", lambda sample: heard.put(str(sample.key_expr)))
        with open_client(router_endpoint(router), access.credentials(node_user(user)), LEASE_MS) as client:
            for key in (rx, tx, "vnet/r/backbone/**", own_rx):
                client.declare_subscriber(
                    key,
                    zenoh.handlers.Callback(take, indirect=False),  # in one order for all keys
                    allowed_origin=zenoh.Locality.REMOTE,
                )
            for key in (tx, rx, keys.backbone_tx("r", "v01"), keys.backbone_rx("r", user), own_tx):
                client.put(key, b"x", congestion_control=zenoh.CongestionControl.BLOCK)
            puts = [tx] * may + [own_tx]
            assert [heard.get(timeout=60) for _ in puts] == puts
            for key in (tx, rx, own_rx):
                router.put(key, b"x", congestion_control=zenoh.CongestionControl.BLOCK)
            came = [got.get(timeout=60)]
            while own_rx not in came:
                came.append(got.get(timeout=60))
            assert set(came) == {own_rx, *[rx] * may}


@pytest.mark.parametrize("given", [None, "(rx:(worker_threads:3))"])
def test_a_router_has_one_pool_of_threads_unless_the_user_has_set_another(
    given: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The setting is not left to what this process starts afterwards."""
    monkeypatch.setenv(session.RUNTIME_VARIABLE, given or "")
    if given is None:
        monkeypatch.delenv(session.RUNTIME_VARIABLE)
    seen: list[str | None] = []

    def fail(*_: object) -> None:
        seen.append(os.environ.get(session.RUNTIME_VARIABLE))
        raise TransportError("not opened")

    monkeypatch.setattr(session, "_open", fail)
    with pytest.raises(TransportError), open_router("tcp/127.0.0.1:0", Access.create("r", [["v01"]]), True):
        pass
    assert seen == [given or session.ROUTER_RUNTIME]
    assert os.environ.get(session.RUNTIME_VARIABLE) == given


def test_many_that_log_in_at_once_do_not_keep_an_agent_out() -> None:
    """By Zenoh's defaults the 101st was refused, and tried again so long that a run of many did not start."""
    access = Access.create("r", [["v01"]])
    with open_router("tcp/127.0.0.1:0", access) as router, ExitStack() as stack:
        host, port = router_endpoint(router).removeprefix("tcp/").split(":")
        for _ in range(150):
            stack.enter_context(socket.create_connection((host, int(port))))
        with open_client(f"tcp/{host}:{port}", access.credentials(node_user("v01")), LEASE_MS) as client:
            assert list(client.info.routers_zid()) == [router.zid()]


@pytest.mark.slow
@pytest.mark.parametrize("wanted", [None, "off", "debug", "trace,zenoh::api::session=trace"])
def test_zenohs_log_never_tells_a_configuration(wanted: str | None) -> None:
    """Run in a process of its own, because a log is opened only once."""
    code = (
        "from vnet.errors import TransportError\n"
        "from vnet.transport import session\n"
        "from vnet.transport.credentials import Credentials\n"
        "session.CONNECT_TIMEOUT_S = 0.001\n"
        "session.quiet_zenoh()\n"
        "try:\n"
        "    with session.open_client('tcp/127.0.0.1:1', Credentials('user', 'tell-nobody'), 1000): pass\n"
        "except TransportError: print('over')\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "RUST_LOG"}
    if wanted is not None:
        environment["RUST_LOG"] = wanted
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    said = done.stdout + done.stderr
    assert "over" in said and "tell-nobody" not in said
    assert ("zenoh" in said) == (wanted not in (None, "off"))


def test_a_peer_that_does_not_answer_does_not_keep_a_session_from_ending(monkeypatch: pytest.MonkeyPatch) -> None:
    class Unanswered:
        closed = 0

        def close(self) -> None:
            self.closed += 1
            raise zenoh.ZError("close operation timed out!")

    opened = Unanswered()
    monkeypatch.setattr(session, "_open", lambda *_: opened)
    with open_router("tcp/127.0.0.1:0", Access.create("r", [["v01"]])):
        pass
    with open_client("tcp/127.0.0.1:1", None, LEASE_MS):
        pass
    assert opened.closed == 2


def test_a_client_says_how_long_it_has_waited_for_a_router() -> None:
    with (
        pytest.raises(TransportError, match=r"tcp/127.0.0.1:1 without .*: no router answered.* within 0.05 s"),
        open_client("tcp/127.0.0.1:1", None, LEASE_MS, timeout_s=0.05),
    ):
        pass


def test_a_client_that_may_itself_have_refused_the_router_says_by_which_date() -> None:
    credentials = Access.create("r", [["v01"]], certifier("tls/127.0.0.1:1")).credentials(node_user("v01"))
    with (
        pytest.raises(TransportError, match=r"certificate does not hold on \d{4}-\d\d-\d\d, this machine's date"),
        open_client("tls/127.0.0.1:1", credentials, LEASE_MS, timeout_s=0.05),
    ):
        pass


MOST_LOOKS = 20_000
"""Looks at the segments: for a second at least."""


def segments() -> set[Path]:
    """The segments of shared memory that this process has open."""
    found = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            found.add(descriptor.readlink())
    return {path for path in found if path.is_relative_to("/dev/shm")}


@pytest.mark.slow
def test_a_local_router_keeps_no_shared_memory_of_its_programs() -> None:
    """Those of closed connections added up: a process that makes many runs came to a thousand descriptors."""
    before = segments()
    for _ in range(3):
        with closing(open_local_router("tcp/127.0.0.1:0", {})) as router:
            config = zenoh.Config()
            config.insert_json5("mode", '"client"')
            config.insert_json5("connect/endpoints", f'["{router_endpoint(router)}"]')
            with closing(zenoh.open(config)) as client:
                assert list(client.info.routers_zid()) == [router.zid()]
        del client, router
        gc.collect()
    looks = takewhile(lambda _: segments() != before, range(MOST_LOOKS))  # Zenoh's threads end after `close`
    assert len(list(looks)) < MOST_LOOKS
