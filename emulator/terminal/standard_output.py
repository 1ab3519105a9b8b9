"""Standard output and error that never fail those who print, and that may be for the result of a command alone.

A reader that goes away, as `head` does, is no reason to end a run, nor is a full disk: what cannot be written is
dropped, and the command goes on to its end.

Where standard output is for the result, whatever the programs of a run print, descriptor 1 is turned away, so that
what C code prints, or a process that a program starts, is kept from the result as well. It is kept in a file
instead, in memory until there is a folder for it.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import io
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

NOBODY_READS = (errno.EPIPE, errno.EIO, errno.ENXIO)
"""Errors of a pipe without a reader, and of a terminal that is gone: nothing is wrong with the command."""


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
        from emulator.records.atomic import disk_errors  # slow to import, and `--help` does without
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
    with contextlib.suppress(OSError, ValueError, AttributeError):
        sys.stdout.flush()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).fflush(None)


@contextlib.contextmanager
def result_only(wanted: bool) -> Iterator[StandardOutput]:
    """Standard output that only a result reaches, if `wanted`; else as it is."""
    if not wanted:
        yield StandardOutput()
        return
    with ResultOnly() as output:
        yield output
