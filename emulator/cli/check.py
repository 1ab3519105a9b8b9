"""`vnet check`: judge a finished run again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from emulator.checks.judge import check_run, recorded_verdict
from emulator.terminal.console import one_line_errors
from emulator.terminal.summary import print_checks


def check(folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run's folder.")]) -> None:
    """Judge a run again, from its files alone."""
    with one_line_errors():
        judgement = check_run(folder)
        print_checks(judgement, Console(), recorded_verdict(folder)["reproduce"])
        raise typer.Exit(judgement.exit_status)
