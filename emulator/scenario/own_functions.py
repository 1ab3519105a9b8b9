"""Functions of the user's own in the emulator's process (checks, rules): how to import them, and how they fail."""

from __future__ import annotations

import importlib
import inspect
import traceback
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from emulator.scenario.program import Program
from vnet.errors import ScenarioError, VnetError, printable

LONGEST_ERROR = 300


class NonsenseError(VnetError):
    """An answer of a function of the user's own that is none."""


def load_function(key: str, entry: str, program: Program, usage: str) -> Callable[..., Any]:
    """Import the function that a scenario's `key` names as `module:function`; `usage` is how one is written.

    Raises ScenarioError for one that cannot be imported, or is in a program's module.
    """
    name, _, function = entry.partition(":")
    problem = f"{key} = {entry!r}"
    if name in {each.entry.partition(":")[0] for each in (program, *program.exceptions)}:
        raise ScenarioError(f"{problem}: is in the program's module: put it into a module of its own")
    try:
        module = importlib.import_module(name)
    except (Exception, SystemExit) as error:
        raise ScenarioError(f"{problem}: cannot import: {in_words(error)}") from error
    found = getattr(module, function, None)
    if found is None:
        file = getattr(module, "__file__", None) or "built in"
        raise ScenarioError(f"{problem}: module {name} ({file}) has no {function!r}")
    if not callable(found) or inspect.iscoroutinefunction(found):
        raise ScenarioError(f"{problem}: is not a function {usage.format(function)}")
    return found  # type: ignore[no-any-return]


def in_words(error: BaseException) -> str:
    """Return an exception in one line."""
    return printable(" ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":"), LONGEST_ERROR)


def outside(error: BaseException, *files: str) -> TracebackType | None:
    """Return the traceback of an exception from the first line on that is not of these files of vnet, or None."""
    frames = error.__traceback__
    while frames is not None and frames.tb_frame.f_code.co_filename in files:
        frames = frames.tb_next
    return frames


def line_of(frames: TracebackType | None) -> str:
    """Return the last line `FILE:NUMBER` of a traceback in the file in which it begins; "" for None."""
    extracted = traceback.extract_tb(frames)
    if not extracted:
        return ""
    last = [frame for frame in extracted if frame.filename == extracted[0].filename][-1]
    return f"{Path(last.filename).name}:{last.lineno}"
