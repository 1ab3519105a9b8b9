"""`vnet check`: judge a finished run again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emulator.checks.judge import check_run
from emulator.cli.options import ChecksOption, path_of
from emulator.records.recorded_run import RecordedRun
from emulator.scenario.program import from_here
from emulator.terminal.console import one_line_errors
from emulator.terminal.safe_console import SafeConsole
from emulator.terminal.summary import print_checks


def check(
    folder: Annotated[Path, typer.Argument(parser=path_of, metavar="RUN", help="A run's folder.")],
    check: ChecksOption = None,
    own_checks: Annotated[
        bool, typer.Option("--own-checks", metavar="", help="Run its own checks again: code that the folder names.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", metavar="", help="Ignored: all checks are listed anyway.")
    ] = False,
) -> None:
    """Judge a run again, from its files alone; its own checks stand as recorded unless asked."""
    with one_line_errors():
        judgement = check_run(folder, own_checks, [from_here(each) for each in check or ()])
        print_checks(judgement, SafeConsole(), RecordedRun.open(folder).record.reproduce)
        raise typer.Exit(judgement.exit_status)
