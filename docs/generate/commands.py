"""docs/reference/commands.md: every command and its options, from the structures that parse them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
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
itself. `--help` of each command prints the same text.
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
COMMON = """
Options that three or more commands have. Each command below names those that it takes.
"""
SHARED_BY = 3
"""Number of commands from which on an option is described once."""
PROGRAMS = {"vnet": emulator.cli.commands.app, "vnet-agent": agents.cli.app}
Command = Any
"""A command of typer's; typer brings a click of its own, whose classes it does not export."""


def page() -> str:
    """The whole page."""
    statuses = table(["exit status", "what"], ([str(status), what] for status, what in sorted(STATUSES.items())))
    found = [each for name, app in PROGRAMS.items() for each in contexts(name, typer.main.get_command(app))]
    counts = Counter(record for context in found if _has_chapter(context) for record in _records(context))
    by_name = {name: (name, what) for (name, what), count in reversed(counts.most_common()) if count >= SHARED_BY}
    shared = [record for record in counts if record in by_name.values() and record[0].startswith("-")]
    common = table(["option", "what"], ([f"`{name}`", what] for name, what in shared))
    parts = [INTRODUCTION, statuses, AGENT, "## Common options", COMMON, common]
    return whole_page("Commands", *parts, *(part for context in found for part in _command(context, shared)))


def contexts(name: str, command: Command, parent: typer.Context | None = None) -> Iterator[typer.Context]:
    """A command and all below it, each in its context."""
    context = typer.Context(command, info_name=name, parent=parent)
    yield context
    for below, sub in getattr(command, "commands", {}).items():
        yield from contexts(below, sub, context)


def _command(context: typer.Context, shared: Collection[tuple[str, str]]) -> Iterator[str]:
    """A chapter of a command, or of a group of commands: these have no chapters of their own."""
    path = context.command_path
    if commands := getattr(context.command, "commands", {}):
        yield f"## `{path}`"
        yield str(context.command.help)
        below = {name: typer.Context(sub, info_name=name, parent=context) for name, sub in commands.items()}
        if path in PROGRAMS:
            rows = ([f"[`{path} {name}`](#{path}-{name})", _first(sub)] for name, sub in commands.items())
        else:
            rows = ([f"`{_usage(each)}`", each.command.help or ""] for each in below.values())
        yield table(["command", "what it does"], rows)
        if path not in PROGRAMS:
            commands_of: dict[tuple[str, str], list[str]] = {}
            for name, each in below.items():
                for record in _records(each):
                    commands_of.setdefault(record, []).append(name)
            rows = ([f"`{name}`", ", ".join(of), what] for (name, what), of in commands_of.items())
            yield table(["argument or option", "of", "what"], rows)
    elif _has_chapter(context):
        yield f"## `{path}`"
        yield str(context.command.help)
        records = _records(context)
        own = [[f"`{name}`", what] for name, what in records if (name, what) not in shared]
        common = ", ".join(f"`{_name(name)}`" for name, what in records if (name, what) in shared)
        kept = [["common options", common]] if common else []
        yield table(["argument or option", "what"], [["usage", f"`{_usage(context)}`"], *own, *kept])


def _has_chapter(context: typer.Context) -> bool:
    """Return False for the commands of a group."""
    return context.parent is None or context.parent.command_path in PROGRAMS


def _usage(context: typer.Context) -> str:
    pieces = " ".join(context.command.collect_usage_pieces(context)).replace("{", "").replace("}", "")
    return f"{context.command_path} {pieces}"


def _records(context: typer.Context) -> list[tuple[str, str]]:
    """The arguments and options of a command, as its help shows them."""
    if getattr(context.command, "commands", {}):
        return []
    parameters = [param for param in context.command.get_params(context) if param.name != "help"]
    return [record for param in parameters if (record := param.get_help_record(context))]


def _name(option: str) -> str:
    """The last name of an option, without its value: `--verbose` of `-v, --verbose`."""
    return option.split(" / ")[0].split(", ")[-1].split()[0]


def _first(command: Command) -> str:
    return str(command.help).partition("\n\n")[0]
