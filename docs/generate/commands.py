"""docs/reference/commands.md: every command and its options, from the structures that parse them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any

import typer
import typer.main

import agents.cli
import emulator.cli.commands
from docs.generate.markdown import page as whole_page
from docs.generate.markdown import table
from emulator.checks.judge import Verdict

INTRODUCTION = """
`vnet` runs scenarios and judges runs. `vnet-agent` is one process with vehicles; `vnet run` starts these processes
itself. Each chapter has a table of commands and one of their options; `--help` prints those of one command.
"""
STATUSES = {
    **{verdict.exit_status: f"the run is {verdict}" for verdict in Verdict},
    2: "wrong usage, or an unusable scenario, folder, credentials file, program or output",
    70: "a bug in vnet; the error names the file with the traceback",
    130: "interrupted by Ctrl-C",
}
AGENT = """
`vnet-agent` ends with 0 when the run is over, 2 if it cannot load the program, and 3 if it does not find the
emulator, is refused, or loses it.
"""
CHAPTERS = {
    "Run a scenario": ("run", "simulate", "demo", "new", "emulator", "host", "access"),
    "A running emulator": ("status", "fault"),
    "Judge and compare runs": ("check", "report", "compare", "diff", "radio", "trace"),
    "Look at runs": ("view", "play", "record", "render", "export"),
    "Many runs": ("campaign", "sweep", "conformance"),
    "Networks and maps": ("analyze", "map"),
}
"""Commands of `vnet` by chapter. `vnet experiment` is not vnet's own: `studies/` registers it."""
PROGRAMS = {"vnet": emulator.cli.commands.app, "vnet-agent": agents.cli.app}
Command = Any
"""A command of typer's; typer brings a click of its own, whose classes it does not export."""


def page() -> str:
    """The whole page."""
    statuses = table(["exit status", "what"], ([str(status), what] for status, what in sorted(STATUSES.items())))
    parts = [INTRODUCTION, statuses, AGENT]
    of = {name: list(group) for name, group in groupby(_of(PROGRAMS["vnet"], "vnet"), lambda each: _path(each)[1])}
    named = {name for names in CHAPTERS.values() for name in names}
    others = {"Other commands": tuple(sorted(of.keys() - named - {"experiment"}))}
    for chapter, names in (CHAPTERS | others).items():
        if found := [context for name in names for context in of.get(name, [])]:
            parts += [f"## {chapter}", *_tables(found)]
    return whole_page("Commands", *parts, "## `vnet-agent`", *_tables(_of(PROGRAMS["vnet-agent"], "vnet-agent")))


def contexts(name: str, command: Command, parent: typer.Context | None = None) -> Iterator[typer.Context]:
    """A command and all below it, each in its context."""
    context = typer.Context(command, info_name=name, parent=parent)
    yield context
    for below, sub in getattr(command, "commands", {}).items():
        yield from contexts(below, sub, context)


def _of(app: typer.Typer, name: str) -> list[typer.Context]:
    """The commands of a program that are no groups."""
    found = contexts(name, typer.main.get_command(app))
    return [each for each in found if not getattr(each.command, "commands", {})]


def _path(context: typer.Context) -> list[str]:
    return context.command_path.split()


def _tables(found: Sequence[typer.Context]) -> Iterator[str]:
    """The commands of a chapter, and their arguments and options: each once, with the commands that take it."""
    rows = ([f"`{context.command_path} {_pieces(context)}`", str(context.command.help)] for context in found)
    yield table(["command", "what it does"], rows)
    commands_of: dict[tuple[str, str], list[str]] = {}
    for context in found:
        for record in _records(context):
            commands_of.setdefault(record, []).append(" ".join(_path(context)[1:]))
    options = ([f"`{name}`", ", ".join(of), what] for (name, what), of in commands_of.items())
    yield table(["argument or option", "of", "what"], options)


def _pieces(context: typer.Context) -> str:
    return " ".join(context.command.collect_usage_pieces(context)).replace("{", "").replace("}", "")


def _records(context: typer.Context) -> list[tuple[str, str]]:
    """The arguments and options of a command, as its help shows them."""
    parameters = [param for param in context.command.get_params(context) if param.name != "help"]
    return [record for param in parameters if (record := param.get_help_record(context))]
