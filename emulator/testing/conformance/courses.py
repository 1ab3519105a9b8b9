"""Courses of a run with one agent: grants in lockstep, batches in real time, and checks of the answers.

Windows are as long as the least latency of the scenario's radio, so some grants bring packets that are yet to come.
"""

from __future__ import annotations

import time
from typing import Protocol

from emulator.drivers.processes import check_yield
from emulator.scenario.scenario import least_transit_ns
from emulator.testing.conformance.scene import QUIET_S, Said, Scene, SceneOverError
from vnet.transport import wire
from vnet.units import NS_PER_S

MOST_GRANTS = 2000
PACKET_AFTER_NS = (1_000_000, 30_000_000)
"""Times from each fix to the arrival of packets, the first in the window that begins with the fix."""
CLOCK_ERROR_NS = 5_000_000
CLOCK_ERROR_AT_NS = 700_000_000
SLACK_NS = 50_000_000
"""Real time: how much the two clocks of one machine may seem to differ."""
OLDEST_NS = 1_000_000_000
"""Real time: a report is on its way for less than this."""
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


class Course(Protocol):
    """A run as one agent sees it."""

    def run(self, until_ns: int, disturbed: bool = False) -> None:
        """Go on until this instant; if `disturbed`, with a wrong clock, or batches that are lost, held and late."""

    def settle(self) -> None:
        """Check that the agent has said all that it has to say, and no more."""

    def end(self, why: str = "the run is over") -> None:
        """Tell the agent that it is over; it is to end with exit status 0."""


