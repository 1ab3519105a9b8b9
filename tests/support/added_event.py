"""Add a kind of event to vnet as a developer would, in its enumeration alone, and tell where it shows.

Run as `python -m tests.support.added_event FOLDER`: the enumeration is changed as it is imported. The line that
writes the event is in `main`; nothing else knows of it. Prints JSON.
"""

import json
import sys
from pathlib import Path
from unittest.mock import Mock

from tests.support.added_outcome import add_to
from tests.support.paths import ROOT

MEMBER = """    jammed = "jammed", "vehicle", "channel", "its radio is jammed", FAILURE, GROUPED | ENDS_PROGRAM
"""
BEFORE = "    # fmt: on"


def main(folder: Path) -> None:
    """Simulate a run in which the event befalls two vehicles, and print where it shows."""
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
    found = {
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
    print(json.dumps(found))


if __name__ == "__main__":
    add_to("emulator.records.events", BEFORE, MEMBER)
    main(Path(sys.argv[1]))
