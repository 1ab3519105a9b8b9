"""Summary that a run prints at its end: verdict, figures, files, and the next commands."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from emulator.checks.judge import Judgement, Verdict
from emulator.pages.text import cell
from emulator.records.key_figures import KEY_FIGURES
from emulator.records.run_folder import RECORDING, REPORT
from emulator.viewer.sinks import is_closed, repair_command

STYLE = {Verdict.VALID: "green", Verdict.INVALID: "bold red", Verdict.UNKNOWN: "yellow"}


def print_summary(
    judgement: Judgement, verdict: dict[str, Any], folder: Path, console: Console, report: bool = False
) -> None:
    """The whole summary of a run that has just ended; with `report`, its report is about to be written."""
    print_checks(judgement, console, verdict["reproduce"])
    console.print(_figures(verdict))
    console.print(_frames(verdict["frames_by_outcome"]))
    console.print(f"trace sha256 {verdict['trace_sha256']}", highlight=False)
    console.print(f"files        {folder}", highlight=False, soft_wrap=True)
    following = {verdict["reproduce"]: "the same run again", f"vnet check {folder}": "judge it again"}
    following[f"vnet report {folder} --open"] = f"read {folder / REPORT}" if report else "have a report of it"
    if (recording := folder / RECORDING).exists():
        following[f"vnet view {folder}"] = "look at it"
        if not is_closed(recording):
            following[repair_command(recording)] = "repair the recording, whose observer was killed"
    for number, (command, why) in enumerate(following.items()):
        heading = "" if number else "next"
        console.print(f"{heading:13}{as_typed(command)}   ({why})", highlight=False, soft_wrap=True)


def as_typed(command: str) -> str:
    """A command as this user must type it: with its folder where that is not on the PATH."""
    program, _, rest = command.partition(" ")
    if shutil.which(program) is None:
        beside = Path(sys.executable).parent / program
        program = str(beside.relative_to(Path.cwd())) if beside.is_relative_to(Path.cwd()) else str(beside)
    return f"{program} {rest}"


def print_checks(judgement: Judgement, console: Console, reproduce: str) -> None:
    """The verdict and its checks; of those that failed the offending rows, and how to have them again."""
    table = Table(title=Text(f"verdict: {judgement.verdict}", style=STYLE[judgement.verdict]), title_justify="left")
    table.add_column("check")
    table.add_column("verdict")
    table.add_column("what was seen", overflow="fold")
    for check in judgement.checks:
        table.add_row(check.name, Text(check.verdict.value, style=STYLE[check.verdict]), Text(check.text))
    console.print(table)
    for reason, names in judgement.not_applicable.items():
        console.print(Text(f"not applicable: {', '.join(names)}: {reason}", style="dim"))
    for check in judgement.checks:
        if check.verdict is not Verdict.VALID:
            _print_details(check.figures, console)
        if rows := check.figures.get("rows"):
            console.print(Text(f"{check.name}: the first offending rows", style="bold red"))
            console.print(offending(rows))
    if judgement.verdict is Verdict.INVALID:
        console.print(f"to see this again: {as_typed(reproduce)}", highlight=False, soft_wrap=True)


def offending(rows: Sequence[Mapping[str, Any]]) -> Table:
    """The rows that a failed check holds against the run."""
    table = Table(box=None, padding=(0, 1, 0, 0))
    columns = dict.fromkeys(key for row in rows for key in row if row[key] not in (None, ""))
    for column in columns:
        table.add_column(column, overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell(row.get(column))) for column in columns))
    return table


def _print_details(figures: dict[str, Any], console: Console) -> None:
    for item in figures.get("gone", [figures])[:3]:  # the others are in verdict.json
        for key in ("where", "log_tail"):
            if item.get(key):
                console.print(Text(f"{item.get('node', '')} {key}:", style="bold"))
                console.print(Text(str(item[key]).rstrip()))


def _figures(verdict: dict[str, Any]) -> Table:
    table = Table(title="figures (means after the first fifth of the run)", title_justify="left", show_header=False)
    table.add_column()
    table.add_column(justify="right")
    table.add_row("vehicles", str(verdict["vehicles"]))
    table.add_row("emulated time", f"{verdict['emulated_s']:.1f} s")
    if verdict["start_up_s"]:
        table.add_row("start of the processes", f"{verdict['start_up_s']:.1f} s")
    table.add_row("wall-clock time of the run", f"{verdict['wall_s']:.1f} s")
    table.add_row("real-time factor", f"{verdict['real_time_factor'] or 0:.2f}")
    for name, title in KEY_FIGURES.items():
        if (value := verdict["figures"].get(name)) is not None:
            table.add_row(title, f"{value:.3f} m")
    return table


def _frames(counts: dict[str, int]) -> Table:
    in_range = sum(count for outcome, count in counts.items() if outcome != "out_of_range")
    table = Table(title="frames, by receiver in range", title_justify="left", show_header=False)
    table.add_column()
    table.add_column(justify="right")
    table.add_column(justify="right")
    for outcome, count in counts.items():
        if count and outcome != "out_of_range":
            table.add_row(outcome, f"{count:,}", f"{count / in_range:.2%}")
    if counts.get("out_of_range"):
        table.add_row("out of range", f"{counts['out_of_range']:,}", "")
    return table
