"""Code of the user's own in the emulator's process: importing checks and rules, and what programs declare.

A program's module names one in a constant, `DECLARES = "package.module"`. The constant is read from the source, so
that no program is imported here. docs/how-to/results.md describes such a module.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import sys
import traceback
from collections.abc import Callable
from importlib.machinery import PathFinder
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any

from emulator.scenario.program import Program
from vnet.errors import ScenarioError, VnetError, printable
from vnet.extras import missed_by

LONGEST_ERROR = 300
CONSTANT = "DECLARES"


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
    said = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
    return missed_by(error) or printable(said, LONGEST_ERROR)


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


def declared(program: Program, name: str) -> list[Any]:
    """Return what the modules that a scenario's programs declare hold by this name. Raises ScenarioError."""
    modules = map(_imported, _declared(program))
    return [getattr(module, name) for module in modules if hasattr(module, name)]


def declared_checks(program: Program) -> list[str]:
    """Return the checks that a scenario's programs declare, `CHECKS`, as entries; so is a module that fails."""
    entries: list[str] = []
    for module in _declared(program):
        try:
            entries += getattr(_imported(module), "CHECKS", ())
        except ScenarioError:
            entries.append(f"{module}:CHECKS")  # its check says why
    return entries


def are_here(program: Program) -> bool:
    """Return whether all programs of a scenario are found, so that what they declare is known."""
    return all(module in sys.modules or _text(module) for module in _modules(program))


def load_entry(entry: str) -> Any:
    """Import what a declared `module:name` names. Raises ScenarioError."""
    module, _, name = entry.partition(":")
    found = getattr(_imported(module), name, None)
    if found is None:
        raise ScenarioError(f"{entry!r}: module {module} has no {name!r}")
    return found


def _declared(program: Program) -> list[str]:
    """Return the names of the declared modules, each once."""
    return list(dict.fromkeys(filter(None, map(_declared_by, _modules(program)))))


def _modules(program: Program) -> list[str]:
    return [each.entry.partition(":")[0] for each in (program, *program.exceptions)]


def _imported(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except (Exception, SystemExit) as error:
        raise ScenarioError(f"{CONSTANT}: cannot import {name!r}: {in_words(error)}") from error


def _declared_by(module: str) -> str | None:
    """Return the name that a module declares; None for one that declares nothing, or is not found."""
    if module in sys.modules:
        name = getattr(sys.modules[module], CONSTANT, None)
        return name if isinstance(name, str) else None
    try:
        tree = ast.parse(_text(module))
    except (SyntaxError, ValueError):
        return None
    for statement in tree.body:
        match statement:
            case ast.Assign(targets=[ast.Name(id="DECLARES")], value=ast.Constant(value=str(name))):
                return name
    return None


def _text(module: str) -> str:
    """Return the source of a module without importing it, or a package that it is in; "" where there is none."""
    first, *others = module.split(".")
    try:
        spec, name = find_spec(first), first
        for part in others:
            name = f"{name}.{part}"
            spec = None if spec is None else PathFinder.find_spec(name, spec.submodule_search_locations)
        return Path(spec.origin).read_text() if spec is not None and spec.origin and spec.has_location else ""
    except (OSError, ValueError, ImportError):
        return ""
