"""A run in which a vehicle sends frames to single vehicles, with losses, and faults that send some again."""

from pathlib import Path
from typing import Any

from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.scenario.scenario import Scenario
from tests.emulator.checks.test_judge import run_scenario
from vnet import Node

COPYING: list[dict[str, Any]] = [
    {"kind": "DoS", "at_s": 0.3, "duration_s": 0.1, "factor": 2, "nodes": ["a"]},
    {"kind": "duplicate", "at_s": 0.1, "duration_s": 0.2, "probability": 0.5},
]
"""Faults that send frames again, or have them arrive twice."""


async def sends(node: Node) -> None:
    """Vehicle a sends to b, in range, and to far, out of range, and tells the results."""
    if node.id == "a":
        for _ in range(40):
            for to in ("b", "far"):
                result = await node.radio.send(to, bytes(100))
                node.event("result", to=to, delivered=result.delivered, attempts=result.attempts)
    async for _ in node.radio:
        pass


def exchange_run(folder: Path, faults: list[dict[str, Any]], **sections: Any) -> OpenedRun:
    """Simulate `sends` with these faults; returns the run."""
    (folder / "n.csv").write_text("id,x_m,y_m,heading_rad\na,0,0,0\nb,50,0,0\nfar,50000,0,0\n")
    scenario = {
        "run": {"duration_s": 1.0, "settle_s": 0.0},
        "network": {"kind": "file", "path": str(folder / "n.csv")},
        "world": {"lateral": {"sigma_m": 0.0}},
        "radio": {"mac": {}, "loss": 0.3},
        "program": {"entry": f"{__name__}:sends"},
        "fault": faults,
        **sections,
    }
    run_scenario(folder / "run", Scenario.model_validate(scenario))
    return RecordedRun.open(folder / "run")
