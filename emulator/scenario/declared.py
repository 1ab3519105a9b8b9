"""Modules that programs declare: a reference for their figures, which runs in the emulator's process.

A program's module names one in a constant, `DECLARES = "package.module"`. The constant is read from the source, so
that no program is imported here. docs/how-to/own-figures.md describes such a module.
"""

from __future__ import annotations

import ast
import importlib
import sys
from importlib.machinery import PathFinder
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

from emulator.scenario.own_functions import in_words
from emulator.scenario.program import Program
from vnet.errors import ScenarioError

CONSTANT = "DECLARES"


def declared_modules(program: Program) -> list[ModuleType]:
    """Import the modules that a scenario's programs declare, each once. Raises ScenarioError."""
    entries = [each.entry.partition(":")[0] for each in (program, *program.exceptions)]
    names = dict.fromkeys(filter(None, map(_declared_by, entries)))
    return [_imported(name) for name in names]


def _imported(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except (Exception, SystemExit) as error:
        raise ScenarioError(f"{CONSTANT} = {name!r}: cannot import: {in_words(error)}") from error


def _declared_by(module: str) -> str | None:
    """Return the name that a module declares; None for one that declares nothing, or is not found."""
    if module in sys.modules:
        name = getattr(sys.modules[module], CONSTANT, None)
        return name if isinstance(name, str) else None
    try:
        tree = ast.parse(_source(module))
    except (OSError, SyntaxError, ValueError, ImportError):
        return None
    for statement in tree.body:
        match statement:
            case ast.Assign(targets=[ast.Name(id="DECLARES")], value=ast.Constant(value=str(name))):
                return name
    return None


def _source(module: str) -> str:
    """Return the source of a module without importing it, or a package that it is in; "" where there is none."""
    first, *others = module.split(".")
    spec, name = find_spec(first), first
    for part in others:
        name = f"{name}.{part}"
        spec = None if spec is None else PathFinder.find_spec(name, spec.submodule_search_locations)
    return Path(spec.origin).read_text() if spec is not None and spec.origin and spec.has_location else ""
