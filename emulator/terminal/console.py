"""Behaviour that all commands share at a terminal: errors in one line, and the exit status."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from enum import StrEnum
from itertools import pairwise

import typer

from vnet.errors import LONGEST_MESSAGE, VnetError, printable

WRONG_USAGE = 2


class LogFormat(StrEnum):
    """Format of the messages on stderr."""

    TEXT = "text"
    JSON = "json"


@contextmanager
def one_line_errors(log_format: LogFormat = LogFormat.TEXT) -> Iterator[None]:
    """Say what went wrong in one line, and end with status 2."""
    try:
        yield
    except VnetError as error:
        _say(str(error), log_format)
        raise typer.Exit(WRONG_USAGE) from None


def tell(message: str, log_format: LogFormat = LogFormat.TEXT) -> None:
    """Say on stderr in one line what a user should know, though nothing is wrong."""
    if log_format is LogFormat.JSON:
        print(json.dumps({"kind": "note", "message": message}), file=sys.stderr)
    else:
        print(f"vnet: note: {message}", file=sys.stderr)


def say_first(line: str) -> None:
    """Print a first line on stderr at once, whatever becomes of stderr."""
    with suppress(OSError, ValueError):
        print(line, file=sys.stderr, flush=True)


def _say(message: str, log_format: LogFormat) -> None:
    if log_format is LogFormat.JSON:
        print(json.dumps({"kind": "error", "message": message, "exit_status": WRONG_USAGE}), file=sys.stderr)
    else:
        print(f"vnet: {message}", file=sys.stderr)


def tolerate_any_sign() -> None:
    """Have standard output print `?` for a sign that the terminal does not know, rather than fail."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def run_app(app: typer.Typer, arguments: Sequence[str]) -> int:
    """Run a command line to its end; returns its exit status. A line that makes no sense gets one line of error."""
    try:
        return app(list(arguments), prog_name="vnet", standalone_mode=False) or 0
    except typer.TyperException as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            print(error.format_message())
        else:
            _say(_in_one_line(error), _asked_for(arguments))
        return WRONG_USAGE


def _in_one_line(error: typer.TyperException) -> str:
    """Say what is wrong with a command line, what may have been meant, and where to read more."""
    meant = getattr(error, "possibilities", None)
    text = f"{error.message}; did you mean {' or '.join(meant)}?" if meant else error.format_message()
    text = " ".join(text.replace("Value error, ", "").replace(". Did you", "; did you").split()).removesuffix(".")
    context = getattr(error, "ctx", None)
    command = "vnet" if context is None else context.command_path
    return printable(f"{text[:1].lower()}{text[1:]} ({command} --help says more)", LONGEST_MESSAGE)


def _asked_for(arguments: Sequence[str]) -> LogFormat:
    """The log format that a command line asks for, even if it makes no sense otherwise."""
    asked = "--log-format=json" in arguments or ("--log-format", "json") in pairwise(arguments)
    return LogFormat.JSON if asked else LogFormat.TEXT
