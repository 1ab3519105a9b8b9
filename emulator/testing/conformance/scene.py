"""The test bench of an agent, and what its scenes share: checks of single messages, joining and ending."""

from __future__ import annotations

import math
import os
import queue
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

import zenoh

from emulator.radio.dot11p import abilities_of
from emulator.radio.unicast import MOST_ATTEMPTS
from emulator.scenario.scenario import Scenario
from emulator.testing.conformance.findings import Findings, counted, decoding_problem
from emulator.world.world import World
from vnet.errors import VnetError
from vnet.reports import Report
from vnet.transport import keys, wire
from vnet.transport.access import Access, node_user
from vnet.transport.credentials import write_private
from vnet.transport.session import AGENT_RUNTIME, open_router, router_endpoint
from vnet.transport.wire import WireSendResult

LEASE_MS = 60_000
POLL_S = 0.02
KILL_WAIT_S = 5.0
PLACEHOLDERS = ("{endpoint}", "{run}", "{node}", "{credentials}")
OF_TRAFFIC = ("own_node", "payload", "sends", "numbers", "report_time")
OF_YIELDS = ("timers", "steps", "wakes", *OF_TRAFFIC)
SLACK_NS = 50_000_000
"""Real time: how much the two clocks of one machine may seem to differ."""
OLDEST_NS = 1_000_000_000
"""Real time: a report is on its way for less than this."""
ORPHAN_TIMEOUT_S = 1.0
"""Time that an agent waits for an emulator that is gone, as the welcome says."""
QUIET_S = 0.3
"""Time that a scene listens for messages that must not come."""
SHORTEST_NONCE = 8
OTHERS_NONCE = b"of another session"
PAYLOADS = (b"a packet", b"", b"\xc1 no msgpack", b"\x81\xa1x")
"""Payloads of the packets that the agent receives, in turn: the radio may bring anything."""
M = TypeVar("M", bound=wire.AgentMessage)
START_UP_S = 20.0
"""Time that a process may take to start and to load its program."""
WAIT_S = 0.05
HELLO_WAIT_S = 2.0
AWAY_S = 1.5 * ORPHAN_TIMEOUT_S
RETURN_WITHIN_S = 15.0
WARNING_S = 0.2
ASK_EVERY_S = 0.2


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


class Inspection:
    """Checks messages of `node` and notes what is wrong in `findings`."""

    def __init__(self, findings: Findings, node: str, max_payload: int) -> None:
        self._findings = findings
        self._node = node
        self._max_payload = max_payload
        self._numbers: set[int] = set()
        self._sends: list[int] = []

    def begin(self) -> None:
        """Begin with a process that has sent nothing yet."""
        self._numbers.clear()
        self._sends.clear()

    def take_results(self, time_ns: int) -> list[WireSendResult]:
        """Return results at `time_ns` of the frames to single vehicles that have none: every other one failed."""
        sends, self._sends = self._sends, []
        return [
            WireSendResult(self._node, number, time_ns, number % 2 == 0, 1 if number % 2 == 0 else MOST_ATTEMPTS)
            for number in sends
        ]

    @property
    def is_sending(self) -> bool:
        """True if frames to single vehicles have no result yet."""
        return bool(self._sends)

    def inspect_yield(self, message: wire.Yield, data: bytes, grant: wire.Grant, offset_ns: int) -> None:
        """Check the answer to a grant; the vehicle's clock is ahead by `offset_ns`."""
        self._findings.expect(*OF_YIELDS)
        timer_ns = message.next_timer_ns
        if timer_ns is not None and timer_ns < grant.end_ns:
            self._findings.fail("timers", f"next_timer_ns = {timer_ns} in a window to {grant.end_ns}", data)
        for node in [*message.waiting_radio, *message.waiting_gnss]:
            self._check_node(node, "a waiting node", data)
        earliest_ns = grant.time_ns
        for step in message.steps:
            if not earliest_ns <= step.time_ns < grant.end_ns:
                came = f"a step at {step.time_ns}, where {earliest_ns} to {grant.end_ns - 1} are allowed"
                self._findings.fail("steps", came, data)
            earliest_ns = step.time_ns + 1
            self._inspect_traffic(step.traffic, data)
            for report in step.traffic.reports:
                if report.time_ns != (shown_ns := step.time_ns + offset_ns):
                    self._findings.fail("report_time", f"time_ns = {report.time_ns}, and not {shown_ns}", data)
        waits = timer_ns is not None or message.waiting_radio or message.waiting_gnss or self.is_sending
        if not waits and not any(step.traffic.endings for step in message.steps):
            self._findings.fail("wakes", "it waits for nothing and is never granted again", data)

    def inspect_frames(self, message: wire.Frames, data: bytes, now_ns: int) -> None:
        """Check traffic in real time that came at `now_ns`."""
        self._findings.expect(*OF_TRAFFIC)
        self._inspect_traffic(message.traffic, data)
        for report in message.traffic.reports:
            if not now_ns - OLDEST_NS <= report.time_ns <= now_ns + SLACK_NS:
                self._findings.fail("report_time", f"time_ns = {report.time_ns}, received at {now_ns}", data)

    def _inspect_traffic(self, traffic: wire.Traffic, data: bytes) -> None:
        parts: list[wire.Frame | Report | wire.Ending] = [*traffic.frames, *traffic.reports, *traffic.endings]
        for part in parts:
            self._check_node(part.node, f"a {type(part).__name__.lower()}", data)
        for frame in traffic.frames:
            if (size := len(frame.payload)) > self._max_payload:
                self._findings.fail("payload", f"{size} bytes, where {self._max_payload} are allowed", data)
            if frame.to is not None:
                if frame.number in self._numbers:
                    self._findings.fail("sends", f"a second frame with number {frame.number}", data)
                self._numbers.add(frame.number)
                self._sends.append(frame.number)
        for report in traffic.reports:
            if not all(map(math.isfinite, _numbers(report))):
                self._findings.fail("numbers", "a report with a number that is not finite", data)

    def _check_node(self, node: str, what: str, data: bytes) -> None:
        if node != self._node:
            self._findings.fail("own_node", f"{what} of {node!r}", data)


