"""A command of `vnet` by itself, as an application that a test can invoke."""

from collections.abc import Callable

import typer


def command_app(command: Callable[..., None]) -> typer.Typer:
    """Return an application of one command."""
    app = typer.Typer()
    app.command()(command)
    return app
