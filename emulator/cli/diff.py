"""`vnet diff`: where two runs part for the first time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from emulator.cli.options import RunArgument, path_of
from emulator.records.parting import Parting, before, partings
from emulator.records.recorded_run import RecordedRun
from emulator.terminal.console import one_line_errors
from emulator.terminal.safe_console import SafeConsole
from vnet.errors import printable
from vnet.units import NS_PER_S

LONGEST = 300
"""Characters of what a run has at a parting."""


def diff(
    run: RunArgument,
    other: Annotated[Path, typer.Argument(parser=path_of, metavar="OTHER", help="Another run's folder.")],
) -> None:
    """Show where two runs part: decision, frame, reception, event or value, and what had happened before.

    Status 0: the runs agree; 1: they part; 2: error.
    """
    with one_line_errors():
        ours, theirs = RecordedRun.open(run), RecordedRun.open(other)
        found = partings(ours, theirs)
        console = SafeConsole()
        if not found:
            console.print("the runs agree in all decisions, frames, receptions, events and reported values")
            return
        first = found[0]
        console.print(f"the runs part at {first.time_ns / NS_PER_S:.6f} s: a {first.kind} of {first.node}")
        console.print(_table(found, str(run), str(other)))
        if told := before(ours.trace, ours.events, first.node, first.time_ns):
            console.print(f"{first.node} until then:", highlight=False)
            for line in told:
                console.print(Text(f"  {line}"))
        raise typer.Exit(1)


def _table(found: list[Parting], ours: str, theirs: str) -> Table:
    table = Table("s", "first", "vehicle", escape(printable(ours)), escape(printable(theirs)))
    for each in found:
        shown = [Text(printable(text, LONGEST) or "–") for text in (each.first, each.second)]
        table.add_row(f"{each.time_ns / NS_PER_S:.6f}", each.kind, each.node, *shown)
    return table