def _numbers(report: Report) -> Iterator[float]:
    yield from report.estimate_m or ()
    yield from report.covariance_m2 or ()
    for value in report.values.values():
        if not isinstance(value, str):
            yield from value if isinstance(value, list) else [value]


class SceneOverError(Exception):
    """The scene cannot go on; the reason has been noted."""


@dataclass
class Scene:
    """One scene: the agent is started, is told what the scene says, and has each answer checked."""

    bench: Bench
    findings: Findings
    scenario: Scenario
    world: World
    pacing: Literal["lockstep", "realtime"]
    patience_s: float
    welcome: wire.Welcome = field(init=False)
    nonce: bytes = b""
    silent: bool = True
    """True while only Hello and StackDump are allowed, before the run begins."""
    take_frames: Callable[[Said], None] | None = None
    """Function that counts the Frames of a real-time run, in whichever step of the scene they arrive."""

    def __post_init__(self) -> None:
        limit = self.scenario.radio.max_payload_bytes
        self.inspection = Inspection(self.findings, self.bench.node, limit)

    # Messages.

    def hear(self, timeout_s: float) -> Said | None:
        """The next message of the agent that decodes and bears its nonce."""
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
                if self.take_frames is not None and isinstance(said.message, wire.Frames):
                    self.take_frames(said)
                return said
        return None

    def until_quiet(self) -> Iterator[Said]:
        """Yield messages until nothing but Frames has come for `QUIET_S`, for `patience_s` at most."""
        deadline_s = time.monotonic() + self.patience_s
        quiet_s = time.monotonic() + QUIET_S
        while (wait_s := min(quiet_s, deadline_s) - time.monotonic()) > 0:
            said = self.hear(wait_s)
            if said is not None and not isinstance(said.message, wire.Frames):
                quiet_s = time.monotonic() + QUIET_S
                yield said

    def await_message(
        self,
        kind: type[M],
        check: str,
        timeout_s: float,
        fits: Callable[[M], bool] = lambda message: True,
        stays: str = "stays",
    ) -> tuple[M, Said]:
        """Wait for a message of this kind that fits; others are passed over.

        If it does not come the scene is over, and `check` has failed, or `stays` where the agent has ended.
        """
        self.findings.expect(check)
        deadline_s = time.monotonic() + timeout_s
        last: Said | None = None
        while (wait_s := deadline_s - time.monotonic()) > 0 and (said := self.hear(wait_s)) is not None:
            if isinstance(said.message, kind) and fits(said.message):
                return said.message, said
            last = said
        self.check_stays(stays)
        came = f"no {kind.__name__} within {timeout_s:g} s"
        self.findings.fail(check, came, None if last is None else last.data)
        raise SceneOverError

    def check_stays(self, check: str = "stays") -> None:
        """End the scene if the agent has ended, although it was not told to."""
        self.findings.expect(check)
        if (status := self.bench.agent.exit_status) is not None:
            self.findings.fail(check, f"exit status {status}: {self.bench.agent.last_words()}")
            raise SceneOverError

    # Joining and ending.

    def start(self) -> wire.Hello:
        """Start the agent and wait for its first hello."""
        self.bench.start_agent()
        self.inspection.begin()
        self.findings.expect("starts", "hello", "version", "nonce")
        start_up_s = max(self.patience_s, START_UP_S)
        hello, said = self.await_message(wire.Hello, "hello", start_up_s, stays="starts")
        node = self.bench.node
        if (hello.node, hello.process_id) != (node, node):
            self.findings.fail("hello", f"node {hello.node!r}, process_id {hello.process_id!r}", said.data)
        if hello.ready or hello.failure is not None:
            self.findings.fail("hello", f"ready = {hello.ready}, failure = {hello.failure!r}", said.data)
        if hello.version != wire.VERSION:
            self.findings.fail("version", f"version = {hello.version}", said.data)
        if len(hello.nonce) < SHORTEST_NONCE:
            self.findings.fail("hello", f"a nonce of {counted(len(hello.nonce), 'byte')}", said.data)
        self.nonce = hello.nonce
        return hello

    def join(self, incarnation: int = 0, boot_id: str | None = None, runs: bool = True) -> None:
        """Start the agent, welcome it, and wait until it is ready."""
        self.start()
        self.be_welcome(incarnation, boot_id, runs)

    def be_welcome(self, incarnation: int = 0, boot_id: str | None = None, runs: bool = True) -> None:
        """Welcome the agent and wait until it is ready."""
        self.welcome = self.make_welcome(self.nonce, incarnation, boot_id, runs)
        self.bench.say(self.welcome)
        hello, said = self.await_message(wire.Hello, "ready", max(self.patience_s, START_UP_S), _is_an_answer)
        if hello.failure is not None:
            self.findings.fail("ready", f"failure = {hello.failure!r}", said.data)
            raise SceneOverError
        self.findings.expect("token", "silence")
        if self.hear(QUIET_S) is not None and self.bench.agent.exit_status is not None:
            self.check_stays()
        if not self.bench.present:
            self.findings.fail("token", "no token")
        self.silent = False

    def make_welcome(
        self, nonce: bytes, incarnation: int = 0, boot_id: str | None = None, runs: bool = True
    ) -> wire.Welcome:
        """The welcome of the scenario's first vehicle."""
        node = self.bench.node
        program = self.scenario.program.of(node)
        abilities = abilities_of(self.scenario.radio)
        return wire.Welcome(
            node=node,
            nonce=nonce,
            incarnation=incarnation,
            pacing=self.pacing,
            entry=program.entry,
            options=program.options,
            lane_map=self.world.lane_map.to_wire(),
            seed=1,
            period_ns=self.world.period_ns,
            max_payload=self.scenario.radio.max_payload_bytes,
            orphan_timeout_s=ORPHAN_TIMEOUT_S,
            spin_limit=self.scenario.run.spin_limit,
            boot_id=wire.boot_id() if boot_id is None else boot_id,
            runs=runs,
            version=wire.VERSION,
            max_power_dbm=abilities.max_power_dbm,
            rates_mbps=abilities.rates_mbps,
            acknowledges=abilities.acknowledges,
        )

    def end(self) -> None:
        """Tell the agent that the run is over; it is to end with exit status 0."""
        self.bench.say(wire.End(None, "the run is over"))
        self.await_exit("ends", self.patience_s, fails=False)

    def await_exit(self, check: str, timeout_s: float, fails: bool) -> float:
        """Wait until the agent ends; returns after how many seconds it did."""
        self.findings.expect(check)
        started_s = time.monotonic()
        while self.bench.agent.exit_status is None:
            if time.monotonic() > started_s + timeout_s:
                self.findings.fail(check, f"it still runs after {timeout_s:g} s")
                raise SceneOverError
            self.bench.hear(WAIT_S)
        status = self.bench.agent.exit_status
        if fails is (status == 0):
            self.findings.fail(check, f"exit status {status}: {self.bench.agent.last_words()}")
        return time.monotonic() - started_s

    # The world.

    def fix(self, period: int) -> wire.WireFix:
        """A fix of the vehicle's own receiver."""
        return wire.WireFix.of(self.bench.node, self.world.fix(period, 0))

    def packet(self, number: int, sent_ns: int, received_ns: int) -> wire.WirePacket:
        """A packet from another vehicle; its payload may be anything that the radio can bring."""
        limit = self.scenario.radio.max_payload_bytes
        payload = (*PAYLOADS, bytes(limit))[number % (len(PAYLOADS) + 1)]
        return wire.WirePacket(self.bench.node, "another", sent_ns, received_ns, payload)