class Barrier:
    """Lockstep: grants one agent what it waits for, from `now_ns` on, and checks each yield."""

    def __init__(self, scene: Scene, now_ns: int = 0) -> None:
        self.scene = scene
        self._now_ns = self._start_ns = now_ns
        self._seq = 0
        self._offset_ns = 0
        self._period_ns = scene.emulation.world.period_ns
        self._next_fix = -(-now_ns // self._period_ns)
        self._window_ns = least_transit_ns(scene.emulation.scenario.radio)
        self._count = 0
        self._answer: wire.Yield | None = None
        self._results: list[wire.WireSendResult] = []

    def run(self, until_ns: int, disturbed: bool = False) -> None:
        """Grant the first instant, and a window from each instant before `until_ns` that the agent waits for."""
        answer = self._answer or self.grant()
        while (wake_ns := self._wake_ns(answer)) is not None and wake_ns < until_ns and self._seq < MOST_GRANTS:
            self._now_ns = wake_ns
            clocks = []
            if disturbed and not self._offset_ns and wake_ns >= CLOCK_ERROR_AT_NS:
                self._offset_ns = CLOCK_ERROR_NS
                clocks = [wire.ClockError(self.scene.bench.node, wake_ns, CLOCK_ERROR_NS)]
            answer = self.grant(clocks)

    def _wake_ns(self, answer: wire.Yield) -> int | None:
        """Time of the agent's next grant."""
        due_ns = [answer.next_timer_ns]
        due_ns += [self._next_fix * self._period_ns] if answer.waiting_gnss else []
        due_ns += [self._next_packet_ns()] if answer.waiting_radio else []
        due_ns += [result.time_ns for result in self._results]
        return min((time_ns for time_ns in due_ns if time_ns is not None), default=None)

    def _next_packet_ns(self) -> int:
        return self._start_ns + self._count // 2 * self._period_ns + PACKET_AFTER_NS[self._count % 2]

    def grant(self, clocks: list[wire.ClockError] | None = None) -> wire.Yield:
        """Grant the window from this instant on, with all that is due in it, and check the yield."""
        scene, packets, fixes = self.scene, [], []
        end_ns = self._now_ns + self._window_ns
        while (received_ns := self._next_packet_ns()) < end_ns:
            packets.append(scene.packet(self._count, max(received_ns - self._window_ns, 0), received_ns))
            self._count += 1
        while self._next_fix * self._period_ns <= self._now_ns:
            fixes.append(scene.fix(self._next_fix))
            self._next_fix += 1
        results, self._results = self._results, []
        scene.bench.say(wire.Grant(self._seq, self._now_ns, end_ns, packets, fixes, clocks or [], results=results))
        answer, data = scene.await_message(wire.Yield, "yields", scene.patience_s)
        if answer.seq != self._seq:
            raise scene.over("yields", f"seq = {answer.seq}, and not {self._seq}", data)
        self._seq += 1
        self._check(answer, data, end_ns)
        self._answer = answer
        self._results = scene.take_results(end_ns)
        return answer

    def _check(self, answer: wire.Yield, data: bytes, end_ns: int) -> None:
        scene = self.scene
        scene.findings.expect("timers", "steps", "wakes", "own_node")
        scene.check(lambda: check_yield([scene.bench.node], answer, self._now_ns, end_ns), data)
        for step in answer.steps:
            shown_ns = step.time_ns + self._offset_ns
            scene.check_traffic(step.traffic, data, (shown_ns, shown_ns), f"and not {shown_ns}")
        waits = answer.waiting_radio or answer.waiting_gnss or scene.is_sending
        if not waits and answer.next_timer_ns is None and not any(step.traffic.endings for step in answer.steps):
            scene.findings.fail("wakes", "it waits for nothing and is never granted again", data)
        if answer.next_timer_ns is not None and answer.next_timer_ns < end_ns:
            raise SceneOverError

    def settle(self) -> None:
        """Nothing is said without a grant."""
        self.scene.findings.expect("unasked")
        for said in self.scene.hear(QUIET_S):
            if isinstance(said.message, wire.Yield):
                self.scene.findings.fail("unasked", f"Yield {said.message.seq}", said.data)

    def end(self, why: str = "the run is over") -> None:
        """Tell the agent that it is over; it is to end with exit status 0."""
        self.scene.bench.say(wire.End(None, why))
        self.scene.await_exit("ends", self.scene.patience_s, fails=False)


class Clock:
    """Real time: sends batches when they are due, and checks the frames and acknowledgements that come back.

    To an agent on another machine (`elsewhere`), the origin on this one's clock says nothing.
    """

    def __init__(self, scene: Scene, start_ns: int = 0, elsewhere: bool = False) -> None:
        self.scene = scene
        self._seq = 1
        self._frames_seq: int | None = 0
        self._received_seq = 0
        self._missed: list[tuple[int, int]] = []
        self._timed = 0
        self._lateness: list[int] = []
        self._late_ns = 0
        self._final = False
        self._next_fix = -(-start_ns // scene.emulation.world.period_ns)
        head_start_ns = 0 if start_ns else wire.HEAD_START_NS
        self._origin_ns = time.monotonic_ns() + head_start_ns - start_ns
        scene.take_frames = self._take
        scene.bench.say(wire.Batch([], 0, [], 10**18 if elsewhere else self._origin_ns, start_ns))

    def _now_ns(self) -> int:
        return time.monotonic_ns() - self._origin_ns

    def run(self, until_ns: int, disturbed: bool = False) -> None:
        """Send what is due until `until_ns`; if `disturbed`, with a gap, a batch that was held, and a late one."""
        while (due_ns := self._next_fix * self.scene.emulation.world.period_ns) < until_ns:
            self._listen_until(due_ns)
            self._send(due_ns, disturbed)
            self._next_fix += 1
        self._listen_until(until_ns)
        self.scene.check_stays()

    def _send(self, due_ns: int, disturbed: bool) -> None:
        """Send, or lose, the batch of an instant."""
        scene, seq = self.scene, self._seq
        held, late = (disturbed and seq == special for special in (HELD, LATE))
        delay_ns = scene.emulation.world.period_ns - PACKET_AFTER_NS[1] if held or late else 0
        received_ns = due_ns - delay_ns
        packets = [scene.packet(seq, received_ns - 1_000_000, received_ns)] if received_ns > 0 else []
        if disturbed and seq in GAP:
            self._missed = [GAP]
        else:
            results = scene.take_results(due_ns)
            scene.bench.say(wire.Batch([scene.fix(self._next_fix)], seq, packets, held=held, results=results))
            self._timed += 0 if held else len(packets)
            self._late_ns = delay_ns if late else self._late_ns
        self._seq += 1

    def _listen_until(self, time_ns: int) -> None:
        while (wait_ns := time_ns - self._now_ns()) > 0:
            for _ in self.scene.hear(wait_ns / NS_PER_S):
                pass
            self.scene.check_stays()

    def _take(self, said: Said) -> None:
        message, data, findings = said.message, said.data, self.scene.findings
        assert isinstance(message, wire.Frames)
        findings.expect("frames_seq", "missed", "acknowledges")
        if self._frames_seq not in (None, message.seq):
            findings.fail("frames_seq", f"seq = {message.seq}, and not {self._frames_seq}", data)
        if not self._received_seq <= message.received_seq <= self._seq:
            findings.fail("acknowledges", f"received_seq = {message.received_seq}: {self._seq} were sent", data)
        for missed in message.missed:
            if missed not in self._missed:
                findings.fail("missed", f"{list(missed)}", data)
        self._missed = [missed for missed in self._missed if missed not in message.missed]
        self._frames_seq, self._received_seq = message.seq + 1, message.received_seq
        if message.lateness is not None:
            self._take_lateness(list(message.lateness.counts), data)
        now_ns = said.at_ns - self._origin_ns
        shown_ns = now_ns - OLDEST_NS, now_ns + SLACK_NS
        self.scene.check_traffic(message.traffic, data, shown_ns, f"received at {now_ns}")
        self._final = self._final or message.final

    def _take_lateness(self, counts: list[int], data: bytes) -> None:
        self.scene.findings.expect("lateness")
        pairs = zip(self._lateness or counts, counts, strict=False)
        if len(counts) != wire.LATENESS_BINS or any(before > now for before, now in pairs):
            self.scene.findings.fail("lateness", f"{len(counts)} bins, or a count that has become less", data)
        elif sum(counts) > self._timed:
            self.scene.findings.fail("lateness", f"{sum(counts)} packets, where {self._timed} were sent", data)
        self._lateness = counts

    def lose_frames(self) -> None:
        """From now on some of what the agent says is lost, as the emulator goes away and comes back."""
        self._frames_seq = None

    def settle(self) -> None:
        """Wait until all batches are acknowledged, and the gaps are named."""
        findings = self.scene.findings
        findings.expect("acknowledges", "missed")
        deadline_ns = self._now_ns() + round(ACKNOWLEDGE_S * NS_PER_S)
        while self._received_seq < self._seq and self._now_ns() < deadline_ns:
            self._listen_until(min(self._now_ns() + 20_000_000, deadline_ns))
        if self._received_seq < self._seq:
            came = f"received_seq = {self._received_seq} {ACKNOWLEDGE_S:g} s after batch {self._seq - 1}"
            findings.fail("acknowledges", came)
        elif self._missed:
            findings.fail("missed", f"nothing of {list(map(list, self._missed))}")
        if self._late_ns and not sum(self._lateness[wire.lateness_bin(self._late_ns) :]):
            findings.fail("lateness", f"no packet {self._late_ns / 1e6:g} ms late or more, where one was")

    def end(self, why: str = "the run is over") -> None:
        """Tell the agent that it is over: a final message, then exit status 0."""
        scene = self.scene
        scene.findings.expect("final")
        scene.bench.say(wire.End(None, why))
        if not self._final and not any(self._final for _ in scene.hear(FINAL_S)):
            scene.findings.fail("final", f"no such Frames within {FINAL_S:g} s")
        scene.await_exit("ends", scene.patience_s, fails=False)
