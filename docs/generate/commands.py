"""docs/reference/commands.md: every command and its options, from the structures that parse them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import typer
import typer.main

import agents.cli
import emulator.cli.commands
from docs.generate.markdown import page as whole_page
from docs.generate.markdown import table
from emulator.checks.judge import Verdict

INTRODUCTION = """
`vnet` runs and judges; `vnet-agent` is one process with vehicles in it, which `vnet run` starts by itself. Each
command tells the same with `--help`.
"""
STATUSES = {
    **{verdict.exit_status: f"the run is {verdict}" for verdict in Verdict},
    2: "wrong usage, or what cannot be used: a scenario, a folder, a credentials file, a program, an output",
    70: "a bug in vnet; the line of error says which file has its traceback",
    130: "interrupted by Ctrl-C",
}
AGENT = """
`vnet-agent` ends with 0 when the run is over, 2 if the program cannot be loaded, 3 if the emulator was not found,
has refused, or is gone.
"""
PROGRAMS = {"vnet": emulator.cli.commands.app, "vnet-agent": agents.cli.app}
Command = Any
"""A command of typer's; typer brings a click of its own, whose classes it does not export."""


def page() -> str:
    """The whole page."""
    statuses = table(["exit status", "what"], ([str(status), what] for status, what in sorted(STATUSES.items())))
    parts = [INTRODUCTION, statuses, AGENT]
    for name, app in PROGRAMS.items():
        for context in contexts(name, typer.main.get_command(app)):
            parts += _command(context)
    return whole_page("Commands", *parts)


def contexts(name: str, command: Command, parent: typer.Context | None = None) -> Iterator[typer.Context]:
    """A command and all below it, each in its context."""
    context = typer.Context(command, info_name=name, parent=parent)
    yield context
    for below, sub in getattr(command, "commands", {}).items():
        yield from contexts(below, sub, context)


def _command(context: typer.Context) -> Iterator[str]:
    command = context.command
    yield f"## `{context.command_path}`"
    yield str(command.help)
    if commands := getattr(command, "commands", {}):
        yield table(
            ["command", "what it does"],
            ([_link(f"{context.command_path} {name}"), sub.help or ""] for name, sub in commands.items()),
        )
        return
    pieces = " ".join(command.collect_usage_pieces(context)).replace("{", "").replace("}", "")
    yield f"```text\n{context.command_path} {pieces}\n```"
    records = [param.get_help_record(context) for param in command.get_params(context) if param.name != "help"]
    yield table(["argument or option", "what"], ([f"`{name}`", what] for name, what in filter(None, records)))


def _link(command: str) -> str:
    return f"[`{command}`](#{command.replace(' ', '-')})"
