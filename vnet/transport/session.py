"""Opening Zenoh sessions: the emulator's embedded router, or a client of a router.

All settings that matter by measurement are here: no multicast scouting, no shared memory, explicit endpoints,
finite timeouts. Sessions must be closed (`with`): an open one hangs the interpreter's exit.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import zenoh

from vnet.errors import TransportError
from vnet.transport.access import Access, is_tls, queues, router_config
from vnet.transport.credentials import Credentials, Identity, as_base64, write_private

_ONE_POOL = "(rx:(handover:app),acc:(handover:app),tx:(handover:app),net:(handover:app),app:(worker_threads:{}))"
"""Setting of Zenoh that has all its tasks share some threads: those of a message do not wake one another."""
RUNTIME_VARIABLE = "ZENOH_RUNTIME"
"""Environment variable of this setting, read by Zenoh when the first session of a process is opened."""
AGENT_RUNTIME = _ONE_POOL.format(2)
"""Setting of an agent."""
LOCKSTEP_AGENT_RUNTIME = _ONE_POOL.format(1)
"""Setting of an agent in lockstep: it sends or receives, and a second thread is woken to find nothing to do."""
ROUTER_RUNTIME = _ONE_POOL.format(2)
"""Setting of an emulator in lockstep: while one thread passes a message on, the other serves connections."""

CONNECT_TIMEOUT_S = 5.0
"""Longest time to connect to a router that may not be there: long enough for a loaded machine."""

_NO_CONFIGURATIONS = "zenoh::api::session=off"
"""Filter of Zenoh's log that drops sessions' configurations, which contain passwords."""


@contextmanager
def open_router(listen: str, access: Access, one_pool: bool = False) -> Iterator[zenoh.Session]:
    """Open a session in router mode that listens at `listen` (e.g. tcp/127.0.0.1:0) with the run's rules.

    With `one_pool` Zenoh's tasks share two threads, if this is the first session of the process: all later ones
    have the threads of the first, but no process that this one starts does.
    Raise TransportError if it cannot listen there, or if only one of the endpoint and the users is set up for TLS.
    """
    access.check_endpoint(listen)
    with tempfile.TemporaryDirectory(prefix="vnet-") as folder:
        dictionary = Path(folder) / "users.txt"
        write_private(dictionary, access.dictionary())
        config = router_config([listen], dictionary, access.access_control(), access.tls)
        config["adminspace"] = {"enabled": True, "permissions": {"read": True, "write": False}}
        with _runtime(ROUTER_RUNTIME) if one_pool else nullcontext():
            session = _open(config, f"cannot listen on {listen}")
    with _closed_at_end(session):
        yield session


@contextmanager
def _runtime(setting: str) -> Iterator[None]:
    """Set Zenoh's threads within the block, which opens the first session, unless the user has set them."""
    if RUNTIME_VARIABLE in os.environ:
        yield
        return
    os.environ[RUNTIME_VARIABLE] = setting
    try:
        yield
    finally:
        os.environ.pop(RUNTIME_VARIABLE, None)


@contextmanager
def open_client(
    endpoint: str, credentials: Credentials | None, lease_ms: int, timeout_s: float | None = None
) -> Iterator[zenoh.Session]:
    """Open a client session of the router at `endpoint`.

    Raise TransportError if none answers within `timeout_s` (by default 5 s), or it refuses.
    """
    timeout_s = CONNECT_TIMEOUT_S if timeout_s is None else timeout_s
    identity = None if credentials is None else credentials.tls
    if is_tls(endpoint) != (identity is not None):
        has = "have a certificate: connect to tls/HOST:PORT" if identity else "have no certificate"
        raise TransportError(f"cannot connect to {endpoint}: the credentials {has}")
    config: dict[str, Any] = {
        "mode": "client",
        "connect": {
            "endpoints": [endpoint],
            "timeout_ms": round(1000 * timeout_s),
            "exit_on_failure": True,
            "retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {**queues(lease_ms), **_identification(identity)},
        },
    }
    if credentials is not None:
        usrpwd = {"user": credentials.user, "password": credentials.password}
        config["transport"]["auth"] = {"usrpwd": usrpwd}
    who = f" as {credentials.user}" if credentials else " without credentials"
    today = time.strftime("%Y-%m-%d")
    doubt = "" if identity is None else f", or its certificate does not hold on {today}, this machine's date"
    with _closed_at_end(_open(config, f"cannot connect to {endpoint}{who}", timeout_s, doubt)) as session:
        yield session


@contextmanager
def _closed_at_end(session: zenoh.Session) -> Iterator[zenoh.Session]:
    """Close a session at the end of the block, also one whose peer does not answer any more (its cable is out)."""
    try:
        yield session
    finally:
        with suppress(zenoh.ZError):  # after ten seconds: the connection is given up
            session.close()  # type: ignore[no-untyped-call]


def open_local_router(listen: str, settings: dict[str, Any]) -> zenoh.Session:
    """Open a router that listens at `listen`, and seeks nobody; `settings` are added to those of its transport.

    It offers no shared memory: Zenoh keeps the segments of each connection for longer than the connection.
    The caller closes it. Raise TransportError if it cannot listen there.
    """
    config = {
        "mode": "router",
        "listen": {"endpoints": [listen]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0},
        "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}},
        "transport": {"shared_memory": {"enabled": False}, **settings},
    }
    return _open(config, f"cannot listen at {listen}")


def router_endpoint(session: zenoh.Session) -> str:
    """Return the locator at which an embedded router listens, with the port that the system chose for port 0."""
    for reply in session.get(f"@/{session.zid()}/router"):
        if reply.ok is not None:
            locators = json.loads(reply.ok.payload.to_string())["locators"]
            return str(locators[0])
    raise TransportError("the embedded router does not say where it listens")


def quiet_zenoh() -> None:
    """Show Zenoh's own log on stderr at `RUST_LOG` if it is set; otherwise turn it off.

    In any case the part of Zenoh that logs a session's configuration, password included, is off.
    """
    wanted = os.environ.get("RUST_LOG", "off")
    if not wanted.endswith(_NO_CONFIGURATIONS):
        os.environ["RUST_LOG"] = f"{wanted},{_NO_CONFIGURATIONS}"  # for child processes too
    zenoh.init_log_from_env_or("off")


def _identification(identity: Identity | None) -> dict[str, Any]:
    """Return the TLS settings by which a client authenticates itself, and verifies the run's router."""
    if identity is None:
        return {}
    return {
        "tls": {
            "root_ca_certificate_base64": as_base64(identity.authority),
            "connect_certificate_base64": as_base64(identity.own.certificate),
            "connect_private_key_base64": as_base64(identity.own.private_key),
            "enable_mtls": True,
            "verify_name_on_connect": True,
        }
    }


def _open(config: dict[str, Any], failure: str, timeout_s: float = 0.0, doubt: str = "") -> zenoh.Session:
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError as error:
        raise TransportError(f"{failure}: {_reason(str(error), timeout_s, doubt)}") from None


def _reason(text: str, timeout_s: float, doubt: str) -> str:
    if "Address already in use" in text or "os error 98" in text:
        return "the address is already in use"
    if "Cannot assign requested address" in text:
        return "no such address on this machine"
    if "Timeout" in text:
        return f"no router answered, or it refused the credentials{doubt}, within {timeout_s:g} s"
    return text.split(" at /")[0]
