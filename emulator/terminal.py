"""What all commands do at a terminal: errors of one line, and an exit status that says what kind."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from vnet.errors import VnetError


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Say what went wrong in one line, and end with status 2."""
    try:
        yield
    except VnetError as error:
        print(f"vnet: {error}", file=sys.stderr)
        raise typer.Exit(2) from None
