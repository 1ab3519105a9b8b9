"""Behaviour that all commands share at a terminal: errors in one line, and the exit status."""

from __future__ import annotations

import errno
import json
import re
import shlex
import sys
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from enum import StrEnum
from itertools import pairwise
from typing import Any

import typer
import typer.main

from vnet.errors import LONGEST_MESSAGE, VnetError, printable
from vnet.extras import missed_by
from vnet.runtime import interrupts

WRONG_USAGE = 2
BUG = 70
"""Exit status for a bug of vnet's own: EX_SOFTWARE of sysexits.h."""
REFUSED_BY_THE_SYSTEM = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.EMFILE,
    errno.ENFILE,
    errno.ENOMEM,
    errno.EFBIG,
    errno.EIO,
    errno.EAGAIN,
)
"""Errors that say something of the machine, and not of vnet."""
OUT_OF_MEMORY = ("failed to map segment", "cannot allocate memory", "can't start new thread")
"""Parts of the messages of other errors than MemoryError with which libraries say that there is no memory."""
_KINDS_OF_VALUES = {"integer": "a whole number", "number": "a number", "boolean": "true or false"}
"""Values of options as pydantic names them, and as vnet does."""


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


def _say(message: str, log_format: LogFormat, status: int = WRONG_USAGE) -> None:
    if log_format is LogFormat.JSON:
        print(json.dumps({"kind": "error", "message": message, "exit_status": status}), file=sys.stderr)
    else:
        print(f"vnet: {message}", file=sys.stderr)


def run_app(app: typer.Typer, arguments: Sequence[str]) -> int:
    """Run a command line to its end; returns its exit status.

    A line that makes no sense, and whatever else goes wrong, gets one line of error.
    """
    try:
        command: Any = typer.main.get_command(app)
        with command.make_context("vnet", list(arguments)) as context:
            interrupts.raise_from_now_on()
            command.invoke(context)
        return 0
    except typer.Exit as end:
        return end.exit_code
    except typer.TyperException as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            print(error.format_message())
        else:
            _say(_in_one_line(error), _asked_for(arguments))
        return WRONG_USAGE
    except KeyboardInterrupt:
        return interrupts.INTERRUPTED
    except Exception as error:
        return _say_unexpected(error, arguments)


def say_output_failed(error: OSError, arguments: Sequence[str]) -> int:
    """Say that standard output could not be written; returns the exit status."""
    _say(f"standard output: cannot be written: {error.strerror}", _asked_for(arguments))
    return WRONG_USAGE


def _say_unexpected(error: Exception, arguments: Sequence[str]) -> int:
    """Say in one line what no command has foreseen; returns the exit status."""
    chain: BaseException | None = error
    while chain is not None:  # extension modules turn an interrupt during their import into an ImportError
        if isinstance(chain, KeyboardInterrupt):
            return interrupts.INTERRUPTED
        chain = chain.__cause__ or chain.__context__
    log_format = _asked_for(arguments)
    if isinstance(error, OSError) and error.errno in REFUSED_BY_THE_SYSTEM:
        where = "" if error.filename is None else f"{printable(str(error.filename))}: "
        _say(f"{where}{error.strerror}", log_format)
        return WRONG_USAGE
    if needed := missed_by(error):
        _say(f"this command {needed}", log_format)
        return WRONG_USAGE
    what = printable(f"{type(error).__name__}: {error}", LONGEST_MESSAGE)
    if isinstance(error, MemoryError) or any(part in str(error).lower() for part in OUT_OF_MEMORY):
        _say(f"not enough memory: {what}", log_format)
        return WRONG_USAGE
    _say(f"a bug in vnet: {what}; please report it with {_keep_traceback(error, arguments)}", log_format, BUG)
    return BUG


def _keep_traceback(error: Exception, arguments: Sequence[str]) -> str:
    """Write a traceback into a file of its own; returns where it is."""
    text = "".join(traceback.format_exception(error))
    try:
        with tempfile.NamedTemporaryFile("w", prefix="vnet-bug-", suffix=".txt", delete=False) as file:
            file.write(f"{shlex.join(['vnet', *arguments])}\nPython {sys.version}\n\n{text}")
    except OSError:
        return f"its traceback, which could not be written: {traceback.extract_tb(error.__traceback__)[-1]}"
    return f"its traceback, {file.name}"


def _in_one_line(error: typer.TyperException) -> str:
    """Say what is wrong with a command line, what may have been meant, and where to read more."""
    meant = getattr(error, "possibilities", None)
    text = f"{error.message}; did you mean {' or '.join(meant)}?" if meant else error.format_message()
    text = " ".join(text.replace("Value error, ", "").replace(". Did you", "; did you").split()).removesuffix(".")
    for kind, needed in _KINDS_OF_VALUES.items():
        text = re.sub(rf"Input should be a valid {kind}(, unable to .*)?$", f"{needed} is needed", text)
    text = text.replace("Input should be ", "must be ")
    context = getattr(error, "ctx", None)
    command = "vnet" if context is None else context.command_path
    return printable(f"{text[:1].lower()}{text[1:]} ({command} --help says more)", LONGEST_MESSAGE)


def _asked_for(arguments: Sequence[str]) -> LogFormat:
    """The log format that a command line asks for, even if it makes no sense otherwise."""
    asked = "--log-format=json" in arguments or ("--log-format", "json") in pairwise(arguments)
    return LogFormat.JSON if asked else LogFormat.TEXT
