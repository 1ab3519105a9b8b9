"""The test bench: a router with the run's rules, the emulator's keys of one node, and the agent under test."""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

import zenoh

from emulator.testing.conformance.findings import decoding_problem
from vnet.errors import VnetError
from vnet.transport import keys, wire
from vnet.transport.access import Access, node_user
from vnet.transport.credentials import write_private
from vnet.transport.session import AGENT_RUNTIME, open_router, router_endpoint

LEASE_MS = 60_000
POLL_S = 0.02
KILL_WAIT_S = 5.0
PLACEHOLDERS = ("{endpoint}", "{run}", "{node}", "{credentials}")


@dataclass(frozen=True)
class Said:
    """Something that the agent has put on its `tx`, and when (monotonic ns): a message, or the problem with it."""

    data: bytes
    at_ns: int
    message: wire.AgentMessage | None
    problem: str


class AgentUnderTest:
    """A command that is started once a scene; `{endpoint}` and the like in it are filled in."""

    def __init__(self, command: Sequence[str], log: Path) -> None:
        self._command = list(command)
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, values: Sequence[str]) -> None:
        """Start it with the values of `PLACEHOLDERS`. Raises VnetError if that is impossible."""
        command = list(self._command)
        for placeholder, value in zip(PLACEHOLDERS, values, strict=True):
            command = [word.replace(placeholder, value) for word in command]
        environment = {**os.environ, "PYTHONHASHSEED": "0", "PYTHONUNBUFFERED": "1", "ZENOH_RUNTIME": AGENT_RUNTIME}
        try:
            with self._log.open("wb") as log:
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    env=environment,
                    start_new_session=True,
                )
        except OSError as error:
            raise VnetError(f"cannot start {command[0]!r}: {error.strerror}") from None

    @property
    def exit_status(self) -> int | None:
        """Its exit status; negative for a signal, None while it runs."""
        return None if self._process is None else self._process.poll()

    def last_words(self) -> str:
        """The last line that it has printed."""
        lines = self._log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it printed nothing"

    def kill(self) -> None:
        """End it and all that it has started."""
        if self._process is not None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait(KILL_WAIT_S)
            self._process = None


class Bench:
    """The emulator's end of the wire, and the agent at the other. Use as a context manager."""

    def __init__(self, access: Access, listen: str, agent: AgentUnderTest, folder: Path) -> None:
        self.node = access.processes[0][0]
        self.present = False
        self.agent = agent
        self.endpoint = listen
        self._access = access
        self._credentials = folder / f"{self.node}.json"
        self._incoming: queue.SimpleQueue[Said | bool] = queue.SimpleQueue()
        self._stack = ExitStack()

    def __enter__(self) -> Bench:
        write_private(self._credentials, self._access.credentials(node_user(self.node)).dumps())
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.agent.kill()
        self.close()

    def open(self) -> None:
        """Listen, and declare the emulator's keys and token."""
        run = self._access.run
        session = self._stack.enter_context(open_router(self.endpoint, self._access, LEASE_MS))
        self.endpoint = router_endpoint(session)
        block = zenoh.CongestionControl.BLOCK
        rx = session.declare_publisher(keys.node_rx(run, self.node), congestion_control=block, express=True)
        self._rx = self._stack.enter_context(rx)
        self._stack.enter_context(session.declare_subscriber(keys.node_tx(run, "*"), self._take_tx))
        liveliness = session.liveliness()
        alive = liveliness.declare_subscriber(keys.node_alive(run, "*"), self._take_alive, history=True)
        self._stack.enter_context(alive)
        self._stack.enter_context(liveliness.declare_token(keys.emulator_alive(run)))

    def close(self) -> None:
        """Go away, as an emulator that is killed or restarted does."""
        self._stack.close()
        self.present = False

    def _take_tx(self, sample: zenoh.Sample) -> None:
        data, at_ns = sample.payload.to_bytes(), time.monotonic_ns()
        self._incoming.put(Said(data, at_ns, *decoding_problem(data)))

    def _take_alive(self, sample: zenoh.Sample) -> None:
        self._incoming.put(sample.kind == zenoh.SampleKind.PUT)

    def start_agent(self) -> None:
        """Forget what was said before, and start the agent."""
        while self.hear(0) is not None:
            pass
        self.agent.start([self.endpoint, self._access.run, self.node, str(self._credentials)])

    def say(self, message: wire.EmulatorMessage | bytes) -> None:
        """Put a message, or any bytes, on the node's `rx`."""
        self._rx.put(message if isinstance(message, bytes) else wire.encode(message))

    def hear(self, timeout_s: float) -> Said | None:
        """The next that the agent says; None if nothing comes in time, or if the agent has ended.

        What it said last may come after its exit is known, but comes before its token is gone.
        """
        deadline_s = time.monotonic() + timeout_s
        ended = False
        while True:
            try:
                item = self._incoming.get(timeout=POLL_S if timeout_s > 0 and not ended else 0.0)
            except queue.Empty:
                if ended or time.monotonic() >= deadline_s:
                    return None
                ended = self.agent.exit_status is not None and not self.present
                continue
            if isinstance(item, Said):
                return item
            self.present = item
