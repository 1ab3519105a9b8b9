"""Summary that a run prints at its end: verdict, figures, files, and the next commands."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Column, Table
from rich.text import Text

from emulator.checks.judge import Judgement, Verdict
from emulator.checks.own import PREFIX
from emulator.pages.text import as_text, cell
from emulator.records.costs import HEADS, SLOWEST, RunCost, read_cost
from emulator.records.events import EventKind
from emulator.records.period_figures import KeyFigure, shown_figures
from emulator.records.reported import ReportedFigure
from emulator.records.run_folder import RECORDING, REPORT, RunFolder
from emulator.records.tables import on_backbone
from emulator.records.verdicts import CheckResult
from emulator.viewer.sinks import is_closed, repair_command
from vnet.units import NS_PER_S

WIDEST = 10_000
"""Columns of a terminal on which every table has room."""
STYLE = {Verdict.VALID: "green", Verdict.INVALID: "bold red", Verdict.UNKNOWN: "yellow"}


def print_summary(
    judgement: Judgement,
    verdict: dict[str, Any],
    folder: RunFolder,
    console: Console,
    report: bool = False,
    verbose: bool = False,
) -> None:
    """Print the summary of a run that has just ended; with `report`, its report is about to be written.

    Checks are one line, and those that are not valid, and costs are one; `verbose` lists all checks, and the costs
    of the slowest vehicles.
    """
    print_checks(judgement, console, verdict["reproduce"], verbose)
    if verdict["reported"]:
        table = _reported(verdict["reported"])
        _print_table("reported by the program: all reports of all vehicles", table, console)
    _print_table("the run", _figures(verdict), console)
    if any(verdict["frames_by_outcome"].values()):
        counts = verdict["frames_by_outcome"]
        _print_table("receptions: one for each frame and receiver in range", _frames(counts), console)
    _print_cost(read_cost(verdict["cost"]), console, verbose)
    if bad := [event for event in folder.events if event.kind == EventKind.log and event.is_bad]:
        which = "" if len(bad) == 1 else f"{len(bad)} warnings and errors, the first "
        text = f"log          {which}at {bad[0].time_ns / NS_PER_S:.3f} s: {bad[0].text}"
        console.print(Text(as_text(text)), soft_wrap=True)
    if (order := verdict["order"]) is not None:
        console.print(f"order        {_order(order)}", highlight=False, soft_wrap=True)
    console.print(f"trace sha256 {verdict['trace_sha256']}", highlight=False)
    console.print(f"files        {folder.path}", highlight=False, soft_wrap=True)
    path = folder.path.absolute() if str(folder.path).startswith("-") else folder.path
    quoted = shlex.quote(str(path))
    following = {verdict["reproduce"]: "run it again", f"vnet check {quoted}": "judge it again"}
    following[f"vnet report {quoted} --open"] = f"read {folder.path / REPORT}" if report else "have a report of it"
    if (recording := path / RECORDING).exists():
        following[f"vnet view {quoted}"] = "look at it"
        if not is_closed(recording):
            following[repair_command(recording)] = "repair the recording, whose observer was killed"
    for number, (command, why) in enumerate(following.items()):
        heading = "" if number else "next"
        console.print(f"{heading:13}{as_typed(command)}   ({why})", highlight=False, soft_wrap=True)


def _order(order: Mapping[str, Any]) -> str:
    """The order of a run that was not simply FIFO."""
    drawn = "" if order["kind"] == "tape" else f", seed {order['seed']}"
    text = f"{order['kind']}{drawn}; deviations from FIFO: {order['deviations']} (tape.jsonl)"
    return text if order["left"] is None else f"{text}; the tape was left at: {order['left']}"


def as_typed(command: str) -> str:
    """A command as this user must type it here: with its folder where that is not on the PATH."""
    try:
        program, *rest = shlex.split(command)
    except ValueError:
        return command
    if shutil.which(program) is None:
        program = str(Path(sys.executable).parent / program)
    return " ".join(_quoted(_from_here(word)) for word in [program, *rest])


def _from_here(word: str) -> str:
    """A path inside the current folder as it is called there, and not as an option; any other word as it is."""
    if not (Path(word).is_absolute() and Path(word).is_relative_to(Path.cwd())):
        return word
    there = str(Path(word).relative_to(Path.cwd()))
    return f"./{there}" if there.startswith("-") else there


def _quoted(word: str) -> str:
    """Quote a word for the shell; the bytes of tabs and the like, which consoles print otherwise, have escapes."""
    if word.isprintable():
        return shlex.quote(word)
    bytes_ = os.fsencode(word)
    plain = (chr(each) if 0x20 <= each < 0x7F and each not in b"\\'" else f"\\{each:03o}" for each in bytes_)
    return f"$'{''.join(plain)}'"


def print_checks(judgement: Judgement, console: Console, reproduce: str, verbose: bool = True) -> None:
    """Print the verdict, and of checks that failed the offending rows and how to reproduce them.

    With `verbose` all checks are listed, otherwise the user's own and those that are not valid; all are counted.
    """
    shown = [check for check in judgement.checks if verbose or _is_told(check)]
    console.print(
        Text(f"verdict: {judgement.verdict}", style=STYLE[judgement.verdict]), _counted(judgement, verbose)
    )
    if shown:
        console.print(_listed(shown))
    if verbose:
        for reason, names in judgement.not_applicable.items():
            console.print(Text(f"not applicable: {', '.join(names)}: {reason}", style="dim"))
    for check in judgement.checks:
        if check.verdict is not Verdict.VALID:
            _print_details(check, console)
        if rows := check.figures.get("rows"):
            console.print(Text(f"{check.name}: the first offending rows", style="bold red"))
            print_offending(rows, console)
    if judgement.verdict is Verdict.INVALID:
        console.print(f"to see this again: {as_typed(reproduce)}", highlight=False, soft_wrap=True)


def _counted(judgement: Judgement, verbose: bool) -> Text:
    """Number of checks by their verdict, behind the verdict of the run."""
    counts = Counter(check.verdict.value for check in judgement.checks)
    left = sum(map(len, judgement.not_applicable.values()))
    parts = [f"{count} {verdict}" for verdict in Verdict if (count := counts[verdict.value])]
    parts += [f"{left} not applicable"] if left else []
    hint = "" if verbose else " (-v lists them)"
    return Text(f" checks: {', '.join(parts) or 'none'}{hint}", style="dim")


def _is_told(check: CheckResult) -> bool:
    """Return whether a check is told to everybody: one that is not valid, has a note, or is the user's own."""
    return check.verdict is not Verdict.VALID or check.text.startswith("note: ") or check.name.startswith(PREFIX)


