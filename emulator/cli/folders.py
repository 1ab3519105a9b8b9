"""`vnet check`, `trace`, `report` and `compare`: a run judged again, looked into, on a page, and beside another."""

from __future__ import annotations

import sys
import webbrowser
from collections.abc import Callable
from importlib import import_module
from inspect import isasyncgenfunction, iscoroutinefunction, isgeneratorfunction
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from emulator.cli.options import LATEST, ChecksOption, RunArgument, path_of
from emulator.records.run_folder import VERDICT_FILE
from emulator.scenario.program import from_here, split_file
from emulator.scenario.sections import DAY_S
from emulator.terminal.console import one_line_errors, tell
from emulator.terminal.live import SafeConsole
from vnet.errors import VnetError, did_you_mean, printable, shown
from vnet.runtime.error_text import error_line
from vnet.runtime.programs import search_programs_in
from vnet.units import NS_PER_S

if TYPE_CHECKING:
    from emulator.records.parting import FrameEntry

COLUMNS = ("s", "sender", "frame", "bytes", "content", "receivers")
LONGEST_CONTENT = 200
"""Characters of a content that are shown."""
LONGEST_CELL = 100_000
"""Characters of a cell that are printed where no table is."""
NO_PLAIN_FUNCTIONS = isasyncgenfunction, iscoroutinefunction, isgeneratorfunction
"""Tests for functions that return no result when they are called."""
MOST_BYTES = 32
"""Bytes of a payload that are shown where nothing decodes it."""


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
    from emulator.checks.judge import check_run  # slow to import, as are the readers of folders below
    from emulator.records.recorded_run import RecordedRun
    from emulator.terminal.summary import print_checks

    with one_line_errors():
        judgement = check_run(folder, own_checks, [from_here(each) for each in check or ()])
        print_checks(judgement, SafeConsole(), RecordedRun.open(folder).record.reproduce)
        raise typer.Exit(judgement.exit_status)


