"""The command line of `vnet` as an application of Typer's: wanted commands, stubs of others, and plain help."""

from __future__ import annotations

from collections.abc import Callable, Collection
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from emulator.cli.table import COMMANDS, REGISTRY, Command
from emulator.terminal.console import one_line_errors
from vnet.errors import VnetError

DEFAULTS = {"--check-determinism": "--check-determinism=layouts"}
"""Values of options that may be given without one."""
ANY_ARGUMENTS = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
"""Settings of a command that refuses whatever it is asked, its help too."""


class _Group(TyperGroup):
    """A group of commands whose help lists them by panel, with nothing cut off."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Give the one option whose value may be left out, which Typer does not have, its default."""
        return super().parse_args(ctx, [DEFAULTS.get(each, each) for each in args])

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each panel's commands, their names aligned over all panels."""
        width = max(map(len, self.commands))
        panels: dict[str, list[tuple[str, str]]] = {}
        for name, command in self.commands.items():
            panel: Any = getattr(command, "rich_help_panel", None)
            row = (name.ljust(width), command.short_help or command.help or "")
            panels.setdefault(panel or "Commands", []).append(row)
        for panel, rows in panels.items():
            with formatter.section(panel):
                formatter.write_dl(rows)


def group(about: str) -> typer.Typer:
    """Return an empty group of commands, which is about `about`."""
    return typer.Typer(
        cls=_Group,
        help=about,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        no_args_is_help=True,
    )


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
