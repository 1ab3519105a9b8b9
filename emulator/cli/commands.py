"""`vnet`: the list of its commands, by what one wants to do.

Exit status: 0 valid, 1 invalid, 2 wrong usage or a wrong scenario, 3 unknown, 130 interrupted.
"""

from __future__ import annotations

import io
import sys
from enum import StrEnum

import typer

from emulator.cli.access import access
from emulator.cli.check import check
from emulator.cli.conformance import conformance
from emulator.cli.experiment import app as experiment_app
from emulator.cli.export import export, radio
from emulator.cli.fault import app as fault_app
from emulator.cli.fault import status
from emulator.cli.map import app as map_app
from emulator.cli.playback import play, render
from emulator.cli.report import compare, report
from emulator.cli.runs import emulator, run, simulate
from emulator.cli.studies import analyze, campaign
from emulator.cli.viewing import record, view
from emulator.terminal.console import run_app


class Panel(StrEnum):
    """The headings under which `vnet --help` lists the commands."""

    RUN = "Run a scenario"
    LIVE = "During a run"
    AFTER = "After a run"
    STUDIES = "Studies"
    APART = "Apart from the emulator"


COMMANDS = {
    Panel.RUN: (run, simulate, emulator),
    Panel.AFTER: (check, report, view, render, play, compare, radio, export),
    Panel.LIVE: (status,),
    Panel.STUDIES: (analyze, campaign),
    Panel.APART: (access, record, conformance),
}
GROUPS = {
    "fault": (Panel.LIVE, fault_app),
    "experiment": (Panel.STUDIES, experiment_app),
    "map": (Panel.STUDIES, map_app),
}

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
    help="An asyncio message-passing emulator for connected vehicles over Zenoh.",
)
for _panel, _commands in COMMANDS.items():
    for _command in _commands:
        app.command(rich_help_panel=_panel)(_command)
for _name, (_panel, _group) in GROUPS.items():
    app.add_typer(_group, name=_name, rich_help_panel=_panel)


def main() -> None:
    """The console script."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a sign that a terminal does not know is no reason to fail
    sys.exit(run_app(app, sys.argv[1:]))
