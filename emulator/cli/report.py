"""`vnet report` and `vnet compare`: a run on a page, and two runs side by side."""

from __future__ import annotations

import sys
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from emulator.cli.options import LATEST, RunArgument
from emulator.records.run_folder import VERDICT_FILE
from emulator.terminal.console import one_line_errors, tell
from emulator.terminal.live import SafeConsole
from vnet.errors import VnetError


def report(
    run: RunArgument = LATEST,
    index: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Write FOLDER/index.html, a list of the runs in it, instead."),
    ] = None,
    show: Annotated[bool, typer.Option("--open", help="Open it in a browser here.")] = False,
) -> None:
    """Rebuild a run's report.html from its files alone."""
    with one_line_errors():
        path = _write_index(index) if index is not None else _write_report(run)
        print(path, flush=True)
        if index is None and not (run / VERDICT_FILE).exists():
            tell(f"{run}: has no verdict: the run is still going on, or was ended from outside")
        if show and not webbrowser.open(path.resolve().as_uri()):
            raise VnetError(f"--open: no browser was found here; open {path}")


def report_at_end(folder: Path) -> None:
    """Write the report of a run that has just ended. What goes wrong is said, and changes nothing."""
    try:
        _write_report(folder)
    except Exception as error:  # a verdict that stands must not fall by a picture
        what = str(error) if isinstance(error, VnetError) else f"{folder}: {error!r}"
        print(f"vnet: the report could not be written: {what}", file=sys.stderr)


def compare(
    first: Annotated[Path, typer.Argument(metavar="RUN_A", help="A run's folder.")],
    second: Annotated[Path, typer.Argument(metavar="RUN_B", help="Another's.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Write a page with the curves of both as well.")
    ] = None,
) -> None:
    """Set two runs side by side, and show where they part: decision, frame, reception, event or value.

    Status 0: nothing differs; 1: they part; 2: error.
    """
    from emulator.report.comparison import Comparison, print_comparison

    with one_line_errors():
        comparison = Comparison.of(first, second)
        print_comparison(comparison, SafeConsole())
        if out is not None:
            from emulator.report.comparison import write_comparison

            print(write_comparison(comparison, out))
        raise typer.Exit(0 if comparison.same_trace and not comparison.partings else 1)


def _write_report(folder: Path) -> Path:
    from emulator.report.write import write_report  # slow to import

    return write_report(folder)


def _write_index(folder: Path) -> Path:
    from emulator.report.index import write_index

    return write_index(folder)
