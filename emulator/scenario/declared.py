"""Modules that programs declare: checks and a reference, which run in the emulator's process.

A program's module names one in a constant, `DECLARES = "package.module"`. The constant is read from the source, so
that no program is imported here. docs/how-to/results.md describes such a module.
"""

from __future__ import annotations

import ast
import importlib
import sys
from importlib.machinery import PathFinder
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from emulator.scenario.own_functions import in_words
from emulator.scenario.program import Program
from vnet.errors import ScenarioError

CONSTANT = "DECLARES"


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
