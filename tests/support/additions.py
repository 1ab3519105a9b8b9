"""Add an outcome and a kind of event to vnet as a developer would, in its table alone, and tell where they show.

Run as `python -m tests.support.additions FOLDER`: the tables are changed as they are imported, before the rest of
vnet. What gives the outcome, and writes the event, is here; nothing else knows of them. Prints JSON.
"""

import json
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import Mock

from tests.support.paths import ROOT

OUTCOME = """
    jammed = (
        17, RECEPTION, "quiet", "▣", "an interferer was on the air", lambda scenario, vehicles: vehicles > 5)
"""
BEFORE_OUTCOME = "    # fmt: on"
KIND = """    jammed = "jammed", "vehicle", "channel", "its radio is jammed", FAILURE, GROUPED | ENDS_PROGRAM
"""
BEFORE_KIND = "    # fmt: on"


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


def of_outcome(folder: Path) -> dict[str, Any]:
    """Simulate a run with the outcome; return where it shows."""
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
    return {
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


def of_event(folder: Path) -> dict[str, Any]:
    """Simulate a run in which the event befalls two vehicles; return where it shows."""
    from docs.generate.files import page
    from emulator.drivers.session import Session
    from emulator.records.events import EventKind, merged
    from emulator.records.recorded_run import RecordedRun
    from emulator.report.source import Source
    from emulator.report.timeline import marks_of
    from emulator.report.write import write_report
    from emulator.scenario.loading import load_scenario
    from emulator.stream import event_message
    from emulator.viewer.scenes import OverviewScene

    session = Session(load_scenario(ROOT / "scenarios" / "beacon.toml", ["run.duration_s=1"]), folder).open()
    session.run()
    for node in ("v01", "v02"):
        session.folder.event(session.emulation.emulated_ns, EventKind["jammed"], node, channel=5)
    session.close()
    write_report(Source(folder))
    run = RecordedRun.open(folder)
    events = run.event("jammed")
    canvas = Mock()
    scene = Mock(_canvas=canvas)
    OverviewScene.events(scene, [event_message(event) for event in events])
    return {
        "read": [event.node for event in events],
        "dead": len(run.deaths_ns),
        "words": events[0].text,
        "bad": events[0].is_bad,
        "grouped": [event.node for event in merged(events)],
        "timeline": marks_of(events, run.number)[0].kind,
        "report": "jammed" in (folder / "report.html").read_text(),
        "rerun": str(canvas.log.call_args.args[1].level.as_arrow_array()[0]),
        "reference": "| `jammed` | vehicle | `channel` | its radio is jammed |" in page(),
    }


if __name__ == "__main__":
    add_to("emulator.radio.outcomes", BEFORE_OUTCOME, OUTCOME)
    add_to("emulator.records.events", BEFORE_KIND, KIND)
    jam_every_second_frame()
    where = Path(sys.argv[1])
    print(json.dumps([of_outcome(where / "outcome"), of_event(where / "event")]))
