"""Help as plain text: the tables that Typer draws with rich break their columns at 80 characters."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperGroup

DEFAULTS = {"--check-determinism": "--check-determinism=layouts"}
"""Values of options that may be given without one."""


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
