"""Agents with one mistake each, to be found by conformance: `python -m …wrong_agent MISTAKE --connect …`.

Each is the agent of the documentation, which imports no vnet, with one of its methods overridden.
"""

import os
import sys
import time
from typing import Any

import msgpack

from docs.examples import foreign_agent
from docs.examples.foreign_agent import Agent, EndOfRun, Vehicle


class SaysHelloOnce(Agent):
    said = False

    def say(self, *fields: Any) -> None:
        if fields[0] != "Hello" or fields[6] or not self.said:
            super().say(*fields)
        self.said = True


class Alters(Agent):
    """Alters what it says: `alter` returns the fields that go out, or None for none."""

    def alter(self, fields: list[Any]) -> list[Any] | None:
        raise NotImplementedError

    def say(self, *fields: Any) -> None:
        if (altered := self.alter(list(fields))) is not None:
            super().say(*altered)


class ReadyAtOnce(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [*fields[:6], True, *fields[7:]] if fields[0] == "Hello" else fields


class ShortNonce(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [*fields[:3], b"n", *fields[4:]] if fields[0] == "Hello" else fields


class OfAnotherProcess(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [*fields[:2], "v02", *fields[3:]] if fields[0] == "Hello" else fields


class OfNoNode(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [fields[0], "v99", *fields[2:]] if fields[0] == "Hello" else fields


class CannotLoadItsProgram(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [*fields[:7], "no module beacon", *fields[8:]] if fields[0] == "Hello" and fields[6] else fields


class TakesAnyWelcome(Agent):
    def next(self, timeout_s: float) -> tuple[list[Any], int]:
        message, arrived_ns = super().next(timeout_s)
        return ([*message[:2], self.nonce, *message[3:]] if message[0] == "Welcome" else message), arrived_ns


class SaysTextForInteger(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [*fields[:2], "0", *fields[3:]] if fields[0] == "Yield" else fields


class ForgetsItsNonce(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [fields[0], b"", *fields[2:]] if fields[0] in ("Yield", "Frames") else fields


class CountsByItself(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [*fields[:2], fields[2] + 1, *fields[3:]] if fields[0] == "Yield" else fields


class YieldsTwice(Agent):
    def say(self, *fields: Any) -> None:
        super().say(*fields)
        if fields[0] == "Yield":
            super().say(*fields)


class YieldsBeforeTheGrant(Agent):
    def run_lockstep(self, vehicle: Vehicle) -> None:
        self.say("Yield", self.nonce, 0, None, [], [self.node], [], 1)
        super().run_lockstep(vehicle)


class TimerInThePast(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [*fields[:3], 0, *fields[4:]] if fields[0] == "Yield" else fields


class StepsAfterItsWindow(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        if fields[0] == "Yield":
            fields[6] = [[time_ns + 2_000_000, traffic] for time_ns, traffic in fields[6]]
        return fields


class KnowsNoWindows(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return fields[:8] if fields[0] == "Hello" else fields


class WaitsForNothing(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [*fields[:5], [], *fields[6:]] if fields[0] == "Yield" else fields


class AnswersLate(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        if fields[0] == "Yield" and fields[2] == 2:
            time.sleep(2.0)
        return fields


class OtherTraffic(Alters):
    """Alters the traffic of its yields and frames."""

    def alter(self, fields: list[Any]) -> list[Any]:
        if fields[0] == "Frames" and fields[5][0]:
            fields[5] = self.traffic(*fields[5])
        if fields[0] == "Yield":
            fields[6] = [[time_ns, self.traffic(*traffic)] for time_ns, traffic in fields[6]]
        return fields

    def traffic(self, frames: list[Any], reports: list[Any], endings: list[Any]) -> list[Any]:
        raise NotImplementedError


class SpeaksForOthers(OtherTraffic):
    def traffic(self, frames: list[Any], reports: list[Any], endings: list[Any]) -> list[Any]:
        return [[["v02", payload] for _, payload in frames], reports, endings]


class SendsTooMuch(OtherTraffic):
    def traffic(self, frames: list[Any], reports: list[Any], endings: list[Any]) -> list[Any]:
        return [[[node, bytes(100_000)] for node, _ in frames], reports, endings]


class SendsHundredMegabytes(OtherTraffic):
    def traffic(self, frames: list[Any], reports: list[Any], endings: list[Any]) -> list[Any]:
        return [[[node, bytes(100_000_000)] for node, _ in frames], reports, endings]


class ReportsNoCovariance(OtherTraffic):
    """Reports a covariance that is none, under a name that is none, beside the foreign agent's own report."""

    def traffic(self, frames: list[Any], reports: list[Any], endings: list[Any]) -> list[Any]:
        forged = {"covariance_m2": [-1.0, 0.0, 0.0, -1.0], "values": {"../../x": 1.0}}
        return [frames, [{**report, **forged} for report in reports], endings]


class ReportsNan(OtherTraffic):
    def traffic(self, frames: list[Any], reports: list[Any], endings: list[Any]) -> list[Any]:
        return [frames, [{**report, "estimate_m": [float("nan"), 0.0]} for report in reports], endings]


class ReportsWallClock(OtherTraffic):
    def traffic(self, frames: list[Any], reports: list[Any], endings: list[Any]) -> list[Any]:
        return [frames, [{**report, "time_ns": time.time_ns()} for report in reports], endings]


class RunsThoughItHasEnded(Agent):
    def join(self, timeout_s: float) -> list[Any]:
        return [*super().join(timeout_s)[:14], True]


class KeepsItsNonce(Agent):
    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.nonce = b"always the same!"


class IgnoresStackRequests(Alters):
    def alter(self, fields: list[Any]) -> list[Any] | None:
        return None if fields[0] == "StackDump" else fields


class Deaf(Agent):
    """Goes on whatever it is told."""

    def next(self, timeout_s: float) -> tuple[list[Any], int]:
        try:
            return super().next(timeout_s)
        except (EndOfRun, SystemExit):
            time.sleep(60)
            raise


class EndsWithAnError(Agent):
    def next(self, timeout_s: float) -> tuple[list[Any], int]:
        try:
            return super().next(timeout_s)
        except EndOfRun:
            sys.exit("an error at the very end")


class EndsThoughItIsRefused(Agent):
    def next(self, timeout_s: float) -> tuple[list[Any], int]:
        try:
            return super().next(timeout_s)
        except SystemExit:
            os._exit(0)


class GivesUpAtOnce(Agent):
    def on_emulator(self, sample: Any) -> None:
        super().on_emulator(sample)
        self.orphan_timeout_s = self.patience_until_s = 0.0
        if self.lost_s < time.monotonic():
            os._exit(3)


class TakesGarbageForTheEnd(Agent):
    def on_rx(self, sample: Any) -> None:
        try:
            msgpack.unpackb(sample.payload.to_bytes())
        except ValueError:
            os._exit(0)
        super().on_rx(sample)


class StumblesOverGarbage(Agent):
    def on_rx(self, sample: Any) -> None:
        try:
            msgpack.unpackb(sample.payload.to_bytes())
        except ValueError:
            os._exit(1)
        super().on_rx(sample)


class NeverLate(Alters):
    """Counts each packet as if it had been on time."""

    def alter(self, fields: list[Any]) -> list[Any]:
        if fields[0] == "Frames":
            counts = fields[6][0]
            fields[6] = [[sum(counts), *[0] * (len(counts) - 1)]]
        return fields


class CountsFramesWrongly(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [*fields[:2], 7, *fields[3:]] if fields[0] == "Frames" else fields


class NeverAcknowledges(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [*fields[:3], 0, *fields[4:]] if fields[0] == "Frames" else fields


class HidesGaps(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [*fields[:4], [], *fields[5:]] if fields[0] == "Frames" else fields


class TooFewBins(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [*fields[:6], [[0] * 5], fields[7]] if fields[0] == "Frames" else fields


class NoLastWords(Alters):
    def alter(self, fields: list[Any]) -> list[Any] | None:
        return None if fields[0] == "Frames" and fields[7] else fields


MISTAKES = {
    kind.__name__: kind for kind in globals().values() if isinstance(kind, type) and issubclass(kind, Agent)
}


if __name__ == "__main__":
    foreign_agent.Agent = MISTAKES[sys.argv.pop(1)]  # type: ignore[misc]
    foreign_agent.main()
