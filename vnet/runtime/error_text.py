"""Exceptions of programs in words: type and message, and the line of the program.

Without imports of vnet's: commands in Python of a run in real time load it, too (`vnet/gateway/startup`).
"""

from __future__ import annotations

import builtins
import json
import sys
import sysconfig
import traceback
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

NOT_THE_PROGRAM = (
    f"{Path(__file__).parents[1]}/",
    *(f"{sysconfig.get_path(name)}/" for name in ("stdlib", "purelib", "platlib")),
)
"""Folders of code that is no program: vnet, the standard library, installed packages."""
LONGEST, MOST_FRAMES = 8000, 30
"""Characters that are kept of a message, its first ones, and frames of a traceback, its last ones."""
_GROUP: Any = getattr(builtins, "BaseExceptionGroup", ())
"""None before Python 3.11."""


def error_line(error: BaseException) -> str:
    """Return the type and the message of an exception in one line; of a group those of its first leaf."""
    if isinstance(error, _GROUP):
        first, *others = leaves(error)
        return f"{error_line(first)} (and {len(others)} more in its group)" if others else error_line(first)
    try:
        text = " ".join(str(error)[:LONGEST].encode(errors="backslashreplace").decode().split())
    except Exception as another:  # of the exception's own __str__
        text = f"(its text cannot be made: {type(another).__name__})"
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def traceback_text(error: BaseException, trace: TracebackType | None) -> str:
    """Return a traceback as Python prints it, without its first frames and the ends of long messages."""
    lines = traceback.format_exception(type(error), error, trace)
    return "".join(line if len(line) <= LONGEST else f"{line[:LONGEST]} …\n" for line in lines[-MOST_FRAMES:])


def leaves(error: Any) -> list[BaseException]:
    """Return the exceptions of a group that are no groups, in order; an exception alone is its only leaf."""
    if not isinstance(error, _GROUP):
        return [error]
    return [leaf for each in error.exceptions for leaf in leaves(each)]


def own_line(error: BaseException) -> str:
    """Return file and line of the innermost frame that is the program's own, or of the innermost of all."""
    leaf = leaves(error)[0]
    traces = [each.__traceback__ for each in ([error, leaf] if leaf is not error else [leaf])]
    return line_of(frame for trace in traces for frame in traceback.walk_tb(trace))


def of_program(trace: TracebackType | None) -> TracebackType | None:
    """Return a traceback without the frames of vnet that lead to the program; all of it if it has no others."""
    inner = trace
    while inner is not None and inner.tb_frame.f_code.co_filename.startswith(NOT_THE_PROGRAM[0]):
        inner = inner.tb_next
    return inner or trace


def line_of_caller() -> str:
    """Return file and line of the innermost frame of the present stack that is the program's own."""
    return line_of(list(traceback.walk_stack(sys._getframe(1)))[::-1])


def line_of(frames: Iterable[tuple[FrameType, int]]) -> str:
    """Return file and line of the innermost of these frames, the outermost first, that is the program's own."""
    lines = [(frame.f_code.co_filename, line) for frame, line in frames]
    own = [line for line in lines if not line[0].startswith(NOT_THE_PROGRAM)] or lines
    return f"{Path(own[-1][0]).name}:{own[-1][1]}" if own else ""


def write_report(path: str, error: BaseException, status: object, place: str) -> None:
    """Write a failure of a program to a file, and the status by which it has ended; `place` if none is told."""
    report = {
        "error": error_line(error),
        "status": "" if status is None else repr(status),
        "place": own_line(error) or place,
        "details": traceback_text(error, error.__traceback__),
    }
    content = {name: text.encode(errors="backslashreplace").decode() for name, text in report.items()}
    with suppress(OSError):
        Path(path).write_text(json.dumps(content))
