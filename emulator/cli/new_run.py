"""A new run's folder for the commands that run a scenario; that its code has changed is told in one line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from emulator.checks.own import load_checks
from emulator.radio.own_rules import load_rules
from emulator.records.code_digest import changed_code
from emulator.records.events import EventKind
from emulator.records.run_folder import RunFolder
from emulator.scenario.loading import recorded_code
from emulator.scenario.scenario import Scenario
from emulator.terminal.console import LogFormat, tell


def prepare_folder(
    out: Path | None, path: Path, scenario: Scenario, log_format: LogFormat, notes: Sequence[str] = ()
) -> RunFolder:
    """Prepare the folder of a run of `scenario`, which was read from `path`; its `open` makes it.

    Each of `notes` on the input is told in a line, and recorded as an event `note`.

    Where `path` is of another run's folder, and program or vnet have changed since, the run goes on: one line says
    so, and the event `code_changed` records it.
    """
    load_rules(scenario.fault, scenario.program)
    load_checks(scenario.program)  # a folder appears only once they have proved usable
    folder = RunFolder.prepare(out, scenario)
    for note in notes:
        tell(note, log_format)
        folder.event(0, EventKind.note, what=note)
    if changed := changed_code(recorded_code(path), folder.code):
        tell(f"{path}: {changed}", log_format)
        folder.event(0, EventKind.code_changed, what=changed)
    return folder
