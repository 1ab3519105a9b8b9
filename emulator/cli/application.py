"""The command line of `vnet` as an application of Typer's: the wanted commands, and stubs of the others."""

from __future__ import annotations

from collections.abc import Callable, Collection
from importlib import import_module
from typing import Annotated, Any

import typer

from emulator.cli.help import group
from emulator.cli.table import COMMANDS, REGISTRY, Command
from emulator.terminal.console import one_line_errors
from vnet.errors import VnetError

ANY_ARGUMENTS = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
"""Settings of a command that refuses whatever it is asked, its help too."""


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
    target = _load(command) if import_it else _stub
    settings = None if target is not None else ANY_ARGUMENTS
    if isinstance(target, typer.Typer):
        app.add_typer(target, name=command.name, short_help=command.summary, rich_help_panel=command.panel)
    else:
        added = app.command(
            command.name, short_help=command.summary, rich_help_panel=command.panel, context_settings=settings
        )
        added(target or _refusal(command))


def _load(command: Command) -> Any:
    """Import a command; None for one from elsewhere that is not installed, or whose folder is gone."""
    if not command.elsewhere:
        return getattr(import_module(f"emulator.cli.{command.module}"), command.attribute)
    from importlib.metadata import entry_points

    for entry in entry_points(group=REGISTRY, name=command.name):
        try:
            return entry.load()
        except ModuleNotFoundError as error:
            if error.name not in (entry.module, entry.module.partition(".")[0]):
                raise
    return None


def _refusal(command: Command) -> Callable[[], None]:
    """Stand for a command that is not installed: one line says where it is."""

    def refuse() -> None:
        with one_line_errors():
            raise VnetError(f"{command.name}: {command.elsewhere}")

    return refuse


def _stub() -> None:
    """Stand for a command that this command line does not name."""
    raise AssertionError("a stub was called")