def _is_an_answer(hello: wire.Hello) -> bool:
    """True if a hello answers the welcome."""
    return hello.ready or hello.failure is not None


def joining(scene: Scene) -> None:
    """The welcome keeps the agent waiting, and what is meant for others comes first."""
    hello = scene.start()
    scene.findings.expect("hello_repeats", "others_nonce")
    again, said = scene.await_message(wire.Hello, "hello_repeats", HELLO_WAIT_S)
    if again.nonce != hello.nonce:
        scene.findings.fail("hello_repeats", "another nonce", said.data)
    scene.bench.say(scene.make_welcome(OTHERS_NONCE))
    scene.bench.say(wire.End(OTHERS_NONCE, "another session is refused", refused=True))
    deadline_s = time.monotonic() + QUIET_S
    while (wait_s := deadline_s - time.monotonic()) > 0 and (heard := scene.hear(wait_s)) is not None:
        if isinstance(heard.message, wire.Hello) and heard.message.ready:
            scene.findings.fail("others_nonce", "ready after another's welcome", heard.data)
            raise SceneOverError
    if (status := scene.bench.agent.exit_status) is not None:
        scene.findings.fail("others_nonce", f"exit status {status} after another's End")
        raise SceneOverError
    scene.be_welcome()
    scene.end()


