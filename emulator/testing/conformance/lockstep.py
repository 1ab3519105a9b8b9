"""Scenes in lockstep: a small emulator that grants what the agent waits for, and checks each yield.

Windows are as long as the least latency of the scenario's radio, so some grants bring packets that are yet to come.
"""

from __future__ import annotations

from emulator.scenario.scenario import least_latency_ns
from emulator.testing.conformance.scene import QUIET_S, Scene, SceneOverError, absence, ask_stack, orphan
from vnet.transport import wire
from vnet.transport.wire import WireSendResult
from vnet.units import NS_PER_S

DURATION_NS = NS_PER_S
MOST_GRANTS = 2000
PACKET_AFTER_NS = 30_000_000
"""Time from each fix to the arrival of a packet."""
EARLY_PACKET_AFTER_NS = 1_000_000
"""Time from each fix to the arrival of a packet in the window that begins with the fix."""
CLOCK_ERROR_NS = 5_000_000
MALFORMED = (b"\xc1", b"", b"\x93\xa5Grant\xa1x", b"\x91\xa9Nonsense1", b"\x81\x01\x02")
"""No msgpack, nothing, a wrong type, an unknown kind, a map."""


class Barrier:
    """Grants one agent what it waits for, from `now_ns` on."""

    def __init__(self, scene: Scene, now_ns: int = 0) -> None:
        self.scene = scene
        self.now_ns = now_ns
        self.seq = 0
        self._offset_ns = 0
        self._next_fix = -(-now_ns // scene.world.period_ns)
        self._start_ns = now_ns
        self._window_ns = least_latency_ns(scene.scenario.radio)
        self._count = 0
        self._answer: wire.Yield | None = None
        self._results: list[WireSendResult] = []

    def run(self, until_ns: int, clock_error_at_ns: int | None = None) -> None:
        """Grant the first instant, and a window from each instant before `until_ns` that the agent waits for."""
        answer = self._answer or self.grant()
        while (wake_ns := self._wake_ns(answer)) is not None and wake_ns < until_ns and self.seq < MOST_GRANTS:
            self.now_ns = wake_ns
            clocks = []
            if clock_error_at_ns is not None and wake_ns >= clock_error_at_ns:
                self._offset_ns, clock_error_at_ns = CLOCK_ERROR_NS, None
                clocks = [wire.ClockError(self.scene.bench.node, wake_ns, CLOCK_ERROR_NS)]
            answer = self.grant(clocks)

    def _wake_ns(self, answer: wire.Yield) -> int | None:
        """Time of the agent's next grant."""
        due_ns = [answer.next_timer_ns]
        due_ns += [self._next_fix * self.scene.world.period_ns] if answer.waiting_gnss else []
        due_ns += [self._next_packet_ns()] if answer.waiting_radio else []
        due_ns += [result.time_ns for result in self._results]
        return min((time_ns for time_ns in due_ns if time_ns is not None), default=None)

    def _next_packet_ns(self) -> int:
        after_ns = PACKET_AFTER_NS if self._count % 2 else EARLY_PACKET_AFTER_NS
        return self._start_ns + self._count // 2 * self.scene.world.period_ns + after_ns

    def grant(self, clocks: list[wire.ClockError] | None = None) -> wire.Yield:
        """Grant the window from this instant on, with all that is due in it, and check the yield."""
        scene = self.scene
        end_ns = self.now_ns + self._window_ns
        packets = []
        while (received_ns := self._next_packet_ns()) < end_ns:
            packets.append(scene.packet(self._count, max(received_ns - self._window_ns, 0), received_ns))
            self._count += 1
        fixes = []
        while self._next_fix * scene.world.period_ns <= self.now_ns:
            fixes.append(scene.fix(self._next_fix))
            self._next_fix += 1
        results, self._results = self._results, []
        grant = wire.Grant(self.seq, self.now_ns, end_ns, packets, fixes, clocks or [], results=results)
        scene.bench.say(grant)
        answer, said = scene.await_message(wire.Yield, "yields", scene.patience_s)
        if answer.seq != self.seq:
            scene.findings.fail("yields", f"seq = {answer.seq}, and not {self.seq}", said.data)
            raise SceneOverError
        self.seq += 1
        scene.inspection.inspect_yield(answer, said.data, grant, self._offset_ns)
        if answer.next_timer_ns is not None and answer.next_timer_ns < end_ns:
            raise SceneOverError
        self._answer = answer
        self._results = scene.inspection.take_results(end_ns)
        return answer

    def check_quiet(self) -> None:
        """Nothing is said without a grant."""
        self.scene.findings.expect("unasked")
        said = self.scene.hear(QUIET_S)
        if said is not None and isinstance(said.message, wire.Yield):
            self.scene.findings.fail("unasked", f"Yield {said.message.seq}", said.data)


def run(scene: Scene) -> None:
    """A second of a run: fixes, packets, a clock that goes wrong, and the end."""
    scene.join()
    barrier = Barrier(scene)
    barrier.run(DURATION_NS // 2)
    barrier.check_quiet()
    ask_stack(scene, scene.patience_s)
    barrier.run(DURATION_NS, clock_error_at_ns=DURATION_NS * 7 // 10)
    barrier.check_quiet()
    scene.end()


def restart(scene: Scene) -> None:
    """The process is started again by a fault, in the middle of a run."""
    scene.join()
    Barrier(scene).run(DURATION_NS // 4)
    before = scene.nonce
    scene.bench.say(wire.End(None, "restarted by a fault"))
    scene.await_exit("ends", scene.patience_s, fails=False)
    scene.nonce, scene.silent = b"", True
    scene.join(incarnation=1)
    scene.findings.expect("new_nonce")
    if scene.nonce == before:
        scene.findings.fail("new_nonce", "the same")
    Barrier(scene, now_ns=2_345_000_000).run(2_345_000_000 + DURATION_NS // 4)
    scene.end()


def ended(scene: Scene) -> None:
    """The program has ended before the process was started again: it takes part, and says nothing."""
    scene.join(incarnation=1, runs=False)
    scene.findings.expect("no_traffic")
    scene.bench.say(wire.Grant(0, NS_PER_S, NS_PER_S + 1, [], [scene.fix(NS_PER_S // scene.world.period_ns)]))
    answer, said = scene.await_message(wire.Yield, "yields", scene.patience_s)
    has_traffic = any(step.traffic.frames or step.traffic.reports for step in answer.steps)
    if has_traffic or answer.waiting_gnss or answer.waiting_radio:
        scene.findings.fail("no_traffic", "traffic, or a node that waits", said.data)
    scene.end()


def malformed(scene: Scene) -> None:
    """Bytes that are no message come between two grants."""
    scene.join()
    barrier = Barrier(scene)
    barrier.run(DURATION_NS // 4)
    say_malformed(scene)
    barrier.run(DURATION_NS // 2)
    scene.end()


def say_malformed(scene: Scene) -> None:
    """Say what is malformed; the agent is to drop it and go on."""
    scene.findings.expect("malformed")
    for data in MALFORMED:
        scene.bench.say(data)
    for said in scene.until_quiet():
        if isinstance(said.message, wire.Yield):
            scene.findings.fail("malformed", "a Yield", said.data)
    ask_stack(scene, scene.patience_s, stays="malformed")  # its answer comes after all of them


def lost(scene: Scene) -> None:
    """The emulator is killed."""
    scene.join()
    Barrier(scene).run(DURATION_NS // 4)
    orphan(scene)


def away(scene: Scene) -> None:
    """The emulator is restarted."""
    scene.join()
    barrier = Barrier(scene)
    barrier.run(DURATION_NS // 4)
    absence(scene)
    barrier.run(DURATION_NS // 2)
    scene.end()
