"""Control of a running emulator: queries on `control/{verb}`, answered by the run itself.

`status`, `inject` (a fault as JSON) and `heal` (a fault's name, or `all`). What is wrong with a query comes back as
one line of error. During a live run its folder has the control endpoint, `control.json`, and the operator's
credentials, `operator.json` (both 0600).
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import zenoh

from emulator.drivers.emulation import Emulation
from emulator.drivers.status import Course, fault_state
from emulator.scenario.faults import OwnRule, parse_fault, refuse_router_restart
from emulator.viewer.sinks import ServeAt, Sinks
from vnet.errors import ScenarioError, TransportError, VnetError
from vnet.transport import keys
from vnet.transport.access import OPERATOR, Access
from vnet.transport.credentials import Credentials, write_private
from vnet.transport.session import open_client

CONTROL_FILE = "control.json"
OPERATOR_FILE = "operator.json"
LARGEST_QUERY_BYTES = 1 << 20
LEASE_MS = 10_000
ANSWER_TIMEOUT_S = 10.0


def answer(
    emulation: Emulation, course: Course, verb: str, payload: bytes, now_ns: int, own_router: bool
) -> dict[str, Any]:
    """Do what a query asks for. Raises VnetError, in one line, if it cannot be done."""
    match verb:
        case "status":
            return asdict(course.snapshot(now_ns))
        case "inject":
            fault = parse_fault(_json(payload))
            if not own_router:
                refuse_router_restart([fault])
            if isinstance(fault, OwnRule):
                raise ScenarioError(f"{fault.kind}: a rule is part of the scenario: write it as [[fault]] there")
            return asdict(fault_state(emulation.inject(fault, now_ns), emulation, now_ns))
        case "heal":
            label = _json(payload)
            if not isinstance(label, str):
                raise ScenarioError(f"heal: {label!r} is no name of a fault")
            return {"healed": _heal(emulation, label, now_ns)}
        case _:
            raise VnetError(f"control/{verb[:40]}: unknown; there are status, inject, heal")


def _heal(emulation: Emulation, label: str, now_ns: int) -> list[str]:
    if label != "all":
        return [emulation.heal(label, now_ns).label]
    acting = [planned for planned in emulation.faults.faults if planned.end_ns > now_ns]
    return [emulation.heal(planned.label, now_ns).label for planned in acting]


def _json(payload: bytes) -> Any:
    if len(payload) > LARGEST_QUERY_BYTES:
        raise ScenarioError(f"{len(payload)} bytes: at most {LARGEST_QUERY_BYTES} are taken")
    try:
        return json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise ScenarioError(f"not valid JSON: {error}") from None


@contextmanager
def control_endpoint(folder: Path, endpoint: str, access: Access, sinks: Sinks | None = None) -> Iterator[None]:
    """Keep `control.json` in the run's folder for as long as the block lasts; `sinks`: where it can be watched."""
    path = folder / CONTROL_FILE
    try:
        write_private(folder / OPERATOR_FILE, access.credentials(OPERATOR).dumps())
        place = None if sinks is None or sinks.serve is None else asdict(sinks.serve)
        write_private(path, json.dumps({"endpoint": endpoint, "run": access.run, "served": place}) + "\n")
    except OSError as error:
        raise VnetError(f"{path}: cannot write: {error.strerror}") from None
    try:
        yield
    finally:
        for left in (path, folder / OPERATOR_FILE):
            with contextlib.suppress(OSError):
                left.unlink()


@contextmanager
def _connected(folder: Path, endpoint: str, login: Credentials) -> Iterator[zenoh.Session]:
    """A session with the run; one that was killed has left its control file behind."""
    with ExitStack() as stack:
        try:
            session = stack.enter_context(open_client(endpoint, login, LEASE_MS))
        except TransportError as error:
            raise TransportError(f"{folder}: the run does not answer (was it killed?): {error}") from None
        yield session


def read_control_file(folder: Path) -> tuple[str, str, ServeAt | None] | None:
    """Endpoint and name of the run that is going on in `folder`, and where it can be watched; None if none is.

    A run that was killed leaves its file behind. Raises VnetError for what no run writes.
    """
    path = folder / CONTROL_FILE
    try:
        data = json.loads(path.read_text())
        served = data.get("served")
        return str(data["endpoint"]), str(data["run"]), None if served is None else ServeAt(**served)
    except OSError:
        return None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise VnetError(f"{path}: not what a run writes") from None


def ask(folder: Path, verb: str, payload: Any = None) -> dict[str, Any]:
    """Put a query to the run whose folder this is. Raises VnetError: no such run, no answer, or what it says."""
    way = read_control_file(folder)
    if way is None:
        raise VnetError(f"{folder}: no run is going on there ({CONTROL_FILE} is missing)")
    endpoint, run, _ = way
    login = Credentials.load(folder / OPERATOR_FILE)
    with _connected(folder, endpoint, login) as session:
        replies = session.get(
            keys.control(run, verb), payload=json.dumps(payload).encode(), timeout=ANSWER_TIMEOUT_S
        )
        for reply in replies:
            if reply.ok is not None:
                answered: dict[str, Any] = json.loads(reply.ok.payload.to_bytes())
                return answered
            assert reply.err is not None
            text = reply.err.payload.to_string()
            raise TransportError("the run does not answer: is it over?" if text == "Timeout" else text)
    raise TransportError("the run does not answer: is it over?")