def refusal(scene: Scene) -> None:
    """The hello is refused."""
    scene.start()
    scene.bench.say(wire.End(scene.nonce, "a second login of a node that is present", refused=True))
    scene.await_exit("refused", scene.patience_s, fails=True)


def orphan(scene: Scene) -> None:
    """The emulator goes away without a word, and does not come back."""
    scene.bench.close()
    took_s = scene.await_exit("orphan", ORPHAN_TIMEOUT_S + scene.patience_s, fails=True)
    if took_s < 0.8 * ORPHAN_TIMEOUT_S:
        scene.findings.fail("orphan", f"it ended after {took_s:.2f} s of {ORPHAN_TIMEOUT_S:g} s")


def absence(scene: Scene) -> None:
    """The emulator announces that it will be back, goes for longer than agents wait unasked, and comes back."""
    scene.findings.expect("waits")
    scene.bench.say(wire.Await(RETURN_WITHIN_S))
    scene.bench.hear(WARNING_S)
    scene.bench.close()
    deadline_s = time.monotonic() + AWAY_S
    while time.monotonic() < deadline_s:
        scene.bench.hear(ASK_EVERY_S)
        if (status := scene.bench.agent.exit_status) is not None:
            scene.findings.fail("waits", f"exit status {status}: {scene.bench.agent.last_words()}")
            raise SceneOverError
    scene.bench.open()
    ask_stack(scene, RETURN_WITHIN_S)


def ask_stack(scene: Scene, timeout_s: float, stays: str = "stays") -> None:
    """Ask for the stack until it comes: also how an emulator finds out whether messages pass.

    `stays` is the check that has failed if the agent ends instead.
    """
    deadline_s = time.monotonic() + timeout_s
    scene.findings.expect("stack")
    while time.monotonic() < deadline_s:
        scene.bench.say(wire.StackRequest())
        wait_s = time.monotonic() + ASK_EVERY_S
        while (left_s := wait_s - time.monotonic()) > 0 and (said := scene.hear(left_s)) is not None:
            if isinstance(said.message, wire.StackDump):
                for _ in scene.until_quiet():  # answers to earlier requests
                    pass
                return
        scene.check_stays(stays)
    scene.findings.fail("stack", f"no StackDump within {timeout_s:g} s")
    raise SceneOverError
