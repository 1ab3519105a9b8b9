"""Agents with one mistake each, which a run names: `python -m tests.system.wrong_agent MISTAKE --connect …`.

Each is the agent of the documentation, which imports no vnet, with one of its methods overridden. `MISTAKE` may be
`v01=ONE,v02=ANOTHER`.
"""

import sys
from typing import Any

from docs.examples import foreign_agent
from docs.examples.foreign_agent import Agent, EndOfRun


class Alters(Agent):
    """Alters what it says: `alter` returns the fields that go out, or None for none."""

    def alter(self, fields: list[Any]) -> list[Any] | None:
        raise NotImplementedError

    def say(self, *fields: Any) -> None:
        if (altered := self.alter(list(fields))) is not None:
            super().say(*altered)


class OfNoNode(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [fields[0], "v99", *fields[2:]] if fields[0] == "Hello" else fields


class SaysTextForInteger(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [*fields[:2], "0", *fields[3:]] if fields[0] == "Yield" else fields


class ForgetsItsNonce(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [fields[0], b"", *fields[2:]] if fields[0] in ("Yield", "Frames") else fields


class CountsByItself(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [*fields[:2], fields[2] + 1, *fields[3:]] if fields[0] == "Yield" else fields


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


class SendsHundredMegabytes(OtherTraffic):
    def traffic(self, frames: list[Any], reports: list[Any], endings: list[Any]) -> list[Any]:
        return [[[node, bytes(100_000_000)] for node, _ in frames], reports, endings]


class ReportsNoCovariance(OtherTraffic):
    """Reports a covariance that is none, under a name that is none, beside the foreign agent's own report."""

    def traffic(self, frames: list[Any], reports: list[Any], endings: list[Any]) -> list[Any]:
        forged = {"covariance_m2": [-1.0, 0.0, 0.0, -1.0], "values": {"../../x": 1.0}}
        return [frames, [{**report, **forged} for report in reports], endings]


class NeverAcknowledges(Alters):
    def alter(self, fields: list[Any]) -> list[Any]:
        return [*fields[:3], 0, *fields[4:]] if fields[0] == "Frames" else fields


class EndsWithAnError(Agent):
    def next(self, timeout_s: float) -> tuple[list[Any], int]:
        try:
            return super().next(timeout_s)
        except EndOfRun:
            sys.exit("an error at the very end")


if __name__ == "__main__":
    mistake = sys.argv.pop(1)
    of_node = dict(each.split("=") for each in mistake.split(",") if "=" in each)
    foreign_agent.Agent = globals()[of_node.get(sys.argv[sys.argv.index("--node") + 1], mistake)]  # type: ignore[misc]
    foreign_agent.main()
