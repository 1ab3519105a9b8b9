"""The parts that all scenes share: welcome and fixes of a small world, joining, ending, waiting for an answer."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal, TypeVar

from emulator.radio.dot11p import abilities_of
from emulator.scenario.scenario import Scenario
from emulator.testing.conformance.bench import Bench, Said
from emulator.testing.conformance.findings import Findings, counted
from emulator.testing.conformance.inspection import Inspection
from emulator.world.world import World
from vnet.transport import wire

ORPHAN_TIMEOUT_S = 1.0
"""Time that an agent waits for an emulator that is gone, as the welcome says."""
QUIET_S = 0.3
"""Time that a scene listens for messages that must not come."""
SHORTEST_NONCE = 8
OTHERS_NONCE = b"of another session"
PAYLOADS = (b"a packet", b"", b"\xc1 no msgpack", b"\x81\xa1x")
"""Payloads of the packets that the agent receives, in turn: the radio may bring anything."""

M = TypeVar("M", bound=wire.AgentMessage)


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


START_UP_S = 20.0
"""Time that a process may take to start and to load its program."""
WAIT_S = 0.05


def _is_an_answer(hello: wire.Hello) -> bool:
    """True if a hello answers the welcome."""
    return hello.ready or hello.failure is not None
