"""The command line of `vnet` as an application of Typer's: the wanted commands, and stubs of the others."""

from __future__ import annotations

from collections.abc import Collection
from importlib import import_module
from typing import Annotated

import typer

from emulator.cli.help import group
from emulator.cli.table import COMMANDS, Command


def build_app(wanted: Collection[Command] = COMMANDS) -> typer.Typer:
    """Return the application; commands that are not wanted are not imported, only listed."""
    app = group("An asyncio message-passing emulator for connected vehicles over Zenoh.")
    app.callback()(_vnet)
    for command in COMMANDS:
        _add(app, command, import_it=command in wanted)
    return app


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version  # takes a third of the time of all other imports of `vnet --help`

        print(f"vnet {version('vnet-emulator')}")
        raise typer.Exit


def _vnet(
    show_version: Annotated[
        bool,
        typer.Option(
            "--version", metavar="", callback=_print_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Options of `vnet` itself; its help is that of the group."""


def _add(app: typer.Typer, command: Command, import_it: bool) -> None:
    """Add one command, or a stub that help and "did you mean" know."""
    target = getattr(import_module(f"emulator.cli.{command.module}"), command.attribute) if import_it else _stub
    if isinstance(target, typer.Typer):
        app.add_typer(target, name=command.name, short_help=command.summary, rich_help_panel=command.panel)
    else:
        app.command(command.name, short_help=command.summary, rich_help_panel=command.panel)(target)


def _stub() -> None:
    """Stand for a command that this command line does not name."""
    raise AssertionError("a stub was called")
