"""One scene with an agent: the emulator's end of the wire, checks of single messages, joining and ending."""

from __future__ import annotations

import math
import os
import queue
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

from msgspec.structs import replace

from emulator.drivers.agent_keys import AgentKeys
from emulator.drivers.emulation import Emulation
from emulator.drivers.processes import ProtocolError, check_ownership
from emulator.drivers.zygote import GroupProcess
from emulator.radio.unicast import MOST_ATTEMPTS
from emulator.testing.conformance.findings import Findings, decoding_problem
from vnet.counted import counted
from vnet.errors import VnetError
from vnet.reports import Report
from vnet.transport import keys, wire
from vnet.transport.access import Access, node_user
from vnet.transport.credentials import write_private
from vnet.transport.session import AGENT_RUNTIME, open_router, router_endpoint

LEASE_MS = 60_000
POLL_S = 0.02
PLACEHOLDERS = ("{endpoint}", "{run}", "{node}", "{credentials}")
OF_TRAFFIC = ("own_node", "payload", "sends", "numbers", "report_time")
ORPHAN_TIMEOUT_S = 1.0
"""Time that an agent waits for an emulator that is gone, as the welcome says."""
QUIET_S = 0.3
"""Time that a scene listens for messages that must not come."""
START_UP_S = 20.0
"""Time that a process may take to start and to load its program."""
ASK_EVERY_S = 0.2
SHORTEST_NONCE = 8
PAYLOADS = (b"a packet", b"", b"\xc1 no msgpack", b"\x81\xa1x")
"""Payloads of the packets that the agent receives, in turn: the radio may bring anything."""
Pacing = Literal["lockstep", "realtime"]
M = TypeVar("M", bound=wire.AgentMessage)


class SceneOverError(Exception):
    """The scene cannot go on; the reason has been noted."""


class Said(NamedTuple):
    """Something that the agent has put on its `tx`, and when (monotonic ns): a message, or the problem with it."""

    data: bytes
    at_ns: int
    message: wire.AgentMessage | None
    problem: str