def trace(
    run: RunArgument = LATEST,
    node: Annotated[str | None, typer.Option(metavar="ID", help="Only what it sent or could hear.")] = None,
    start: Annotated[float, typer.Option("--from", min=0.0, help="Emulated second to begin at.")] = 0.0,
    end: Annotated[float | None, typer.Option("--to", help="Emulated second to stop before.")] = None,
    decode: Annotated[
        str | None,
        typer.Option(
            metavar="FUNCTION",
            help="Show what this function returns for each payload (run.keep_payloads): decode.py:decode, or "
            "package.module:decode.",
        ),
    ] = None,
) -> None:
    """Show who sent what to whom, and what became of it; on a terminal as a table, else separated by tabs."""
    from emulator.records.parting import frame_log
    from emulator.records.recorded_run import RecordedRun
    from emulator.records.tables import PAYLOADS

    with one_line_errors():
        if end is not None and not end > start:
            raise VnetError(f"--to {end:g}: must come after --from {start:g}")
        recorded = RecordedRun.open(run)
        ended_s = recorded.closed_ns / NS_PER_S
        if start and start >= ended_s:
            raise VnetError(f"--from {start:g}: must come before the run's end at {ended_s:g} s")
        if node is not None and node not in recorded.number:
            raise VnetError(f"--node {node}: no such vehicle{did_you_mean(node, recorded.node_ids)}")
        if decode is not None:
            if not recorded.scenario.run.keep_payloads:
                raise VnetError(f"--decode {decode}: {run} has kept no payloads; set run.keep_payloads = true")
            recorded.required(PAYLOADS)
        content = _raw if decode is None else _decoded_by(_load(decode))
        end_ns = None if end is None or end > DAY_S else round(end * NS_PER_S)
        rows = (_row(entry, content) for entry in frame_log(recorded, node, round(start * NS_PER_S), end_ns))
        console, first = SafeConsole(), list(islice(rows, 1))  # before anything is printed, if there is no trace
        if not console.is_terminal:
            print("\t".join(COLUMNS))
            for row in chain(first, rows):
                print("\t".join(printable(cell, LONGEST_CELL) for cell in row))
            return
        table = Table(*COLUMNS, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for row in chain(first, rows):
            table.add_row(*map(Text, row))
        console.print(table)


def _row(entry: FrameEntry, content: Callable[[FrameEntry], str]) -> list[str]:
    number = f"{entry.seq}.{entry.copy}" if entry.copy else str(entry.seq)
    said = printable(content(entry), LONGEST_CONTENT)
    heard = "; ".join(f"{outcome} {', '.join(nodes)}" for outcome, nodes in entry.outcomes.items())
    return [f"{entry.sent_ns / NS_PER_S:.6f}", entry.sender, number, str(entry.size_bytes), said, heard]


def _raw(entry: FrameEntry) -> str:
    """The payload as text or, where it is none, its first bytes; without it, its digest."""
    if entry.payload is None:
        return f"digest {entry.digest:016x}"
    try:
        text = entry.payload.decode()
    except UnicodeDecodeError:
        text = ""
    if text.isprintable() and text:
        return text
    return entry.payload[:MOST_BYTES].hex() + ("…" if len(entry.payload) > MOST_BYTES else "")


def _decoded_by(function: Callable[[bytes], Any]) -> Callable[[FrameEntry], str]:
    def content(entry: FrameEntry) -> str:
        if entry.payload is None:
            return _raw(entry)
        try:
            return str(function(entry.payload))
        except (Exception, SystemExit) as error:  # whatever the user's function cannot make sense of
            return f"{_raw(entry)} ({error_line(error)})"

    return content


def _load(entry: str) -> Callable[[bytes], Any]:
    """Import a function. Raises VnetError for what is none."""
    module, _, name = entry.rpartition(":")
    if not module or not name:
        raise VnetError(f"--decode {shown(entry)}: write it as file.py:function or package.module:function")
    folder = Path.cwd()
    if split_file(entry) is not None:
        if not (file := Path(module)).is_file():
            raise VnetError(f"--decode {entry}: {module}: no such file")
        folder, module = file.resolve().parent, file.stem
    search_programs_in((folder,))
    try:
        function = getattr(import_module(module), name)
    except (Exception, SystemExit) as error:
        raise VnetError(f"--decode {entry}: cannot import: {error_line(error)}") from None
    if not callable(function) or any(holds(function) for holds in NO_PLAIN_FUNCTIONS):
        raise VnetError(f"--decode {entry}: is not a plain function of a payload: def {name}(payload)")
    return function  # type: ignore[no-any-return]


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
        path, damages = (_write_index(index), []) if index is not None else _write_report(run)
        print(path, flush=True)
        if index is None and not (run / VERDICT_FILE).exists():
            tell(f"{run}: has no verdict: the run is still going on, or was ended from outside")
        is_shown = not show or webbrowser.open(path.resolve().as_uri())
        if damages:
            raise VnetError(f"{run}: its verdict stands on files that cannot be read: {'; '.join(damages)}")
        if not is_shown:
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
    from emulator.pages.page import put_page
    from emulator.report.comparison import Comparison, comparison_page, print_comparison

    with one_line_errors():
        comparison = Comparison.of(first, second)
        print_comparison(comparison, SafeConsole())
        if out is not None:
            print(put_page(out, comparison_page(comparison)))
        raise typer.Exit(0 if comparison.same_trace and not comparison.partings else 1)


def _write_report(folder: Path) -> tuple[Path, list[str]]:
    """Write a run's report; returns its path, and why files on which the verdict stands cannot be read."""
    from emulator.report.source import Source
    from emulator.report.write import write_report  # slow to import

    source = Source(folder)
    return write_report(source), source.damages


def _write_index(folder: Path) -> Path:
    from emulator.report.index import write_index

    return write_index(folder)