def _listed(checks: Sequence[CheckResult]) -> Table:
    table = Table("check", "verdict", Column("what was seen", overflow="fold"))
    for check in checks:
        verdict = Text(check.verdict.value, style=STYLE[check.verdict])
        table.add_row(as_text(check.name), verdict, Text(as_text(check.text)))
    return table


def print_offending(rows: Sequence[Mapping[str, Any]], console: Console) -> None:
    """Print the rows that a failed check holds against the run; where a table is too wide, each by itself."""
    table = offending(rows)
    if Measurement.get(console, console.options.update(max_width=WIDEST), table).maximum <= console.width:
        console.print(table)
        return
    for row in rows:
        told = [f"{key} {cell(value)}" for key, value in row.items() if value not in (None, "")]
        console.print(Padding(Text(", ".join(told)), (0, 0, 0, 2)))


def offending(rows: Sequence[Mapping[str, Any]]) -> Table:
    """The rows that a failed check holds against the run."""
    columns = dict.fromkeys(key for row in rows for key in row if row[key] not in (None, ""))
    heads = (Column(as_text(column), overflow="fold") for column in columns)
    table = Table(*heads, box=None, padding=(0, 1, 0, 0))
    for row in rows:
        table.add_row(*(Text(cell(row.get(column))) for column in columns))
    return table


def _print_details(check: CheckResult, console: Console) -> None:
    for item in check.figures.get("gone", [check.figures])[:3]:  # the others are in verdict.json
        for key in ("where", "log_tail"):
            if item.get(key):
                console.print(Text(f"{item.get('node', check.name)} {key}:", style="bold"))
                console.print(Text(as_text(str(item[key]).rstrip())))


def _print_table(title: str, table: Table, console: Console) -> None:
    """Print a table below its title, which may be wider."""
    console.print(Text(title, style="italic"))
    console.print(table)


def _print_cost(cost: RunCost, console: Console, verbose: bool) -> None:
    """Print what a run cost: one line, and with `verbose` the slowest vehicles."""
    if line := cost.line():
        console.print(Text(f"cost         {line}"), soft_wrap=True)
    if verbose and cost.vehicles:
        table = Table(HEADS[0], *map(_of_numbers, HEADS[1:]))
        for vehicle in cost.vehicles[:SLOWEST]:
            table.add_row(*map(Text, vehicle.words()))
        _print_table(f"cost by vehicle: CPU time of its {cost.measured}, the slowest first", table, console)


def _of_numbers(head: str = "") -> Column:
    return Column(head, justify="right")


def _reported(reported: Mapping[str, Mapping[str, Any]]) -> Table:
    table = Table("figure", *map(_of_numbers, ("mean", "5 – 95 %", "at the end")))
    for name, figure in reported.items():
        table.add_row(*map(Text, ReportedFigure(**figure).words(name)))
    return table


def _figures(verdict: dict[str, Any]) -> Table:
    table = Table("", _of_numbers(), show_header=False)
    table.add_row("vehicles", str(verdict["vehicles"]))
    if verdict.get("roadside_units"):
        table.add_row("roadside units", str(verdict["roadside_units"]))
    table.add_row("emulated time", f"{verdict['emulated_s']:.1f} s")
    if verdict["start_up_s"]:
        table.add_row("start of the processes", f"{verdict['start_up_s']:.1f} s")
    table.add_row("wall-clock time of the run", f"{verdict['wall_s']:.1f} s")
    table.add_row("real-time factor", f"{verdict['real_time_factor'] or 0:.2f}")
    if verdict.get("driving"):
        table.add_row("collisions", str(verdict["driving"]["collisions"]))
    if verdict.get("backbone"):
        table.add_row("messages on the backbone", on_backbone(verdict["backbone"]))
    key = [KeyFigure(**each) for each in verdict["key_figures"]]
    for each, value in shown_figures(key, verdict["figures"]):
        table.add_row(f"{each.title} (mean after the first fifth)", each.text(value))
    return table


def _frames(counts: dict[str, int]) -> Table:
    in_range = sum(count for outcome, count in counts.items() if outcome != "out_of_range")
    table = Table("", _of_numbers(), _of_numbers(), show_header=False)
    for outcome, count in counts.items():
        if count and outcome != "out_of_range":
            table.add_row(outcome, f"{count:,}", f"{count / in_range:.2%}")
    if counts.get("out_of_range"):
        table.add_row("out of range", f"{counts['out_of_range']:,}", "")
    return table
