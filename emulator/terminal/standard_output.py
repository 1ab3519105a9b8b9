"""Standard output for the result of a command alone, whatever the programs of a run print.

Descriptor 1 is turned away, so that what C code prints, or a process that a program starts, is kept from the result
as well. It is kept in a file instead, in memory until there is a folder for it.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryFile

from emulator.records.atomic import disk_errors
from emulator.records.run_folder import PROGRAMS_LOG

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
