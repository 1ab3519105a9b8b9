"""Checks of a single message of an agent, independent of the messages before it."""

from __future__ import annotations

import math
from collections.abc import Iterator

from emulator.radio.unicast import MOST_ATTEMPTS
from emulator.testing.conformance.findings import Findings
from vnet.reports import Report
from vnet.transport import wire
from vnet.transport.wire import WireSendResult

OF_TRAFFIC = ("own_node", "payload", "sends", "numbers", "report_time")
OF_YIELDS = ("timers", "steps", "wakes", *OF_TRAFFIC)
SLACK_NS = 50_000_000
"""Real time: how much the two clocks of one machine may seem to differ."""
OLDEST_NS = 1_000_000_000
"""Real time: a report is on its way for less than this."""


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
