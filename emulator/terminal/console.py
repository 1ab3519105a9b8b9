"""Errors in one line, the exit status, and output that never fails: the same for all commands at a terminal.

A reader that goes away, as `head` does, is no reason to end a run, nor is a full disk: what cannot be written is
dropped, and the command goes on to its end.

Where standard output is for the result, whatever the programs of a run print, descriptor 1 is turned away, so that
what C code prints, or a process that a program starts, is kept from the result as well. It is kept in a file
instead, in memory until there is a folder for it.
"""

from __future__ import annotations

import ctypes
import errno
import io
import json
import os
import re
import shlex
import sys
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import typer
import typer.main

from vnet.errors import LONGEST_MESSAGE, VnetError, check_utf8, printable, sendable
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
NOBODY_READS = (errno.EPIPE, errno.EIO, errno.ENXIO)
"""Errors of a pipe without a reader, and of a terminal that is gone: nothing is wrong with the command."""


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
        with one_line_errors(_asked_for(arguments)):
            _refuse_other_than_utf8(arguments)
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


def _refuse_other_than_utf8(arguments: Sequence[str]) -> None:
    """Raise VnetError for an argument or a current folder with other bytes."""
    for argument in arguments:
        check_utf8(argument)
    with suppress(FileNotFoundError):  # a current folder that is gone
        check_utf8(str(Path.cwd()))


def _has_folder() -> bool:
    """Return whether the current folder is there."""
    try:
        return Path.cwd().is_dir()
    except FileNotFoundError:
        return False


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
    if isinstance(error, FileNotFoundError) and not _has_folder():
        _say("the current folder is not there any more", log_format)
        return WRONG_USAGE
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
        with tempfile.NamedTemporaryFile(prefix="vnet-bug-", suffix=".txt", delete=False) as file:
            file.write(sendable(f"{shlex.join(['vnet', *arguments])}\nPython {sys.version}\n\n{text}").encode())
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


class Tolerant(io.FileIO):
    """A descriptor that is written to until that fails, and then drops everything; `failure` is the error."""

    failure: OSError | None = None

    def write(self, data: Any, /) -> int:
        """Write `data`, or drop it."""
        if self.failure is None:
            try:
                return super().write(data)
            except BlockingIOError:
                raise
            except OSError as error:
                self.failure = error
        return len(data)


def tolerate_failures() -> None:
    """Put tolerant streams in the place of standard output and error, where these are descriptors 1 and 2.

    A sign that a terminal does not know is printed as `?`.
    """
    sys.stdout = _tolerant(sys.stdout, 1)
    sys.stderr = _tolerant(sys.stderr, 2)


def failure() -> OSError | None:
    """Return why output could not be written; None if it was, or nobody read it. Writes what is held back."""
    for stream in (sys.stdout, sys.stderr):
        raw = getattr(getattr(stream, "buffer", None), "raw", None)
        if isinstance(raw, Tolerant):
            stream.flush()
            if raw.failure is not None and raw.failure.errno not in NOBODY_READS:
                return raw.failure
    return None


def _tolerant(stream: Any, descriptor: int) -> Any:
    if not isinstance(stream, io.TextIOWrapper) or stream.fileno() != descriptor:
        return stream
    stream.flush()
    return io.TextIOWrapper(
        io.BufferedWriter(Tolerant(descriptor, "w", closefd=False)),
        encoding=stream.encoding,
        errors="replace" if descriptor == 1 else "backslashreplace",
        line_buffering=stream.line_buffering or stream.write_through,
    )


STDOUT = 1


class StandardOutput:
    """Standard output as it is: a result is printed, and so is all that programs print."""

    def keep_in(self, logs: Path) -> None:
        """Keep what programs print in this folder from now on, if it is kept from standard output."""

    def print(self, text: str) -> None:
        """Print a result."""
        print(text, flush=True)


class ResultOnly(StandardOutput):
    """Standard output turned away from whatever prints within the block; `print` reaches it.

    In a process of a command's own, where `sys.stdout` is descriptor 1, it stays turned away after the block:
    threads and exit handlers of programs print until the process has ended.
    """

    def __enter__(self) -> ResultOnly:
        _flush()
        self._stdout = sys.stdout
        self._own_process = _is_on_descriptor(sys.stdout)
        self._kept = os.dup(STDOUT)
        with TemporaryFile() as file:
            self._log = os.dup(file.fileno())
        self._turn_away()
        return self

    def _turn_away(self) -> None:
        os.dup2(self._log, STDOUT)
        if not self._own_process:  # a caller has put another in its place
            sys.stdout = open(STDOUT, "w", closefd=False)  # noqa: SIM115

    def _turn_back(self) -> None:
        _flush()
        os.dup2(self._kept, STDOUT)
        sys.stdout = self._stdout

    def keep_in(self, logs: Path) -> None:
        """Move what was printed so far into the folder, and keep there what follows."""
        _flush()
        from emulator.records.disk import disk_errors  # slow to import, and `--help` does without
        from emulator.records.run_folder import PROGRAMS_LOG

        path = logs / PROGRAMS_LOG
        with disk_errors(path):
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
            os.lseek(self._log, 0, os.SEEK_SET)
            while part := os.read(self._log, 1 << 20):
                os.write(file, part)
        os.close(self._log)
        self._log = file
        os.dup2(file, STDOUT)

    def print(self, text: str) -> None:
        """Print a result."""
        self._turn_back()
        try:
            print(text, flush=True)
        finally:
            self._turn_away()

    def __exit__(self, *error: object) -> None:
        if not self._own_process:
            self._turn_back()
        os.close(self._kept)
        os.close(self._log)


def _is_on_descriptor(stream: object) -> bool:
    try:
        return stream.fileno() == STDOUT  # type: ignore[attr-defined, no-any-return]
    except (AttributeError, OSError, ValueError):
        return False


def _flush() -> None:
    """Write what Python and C hold back for descriptor 1, which would end up where it leads later."""
    with suppress(OSError, ValueError, AttributeError):
        sys.stdout.flush()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).fflush(None)


@contextmanager
def result_only(wanted: bool) -> Iterator[StandardOutput]:
    """Standard output that only a result reaches, if `wanted`; else as it is."""
    if not wanted:
        yield StandardOutput()
        return
    with ResultOnly() as output:
        yield output
