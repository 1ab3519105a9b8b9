"""Add an outcome to vnet as a developer would, in the table of outcomes alone, and tell where it shows.

Run as `python -m tests.support.added_outcome FOLDER`: the table is changed as it is imported, before the rest
of vnet. The outcome's own code is `jam`; nothing else knows of it. Prints JSON.
"""

import json
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import Mock

from tests.support.paths import ROOT

MEMBER = """
    jammed = (
        17,
        Facts(
            meaning="an interferer was on the air",
            stage=Stage.RECEPTION,
            colour="quiet",
            sign="▣",
            is_possible=lambda scenario, vehicles: vehicles > 5,
        ),
    )

"""
BEFORE = "    @property\n    def title"


def add_to(name: str, before: str, added: str) -> None:
    """Import a module as if `added` stood in it `before` a line."""
    spec = find_spec(name)
    assert spec is not None and spec.origin is not None
    source = Path(spec.origin).read_text()
    assert source.count(before) == 1
    module = ModuleType(spec.name)
    sys.modules[spec.name] = module
    exec(compile(source.replace(before, added + before), spec.origin, "exec"), module.__dict__)


def jam_every_second_frame() -> None:
    """Give the outcome to every reception of every second frame that comes as far as random loss."""
    from emulator.radio.outcomes import PENDING, Outcome
    from emulator.radio.reception import LossStage

    lose = LossStage.__call__

    def jam(self: Any, transmissions: Any, receptions: Any) -> None:
        for index, sent in enumerate(transmissions):
            row = receptions.outcome[index]
            if sent.frame.seq % 2:
                row[row == PENDING] = Outcome["jammed"]
        lose(self, transmissions, receptions)

    LossStage.__call__ = jam  # type: ignore[method-assign]


def legend(vehicles: int) -> list[str]:
    """The names in the legend of a recording's map."""
    from emulator.scenario.loading import dump_scenario
    from emulator.scenario.scenario import Scenario
    from emulator.viewer.scenes import draw_legend

    canvas = Mock()
    names = [f"v{number}" for number in range(vehicles)]
    draw_legend(canvas, {"scenario": dump_scenario(Scenario()), "node_ids": names})
    return [label for call in canvas.point_style.call_args_list for label in call.args[3]]


def main(folder: Path) -> None:
    """Simulate a run with the outcome, and print where it shows."""
    from typer.testing import CliRunner

    from docs.generate.files import page
    from emulator.checks.channel import IN_TRACE
    from emulator.radio.outcomes import Outcome
    from emulator.records.recorded_run import ON_AIR
    from emulator.viewer.drawing import outcome_colours
    from tests.emulator.terminal.test_dashboard import make, rows
    from tests.support.command_line import app

    scenario = str(ROOT / "scenarios" / "beacon.toml")
    arguments = ["simulate", scenario, "--duration", "2", "--out", str(folder)]
    done = CliRunner(env={"PYTHONHASHSEED": "0"}).invoke(app, arguments)
    verdict = json.loads((folder / "verdict.json").read_text())
    shot = make(frames_per_s={"delivered": 50.0, "jammed": 50.0})
    found = {
        "summary": [line for line in done.output.splitlines() if "jammed" in line],
        "verdict": verdict["verdict"],
        "counted": verdict["frames_by_outcome"]["jammed"],
        "checks": "jammed" in IN_TRACE and "jammed" in ON_AIR,
        "report": (folder / "report.html").read_text().count("jammed"),
        "dashboard": any("jammed 50.0%" in line for line in rows(shot)),
        "legend": ["jammed" in legend(10), "jammed" in legend(3)],
        "colour": outcome_colours([Outcome["jammed"]]).tolist(),  # type: ignore[arg-type]
        "reference": "| `jammed` | an interferer was on the air |" in page(),
    }
    print(json.dumps(found))


if __name__ == "__main__":
    add_to("emulator.radio.outcomes", BEFORE, MEMBER)
    jam_every_second_frame()
    main(Path(sys.argv[1]))
