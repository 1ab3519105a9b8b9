"""Standard output and error that never fail those who print.

A reader that goes away, as `head` does, is no reason to end a run, nor is a full disk: what cannot be written is
dropped, and the command goes on to its end.
"""

from __future__ import annotations

import errno
import io
import sys
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
