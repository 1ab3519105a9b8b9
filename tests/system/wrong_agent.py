"""Agents with one mistake each, which a run names: `python -m tests.system.wrong_agent MISTAKE --connect …`.

Each is the agent of the documentation, which imports no vnet, with one of its methods overridden. `MISTAKE` may be
`v01=ONE,v02=ANOTHER`.
"""

import sys
from collections.abc import Callable
from typing import Any

from docs.examples import foreign_agent
from docs.examples.foreign_agent import Agent, EndOfRun

Fields = list[Any]
SAID: dict[str, tuple[tuple[str, ...], Callable[[Fields], Fields]]] = {
    "OfNoNode": (("Hello",), lambda said: [said[0], "v99", *said[2:]]),
    "SaysTextForInteger": (("Yield",), lambda said: [*said[:2], "0", *said[3:]]),
    "ForgetsItsNonce": (("Yield", "Frames"), lambda said: [said[0], b"", *said[2:]]),
    "CountsByItself": (("Yield",), lambda said: [*said[:2], said[2] + 1, *said[3:]]),
    "TimerInThePast": (("Yield",), lambda said: [*said[:3], 0, *said[4:]]),
    "StepsAfterItsWindow": (
        ("Yield",),
        lambda said: [*said[:6], [[time_ns + 2_000_000, traffic] for time_ns, traffic in said[6]], *said[7:]],
    ),
    "KnowsNoWindows": (("Hello",), lambda said: said[:8]),
    "NeverAcknowledges": (("Frames",), lambda said: [*said[:3], 0, *said[4:]]),
}
"""The fields that go out in place of those of a message, by its type."""
FORGED = {"covariance_m2": [-1.0, 0.0, 0.0, -1.0], "values": {"../../x": 1.0}}
"""A covariance that is none, under a name that is none, beside the foreign agent's own report."""
CLAIMED = ["v07", 0, "event", "info", "fault_started", {}]
"""An event of a name that is vnet's own."""
TRAFFIC: dict[str, Callable[[Fields, Fields, Fields], Fields]] = {
    "SpeaksForOthers": lambda frames, *more: [[["v02", payload] for _, payload in frames], *more],
    "ClaimsAFault": lambda *told: [*told[:3], [], [CLAIMED]],
    "SendsHundredMegabytes": lambda frames, *more: [[[node, bytes(100_000_000)] for node, _ in frames], *more],
    "ReportsNoCovariance": lambda frames, reports, endings: [frames, [each | FORGED for each in reports], endings],
}
"""The traffic of yields and frames."""


class Alters(Agent):
    """Makes the mistake of this name in what it says."""

    mistake: str

    def say(self, *fields: Any) -> None:
        said = list(fields)
        if self.mistake in SAID:
            kinds, altered = SAID[self.mistake]
            said = altered(said) if said[0] in kinds else said
        else:
            altered_traffic = TRAFFIC[self.mistake]
            if said[0] == "Frames" and said[5][0]:
                said[5] = altered_traffic(*said[5])
            if said[0] == "Yield":
                said[6] = [[time_ns, altered_traffic(*traffic)] for time_ns, traffic in said[6]]
        super().say(*said)


class EndsWithAnError(Agent):
    def next(self, timeout_s: float) -> tuple[list[Any], int]:
        try:
            return super().next(timeout_s)
        except EndOfRun:
            sys.exit("an error at the very end")


if __name__ == "__main__":
    mistake = sys.argv.pop(1)
    of_node = dict(each.split("=") for each in mistake.split(",") if "=" in each)
    Alters.mistake = of_node.get(sys.argv[sys.argv.index("--node") + 1], mistake)
    foreign_agent.Agent = EndsWithAnError if mistake == "EndsWithAnError" else Alters  # type: ignore[misc]
    foreign_agent.main()