class Bench:
    """The emulator's end of the wire, and the command at the other. Use as a context manager."""

    def __init__(self, access: Access, listen: str, command: Sequence[str], folder: Path) -> None:
        self.node = access.processes[0][0]
        self.present = False
        self.endpoint = listen
        self._access = access
        self._command = command
        self._folder = folder
        self._process: GroupProcess | None = None
        self._incoming: queue.SimpleQueue[Said | bool] = queue.SimpleQueue()
        self._stack = ExitStack()

    def __enter__(self) -> Bench:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._end_agent()
        self.close()

    def open(self) -> None:
        """Listen, and declare the emulator's keys and token."""
        session = self._stack.enter_context(open_router(self.endpoint, self._access, LEASE_MS))
        self.endpoint = router_endpoint(session)
        run = self._access.run
        self._keys = AgentKeys(session, run, [self.node], (), False, self._take, self._stack)
        self._stack.enter_context(session.liveliness().declare_token(keys.emulator_alive(run)))

    def close(self) -> None:
        """Go away, as an emulator that is killed or restarted does."""
        self._stack.close()
        self.present = False

    def _take(self, what: str, node: str, item: Any) -> None:
        at_ns = time.monotonic_ns()
        self._incoming.put(item if what == "token" else Said(item, at_ns, *decoding_problem(item)))

    def start_agent(self) -> None:
        """Forget what was said before, and start the command. Raises VnetError if that is impossible."""
        self._end_agent()
        while self.hear(0) is not None:
            pass
        credentials = self._folder / f"{self.node}.json"
        write_private(credentials, self._access.credentials(node_user(self.node)).dumps())
        command = list(self._command)
        values = (self.endpoint, self._access.run, self.node, str(credentials))
        for placeholder, value in zip(PLACEHOLDERS, values, strict=True):
            command = [word.replace(placeholder, value) for word in command]
        environment = {**os.environ, "PYTHONHASHSEED": "0", "PYTHONUNBUFFERED": "1", "ZENOH_RUNTIME": AGENT_RUNTIME}
        try:
            with self._log.open("wb") as log:
                self._process = GroupProcess(
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
    def _log(self) -> Path:
        return self._folder / "agent.log"

    @property
    def exit_status(self) -> int | None:
        """Exit status of the agent; negative for a signal, None while it runs."""
        return None if self._process is None else self._process.poll()

    @property
    def end(self) -> str:
        """Exit status of the agent and the last line that it has printed."""
        lines = self._log.read_text(errors="replace").strip().splitlines()
        return f"exit status {self.exit_status}: {lines[-1] if lines else 'it printed nothing'}"

    def _end_agent(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def say(self, message: wire.EmulatorMessage | bytes) -> None:
        """Put a message, or any bytes, on the node's `rx`."""
        self._keys.put(self.node, message if isinstance(message, bytes) else wire.encode(message))

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
                ended = self.exit_status is not None and not self.present
                continue
            if isinstance(item, Said):
                return item
            self.present = item


class Scene:
    """One scene: the agent is started, is told what the scene says, and has each answer checked."""

    def __init__(
        self, bench: Bench, findings: Findings, emulation: Emulation, pacing: Pacing, patience_s: float
    ) -> None:
        self.bench = bench
        self.findings = findings
        self.emulation = emulation
        self.pacing: Pacing = pacing
        self.patience_s = patience_s
        self.nonce = b""
        self.silent = True
        """True while only Hello and StackDump are allowed, before the run begins."""
        self.take_frames: Callable[[Said], None] = lambda said: None
        """Function that counts the Frames of a real-time run, in whichever step of the scene they arrive."""
        self._numbers: set[int] = set()
        self._sends: list[int] = []

    def over(self, check: str, came: str, data: bytes | None = None) -> SceneOverError:
        """Note that a check has failed, and return the error that ends the scene."""
        self.findings.fail(check, came, data)
        return SceneOverError()

    def hear(self, timeout_s: float) -> Iterator[Said]:
        """Yield the messages that decode and bear the agent's nonce, until the timeout or until it has ended."""
        deadline_s = time.monotonic() + timeout_s
        while (said := self.bench.hear(max(deadline_s - time.monotonic(), 0))) is not None:
            self.findings.expect("decodes", "nonce")
            if said.message is None:
                self.findings.fail("decodes", said.problem, said.data)
            elif self.nonce and said.message.nonce != self.nonce:
                self.findings.fail("nonce", f"{type(said.message).__name__} with another", said.data)
            elif self.silent and not isinstance(said.message, wire.Hello | wire.StackDump):
                self.findings.fail("silence", type(said.message).__name__, said.data)
            else:
                if isinstance(said.message, wire.Frames):
                    self.take_frames(said)
                yield said
            if time.monotonic() >= deadline_s:
                return

    def until_quiet(self) -> list[Said]:
        """Return what comes until nothing but Frames has come for `QUIET_S`, for `patience_s` at most."""
        deadline_s = time.monotonic() + self.patience_s
        taken: list[Said] = []
        while (left_s := deadline_s - time.monotonic()) > 0:
            heard = [said for said in self.hear(min(QUIET_S, left_s)) if not isinstance(said.message, wire.Frames)]
            if not heard:
                break
            taken += heard
        return taken

    def await_message(
        self, kind: type[M], check: str, timeout_s: float, fits: Callable[[M], bool] = bool, stays: str = "stays"
    ) -> tuple[M, bytes]:
        """Wait for a message of this kind that fits; others are passed over.

        If it does not come the scene is over, and `check` has failed, or `stays` where the agent has ended.
        """
        self.findings.expect(check)
        last: bytes | None = None
        for said in self.hear(timeout_s):
            if isinstance(said.message, kind) and fits(said.message):
                return said.message, said.data
            last = said.data
        self.check_stays(stays)
        raise self.over(check, f"no {kind.__name__} within {timeout_s:g} s", last)

    def check_stays(self, check: str = "stays") -> None:
        """End the scene if the agent has ended, although it was not told to."""
        self.findings.expect(check)
        if self.bench.exit_status is not None:
            raise self.over(check, self.bench.end)

    def check_traffic(self, traffic: wire.Traffic, data: bytes, shown_ns: tuple[int, int], when: str) -> None:
        """Check frames and reports; the vehicle's clock may show times from the first to the last of `shown_ns`."""
        fail = self.findings.fail
        self.findings.expect(*OF_TRAFFIC)
        self.check(lambda: check_ownership([self.bench.node], traffic), data)
        limit = self.emulation.scenario.radio.max_payload_bytes
        for frame in traffic.frames:
            if len(frame.payload) > limit:
                fail("payload", f"{len(frame.payload)} bytes, where {limit} are allowed", data)
            if frame.to is not None:
                if frame.number in self._numbers:
                    fail("sends", f"a second frame with number {frame.number}", data)
                self._numbers.add(frame.number)
                self._sends.append(frame.number)
        for report in traffic.reports:
            if not all(map(math.isfinite, _numbers(report))):
                fail("numbers", "a report with a number that is not finite", data)
            if not shown_ns[0] <= report.time_ns <= shown_ns[1]:
                fail("report_time", f"time_ns = {report.time_ns}, {when}", data)

    def check(self, rule: Callable[[], None], data: bytes) -> None:
        """Check a message by a rule that runs have, too."""
        try:
            rule()
        except ProtocolError as error:
            self.findings.fail(error.rule, str(error), data)

    @property
    def is_sending(self) -> bool:
        """True if frames to single vehicles have no result yet."""
        return bool(self._sends)

    def take_results(self, time_ns: int) -> list[wire.WireSendResult]:
        """Return results at `time_ns` of the frames to single vehicles that have none: every other one failed."""
        sends, self._sends = self._sends, []
        node, attempts = self.bench.node, (1, MOST_ATTEMPTS)
        return [wire.WireSendResult(node, one, time_ns, one % 2 == 0, attempts[one % 2]) for one in sends]

    def start(self) -> None:
        """Start the agent and check its first hello."""
        self.nonce, self.silent = b"", True
        self._numbers.clear()
        self._sends.clear()
        self.bench.start_agent()
        self.findings.expect("starts", "hello", "version", "nonce")
        start_up_s = max(self.patience_s, START_UP_S)
        hello, data = self.await_message(wire.Hello, "hello", start_up_s, stays="starts")
        node, length = self.bench.node, len(hello.nonce)
        sound = {
            f"node {hello.node!r}, process_id {hello.process_id!r}": hello.node == hello.process_id == node,
            f"ready = {hello.ready}, failure = {hello.failure!r}": not hello.ready and hello.failure is None,
            f"a nonce of {counted(length, 'byte')}": length >= SHORTEST_NONCE,
        }
        for came, is_sound in sound.items():
            if not is_sound:
                self.findings.fail("hello", came, data)
        if hello.version != wire.VERSION:
            self.findings.fail("version", f"version = {hello.version}", data)
        self.nonce = hello.nonce

    def join(self, **welcome: Any) -> None:
        """Start the agent, welcome it, and wait until it is ready."""
        self.start()
        self.be_welcome(**welcome)

    def be_welcome(self, **welcome: Any) -> None:
        """Welcome the agent and wait until it is ready."""
        self.bench.say(self.make_welcome(self.nonce, **welcome))
        start_up_s = max(self.patience_s, START_UP_S)
        hello, data = self.await_message(wire.Hello, "ready", start_up_s, _is_an_answer)
        if hello.failure is not None:
            raise self.over("ready", f"failure = {hello.failure!r}", data)
        self.findings.expect("token", "silence")
        if next(self.hear(QUIET_S), None) is not None:
            self.check_stays()
        if not self.bench.present:
            self.findings.fail("token", "no token")
        self.silent = False

    def make_welcome(self, nonce: bytes, incarnation: int = 0, runs: bool = True, **other: Any) -> wire.Welcome:
        """The welcome of the scenario's first vehicle."""
        told = {"pacing": self.pacing, "orphan_timeout_s": ORPHAN_TIMEOUT_S, **other}
        welcome = self.emulation.welcome(self.bench.node, nonce)
        return replace(welcome, incarnation=incarnation, runs=runs, **told)

    def await_exit(self, check: str, timeout_s: float, fails: bool) -> float:
        """Wait until the agent ends; returns after how many seconds it did."""
        self.findings.expect(check)
        started_s = time.monotonic()
        while self.bench.exit_status is None:
            if time.monotonic() > started_s + timeout_s:
                raise self.over(check, f"it still runs after {timeout_s:g} s")
            self.bench.hear(POLL_S)
        if fails is (self.bench.exit_status == 0):
            self.findings.fail(check, self.bench.end)
        return time.monotonic() - started_s

    def ask_stack(self, timeout_s: float, stays: str = "stays") -> None:
        """Ask for the stack until it comes: also how an emulator finds out whether messages pass.

        `stays` is the check that has failed if the agent ends instead.
        """
        self.findings.expect("stack")
        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            self.bench.say(wire.StackRequest())
            if any(isinstance(said.message, wire.StackDump) for said in self.hear(ASK_EVERY_S)):
                self.until_quiet()  # answers to earlier requests
                return
            self.check_stays(stays)
        raise self.over("stack", f"no StackDump within {timeout_s:g} s")

    def fix(self, period: int) -> wire.WireFix:
        """A fix of the vehicle's own receiver."""
        return wire.WireFix.of(self.bench.node, self.emulation.world.fix(period, 0))

    def packet(self, number: int, sent_ns: int, received_ns: int) -> wire.WirePacket:
        """A packet from another vehicle; its payload may be anything that the radio can bring."""
        payloads = (*PAYLOADS, bytes(self.emulation.scenario.radio.max_payload_bytes))
        payload = payloads[number % len(payloads)]
        return wire.WirePacket(self.bench.node, "another", sent_ns, received_ns, payload)


def _is_an_answer(hello: wire.Hello) -> bool:
    return hello.ready or hello.failure is not None


def _numbers(report: Report) -> Iterator[float]:
    yield from report.estimate_m or ()
    yield from report.covariance_m2 or ()
    for value in report.values.values():
        if not isinstance(value, str):
            yield from value if isinstance(value, list) else [value]
