"""`vnet fault` and `vnet status`: an operator's commands against a running emulator."""

from __future__ import annotations

import json
import sys
import time
import tomllib
from pathlib import Path
from typing import Annotated, Any

import typer
from msgspec import convert
from rich.table import Table

from emulator.cli.application import group
from emulator.cli.options import LATEST
from emulator.drivers.control import ask
from emulator.drivers.status import Snapshot
from emulator.scenario.faults import KINDS, OwnRule, parse_fault
from emulator.terminal.console import one_line_errors
from emulator.terminal.live import LivePicture, SafeConsole, terminal
from emulator.terminal.progress import Dashboard
from vnet.errors import ScenarioError, VnetError, first_names

app = group("Inject faults into a running emulator, and heal them.")

RunOption = Annotated[Path, typer.Option("--run", metavar="FOLDER", help="The folder of the run.")]
INJECTED = [name for name, kind in KINDS.items() if not issubclass(kind, OwnRule)]
"""Kinds that an operator may inject: rules are code, which a scenario brings."""
WATCH_EVERY_S = 1.0
ALL_ROWS = 50


@app.command()
def inject(
    kind: Annotated[str, typer.Argument(metavar="KIND", help=f"One of {', '.join(INJECTED)}.")],
    lasting: Annotated[float, typer.Option("--for", metavar="SECONDS", help="How long, in emulated time.")] = 5.0,
    at: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="When, in emulated time. Default: now, as of a time that is past."),
    ] = None,
    parameters: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="A parameter, as in a scenario: probability=0.5, nodes.count=3. May be repeated.",
        ),
    ] = None,
    run: RunOption = LATEST,
) -> None:
    """Start a fault: vnet fault inject loss --for 5 --set probability=0.5"""
    with one_line_errors():
        fault: dict[str, Any] = {"kind": kind, "duration_s": lasting}
        if at is not None:
            fault["at_s"] = at
        for parameter in parameters or []:
            _set(fault, parameter)
        if isinstance(parse_fault(fault), OwnRule):  # what is wrong is said before anybody is asked
            raise ScenarioError(f"{kind}: a rule is part of the scenario: write it as [[fault]] there")
        _show([ask(run, "inject", fault)])


@app.command()
def heal(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The fault's name, such as loss-0; or all.")],
    run: RunOption = LATEST,
) -> None:
    """End a fault now."""
    with one_line_errors():
        healed = ask(run, "heal", name)["healed"]
        print(f"healed: {', '.join(healed) or 'nothing was broken'}")


@app.command("list")
def list_faults(run: RunOption = LATEST) -> None:
    """All faults of the run: those that were, are and will be."""
    with one_line_errors():
        if faults := ask(run, "status")["faults"]:
            _show(faults)
        else:
            print("no faults are planned")


def status(
    run: RunOption = LATEST,
    as_json: Annotated[
        bool, typer.Option("--json", metavar="", help="As one JSON object; docs/viewing.md says what is in it.")
    ] = False,
    watch: Annotated[
        bool, typer.Option("--watch", metavar="", help="Go on showing it until the run is over.")
    ] = False,
) -> None:
    """Show the progress of a running emulator: time, vehicles, errors, frames, faults, events."""
    with one_line_errors():
        if as_json and watch:
            raise VnetError("--json and --watch exclude each other")
        found = ask(run, "status")
        if as_json:
            print(json.dumps(found))
        elif watch:
            _watch(run, convert(found, Snapshot))
        else:
            SafeConsole().print(Dashboard(convert(found, Snapshot), steady=False), height=ALL_ROWS, end="")


def _watch(run: Path, shot: Snapshot) -> None:
    """Show how a run gets on until it is over."""
    console = terminal(sys.stdout)
    if console is None:
        raise VnetError("--watch: needs a terminal; elsewhere use --json, now and then")
    taken_s = time.monotonic()
    with LivePicture(console, lambda: Dashboard(shot, time.monotonic() - taken_s)):
        while True:
            time.sleep(WATCH_EVERY_S)
            try:
                shot, taken_s = convert(ask(run, "status"), Snapshot), time.monotonic()
            except VnetError:
                break
    print(f"{run}: the run is over")


def _set(fault: dict[str, Any], parameter: str) -> None:
    key, equals, text = parameter.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise ScenarioError(f"--set {parameter}: write it as key=value, for example probability=0.3")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    table = fault
    for part in parts[:-1]:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise ScenarioError(f"--set {parameter}: {part} is not a table")
    table[parts[-1]] = value


def _show(faults: list[dict[str, Any]]) -> None:
    table = Table("fault", "state", "from", "to", "nodes")
    for fault in faults:
        shown = first_names(fault["nodes"], 6, with_total=True)
        table.add_row(fault["fault"], fault["state"], f"{fault['start_s']:.3f} s", f"{fault['end_s']:.3f} s", shown)
    SafeConsole().print(table)
