"""Scenes in real time: batches on the wall clock, and a check of the frames and acknowledgements that come back."""

from __future__ import annotations

import time

from emulator.testing.conformance.lockstep import PACKET_AFTER_NS, say_malformed
from emulator.testing.conformance.scene import Said, Scene, absence, ask_stack, orphan
from vnet.transport import wire
from vnet.units import NS_PER_S

ACKNOWLEDGE_S = 2.0
"""An agent gives a sign of life once a second; as long again for the way and a busy machine."""
FINAL_S = 1.0
"""Time that an agent may take for its last message."""
GAP = (4, 5)
"""Batches that are not sent."""
HELD = 8
"""The batch with packets that waited for a paused process."""
LATE = 10
"""The batch that comes as late, without a reason: lateness shows it."""
ELSEWHERE = "the boot of another machine"
RESTARTED_NS = 2_345_000_000


class Clock:
    """Sends batches when they are due, and checks what comes back."""

    def __init__(self, scene: Scene, start_ns: int = 0, elsewhere: bool = False) -> None:
        self.scene = scene
        self._start_ns = start_ns
        self._elsewhere = elsewhere
        self._seq = 0
        self._frames_seq: int | None = 0
        self._received_seq = 0
        self._missed: list[tuple[int, int]] = []
        self._timed = 0
        self._lateness: list[int] = []
        self._late_ns = 0
        self._next_fix = -(-start_ns // scene.world.period_ns)
        self._origin_ns = 0
        self.final = False
        scene.take_frames = self._take

    def _now_ns(self, at_ns: int | None = None) -> int:
        return (time.monotonic_ns() if at_ns is None else at_ns) - self._origin_ns

    def start(self) -> None:
        """Send batch 0. To another machine, the origin on this one's clock says nothing."""
        head_start_ns = 0 if self._start_ns else wire.HEAD_START_NS
        self._origin_ns = time.monotonic_ns() + head_start_ns - self._start_ns
        told_ns = 10**18 if self._elsewhere else self._origin_ns
        self.scene.bench.say(wire.Batch([], self._seq, [], told_ns, self._start_ns))
        self._seq += 1

    def run(self, until_ns: int, special: bool = False) -> None:
        """Send what is due until `until_ns`; if `special`, with a gap and a batch that was held."""
        scene, period_ns = self.scene, self.scene.world.period_ns
        while (due_ns := self._next_fix * period_ns) < until_ns:
            self.listen_until(due_ns)
            self.send(due_ns, special)
            self._next_fix += 1
        self.listen_until(until_ns)
        scene.check_stays()

    def send(self, due_ns: int, special: bool) -> None:
        """Send, or lose, the batch of an instant."""
        scene = self.scene
        skipped, held, late = (special and self._seq in seqs for seqs in (GAP, (HELD,), (LATE,)))
        received_ns = due_ns - scene.world.period_ns + PACKET_AFTER_NS if held or late else due_ns
        if late:
            self._late_ns = due_ns - received_ns
        packets = [scene.packet(self._seq, received_ns - 1_000_000, received_ns)] if received_ns > 0 else []
        if not skipped:
            results = scene.inspection.take_results(due_ns)
            scene.bench.say(wire.Batch([scene.fix(self._next_fix)], self._seq, packets, held=held, results=results))
            self._timed += 0 if held else len(packets)
        elif self._missed and self._missed[-1][1] == self._seq - 1:
            self._missed[-1] = (self._missed[-1][0], self._seq)
        else:
            self._missed.append((self._seq, self._seq))
        self._seq += 1

    def listen_until(self, time_ns: int) -> None:
        """Take what the agent says until this instant of the run."""
        while (wait_ns := time_ns - self._now_ns()) > 0:
            said = self.scene.hear(wait_ns / 1e9)
            if said is None and self.scene.bench.agent.exit_status is not None:
                self.scene.check_stays()

    def _take(self, said: Said) -> None:
        message, data, at_ns, findings = said.message, said.data, said.at_ns, self.scene.findings
        assert isinstance(message, wire.Frames)
        findings.expect("frames_seq", "missed", "acknowledges")
        if self._frames_seq is not None and message.seq != self._frames_seq:
            findings.fail("frames_seq", f"seq = {message.seq}, and not {self._frames_seq}", data)
        self._frames_seq = message.seq + 1
        if not self._received_seq <= message.received_seq <= self._seq:
            findings.fail("acknowledges", f"received_seq = {message.received_seq}: {self._seq} were sent", data)
        self._received_seq = message.received_seq
        for first, last in message.missed:
            if (first, last) not in self._missed:
                findings.fail("missed", f"[{first}, {last}]", data)
            else:
                self._missed.remove((first, last))
        if message.lateness is not None:
            self._take_lateness(list(message.lateness.counts), data)
        self.scene.inspection.inspect_frames(message, data, self._now_ns(at_ns))
        self.final = self.final or message.final

    def _take_lateness(self, counts: list[int], data: bytes) -> None:
        self.scene.findings.expect("lateness")
        pairs = zip(self._lateness or counts, counts, strict=False)
        if len(counts) != wire.LATENESS_BINS or any(before > now for before, now in pairs):
            self.scene.findings.fail("lateness", f"{len(counts)} bins, or a count that has become less", data)
        elif sum(counts) > self._timed:
            self.scene.findings.fail("lateness", f"{sum(counts)} packets, where {self._timed} were sent", data)
        self._lateness = counts

    def be_absent(self) -> None:
        """Go away and come back: what the agent said meanwhile is lost."""
        self.scene.take_frames = None
        absence(self.scene)
        self.scene.take_frames, self._frames_seq = self._take, None

    def check_acknowledged(self) -> None:
        """Wait until all batches are acknowledged, and the gaps are named."""
        self.scene.findings.expect("acknowledges", "missed")
        deadline_ns = self._now_ns() + round(ACKNOWLEDGE_S * NS_PER_S)
        while self._received_seq < self._seq and self._now_ns() < deadline_ns:
            self.listen_until(min(self._now_ns() + 20_000_000, deadline_ns))
        if self._received_seq < self._seq:
            came = f"received_seq = {self._received_seq} {ACKNOWLEDGE_S:g} s after batch {self._seq - 1}"
            self.scene.findings.fail("acknowledges", came)
        elif self._missed:
            self.scene.findings.fail("missed", f"nothing of {list(map(list, self._missed))}")
        if self._late_ns and not sum(self._lateness[wire.lateness_bin(self._late_ns) :]):
            late_ms = self._late_ns / 1e6
            self.scene.findings.fail("lateness", f"no packet {late_ms:g} ms late or more, where one was")

    def end(self) -> None:
        """The run is over: a final message, then exit status 0."""
        scene = self.scene
        scene.findings.expect("final")
        scene.bench.say(wire.End(None, "the run is over"))
        deadline_ns = self._now_ns() + round(FINAL_S * NS_PER_S)
        while not self.final and self._now_ns() < deadline_ns:
            if scene.hear((deadline_ns - self._now_ns()) / 1e9) is None:
                break
        if not self.final:
            scene.findings.fail("final", f"no such Frames within {FINAL_S:g} s")
        scene.await_exit("ends", scene.patience_s, fails=False)


def run(scene: Scene) -> None:
    """Some seconds of a run: fixes, packets, batches that are lost, one that was held, and the end."""
    scene.join()
    clock = Clock(scene)
    clock.start()
    clock.run(12 * scene.world.period_ns, special=True)
    clock.check_acknowledged()
    ask_stack(scene, scene.patience_s)
    clock.end()


def restart(scene: Scene) -> None:
    """The process is started again by a fault, in the middle of a run."""
    scene.join(incarnation=1)
    clock = Clock(scene, RESTARTED_NS)
    clock.start()
    clock.run(RESTARTED_NS + NS_PER_S // 2)
    clock.end()


def elsewhere(scene: Scene) -> None:
    """The emulator is on another machine, whose monotonic clock is not this one's."""
    scene.join(boot_id=ELSEWHERE)
    clock = Clock(scene, elsewhere=True)
    clock.start()
    clock.run(NS_PER_S // 2)
    clock.end()


def malformed(scene: Scene) -> None:
    """Bytes that are no message come between two batches."""
    scene.join()
    clock = Clock(scene)
    clock.start()
    clock.run(NS_PER_S // 4)
    say_malformed(scene)
    clock.check_acknowledged()
    clock.end()


def lost(scene: Scene) -> None:
    """The emulator is killed."""
    scene.join()
    clock = Clock(scene)
    clock.start()
    clock.run(NS_PER_S // 4)
    orphan(scene)


def away(scene: Scene) -> None:
    """The emulator is restarted."""
    scene.join()
    clock = Clock(scene)
    clock.start()
    clock.run(NS_PER_S // 4)
    clock.be_absent()
    clock.run(2 * NS_PER_S)
    clock.end()
