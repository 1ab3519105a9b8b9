"""docs/reference/commands.md: every command and its options, from the structures that parse them."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any

import typer
import typer.main

import agents.cli
from docs.generate.markdown import page as whole_page
from docs.generate.markdown import table
from emulator.checks.judge import Verdict
from emulator.cli.application import build_app

INTRODUCTION = """
`vnet` runs scenarios and judges runs. `vnet-agent` is one process with vehicles; `vnet run` starts these processes
itself. Each chapter has a table of commands and one of their options; `--help` prints those of one command.
"""
SHARED = "Commands of several chapters take these:"
STATUSES = {
    **{verdict.exit_status: f"the run is {verdict}" for verdict in Verdict},
    2: "wrong usage, or an unusable scenario, folder, credentials file, program or output",
    70: "a bug in vnet (the error names the file with the traceback)",
    130: "interrupted by Ctrl-C",
}
AGENT = """
`vnet-agent` ends with 0 when the run is over, 2 if it cannot load the program, and 3 if it does not find the
emulator, is refused, or loses it.
"""
CHAPTERS = {
    "Run a scenario": ("run", "simulate", "demo", "new", "emulator", "host", "access"),
    "A running emulator": ("status", "fault"),
    "Judge and compare runs": ("check", "report", "compare", "radio", "trace"),
    "Look at runs": ("view", "record", "render", "export"),
    "Many runs": ("campaign", "sweep"),
    "Networks and maps": ("analyze", "map"),
}
"""Commands of `vnet` by chapter. `vnet experiment` is not vnet's own: `studies/` registers it."""
PROGRAMS = {"vnet": build_app(), "vnet-agent": agents.cli.app}
Command = Any
"""A command of typer's; typer brings a click of its own, whose classes it does not export."""


def page() -> str:
    """The whole page."""
    statuses = "; ".join(f"{status}: {what}" for status, what in sorted(STATUSES.items()))
    parts = [INTRODUCTION, textwrap.fill(f"Exit statuses are {statuses}. {' '.join(AGENT.split())}", 120)]
    of = {name: list(group) for name, group in groupby(_of(PROGRAMS["vnet"], "vnet"), lambda each: _path(each)[1])}
    named = {name for names in CHAPTERS.values() for name in names}
    others = {"Other commands": tuple(sorted(of.keys() - named - {"experiment"}))}
    chapters = {
        chapter: [context for name in names for context in of.get(name, [])]
        for chapter, names in (CHAPTERS | others).items()
    } | {"`vnet-agent`": _of(PROGRAMS["vnet-agent"], "vnet-agent")}
    options = {chapter: _options(found) for chapter, found in chapters.items()}
    shared = _shared(options)
    parts += [SHARED, _table(shared)]
    for chapter, found in chapters.items():
        rows = ([f"`{each.command_path} {_pieces(each)}`", str(each.command.help)] for each in found)
        own = {option: commands for option, commands in options[chapter].items() if option not in shared}
        parts += [f"## {chapter}", table(["command", "what it does"], rows), _table(own)] if found else []
    return whole_page("Commands", *parts)


Options = dict[tuple[str, str], list[str]]
"""Names and text of an argument or option, with the commands that take it."""


def _options(found: Sequence[typer.Context]) -> Options:
    """Return the arguments and options of some commands, each once."""
    commands_of: Options = {}
    for context in found:
        for record in _records(context):
            commands_of.setdefault(record, []).append(" ".join(_path(context)[1:]) or "vnet-agent")
    return commands_of


def _shared(options: Mapping[str, Options]) -> Options:
    """Return the options that commands of several chapters take, with all these commands."""
    count = Counter(option for of in options.values() for option in of)
    return {
        option: [command for of in options.values() for command in of.get(option, [])]
        for option in count
        if count[option] > 1
    }


def _table(options: Options) -> str:
    rows = ([f"`{name}`", ", ".join(of), what] for (name, what), of in options.items())
    return table(["argument or option", "of", "what"], rows)


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


def _pieces(context: typer.Context) -> str:
    return " ".join(context.command.collect_usage_pieces(context)).replace("{", "").replace("}", "")


def _records(context: typer.Context) -> list[tuple[str, str]]:
    """The arguments and options of a command, as its help shows them."""
    parameters = [param for param in context.command.get_params(context) if param.name != "help"]
    return [record for param in parameters if (record := param.get_help_record(context))]
