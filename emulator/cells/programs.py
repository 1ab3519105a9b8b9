"""Programs and rules that are given as functions: their entries, and which of them other processes can import."""

from __future__ import annotations

import importlib.util
import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from emulator.scenario.program import from_here
from emulator.scenario.scenario import Scenario
from vnet.errors import ProgramError, ScenarioError, shown
from vnet.runtime.programs import Program


def entry_of(program: str | Program | None) -> str | None:
    """Return the entry by which a scenario names a program."""
    if program is None or isinstance(program, str):
        return program and from_here(program)
    module, name = str(program.__module__), str(getattr(program, "__name__", ""))
    return f"{module}:{name if name.isidentifier() else 'program'}"


def require_importable(program: str | Program | None, what: str) -> None:
    """Raise ProgramError for a function that other processes cannot import; `what` is what needs them."""
    function = checked_function(program)
    if function is not None and not is_importable(function):
        raise ProgramError(
            f"program = {name_of(function)}: {what} needs processes that import it; "
            "put it into a module, and give that as module:function"
        )


def checked_function(program: str | Program | None) -> Program | None:
    """Return a function that is given as the program; None for an entry. Raises ProgramError."""
    if program is None or isinstance(program, str):
        return None
    if not inspect.iscoroutinefunction(program):
        raise ProgramError(f"program = {shown(program)}: is not an async function: async def main(node)")
    return program


def rule_entry(rule: str | Callable[..., Any]) -> tuple[str, Path | None]:
    """Return the entry of a rule of the user's own, and the folder of its module, None if it needs none.

    Raises ScenarioError for a function that no other process can import.
    """
    if isinstance(rule, str):
        return from_here(rule), None
    if not callable(rule) or not is_importable(rule):
        raise ScenarioError(
            f"rule = {shown(rule)}: must be a function of a module, so that the run can be reproduced: put it there"
        )
    return f"{rule.__module__}:{rule.__name__}", _folder_of(rule)


def is_importable(function: Callable[..., Any]) -> bool:
    """Return whether another process finds this very function by its module and name."""
    module, name = function.__module__, getattr(function, "__name__", "")
    if module == "__main__" or getattr(sys.modules.get(module), name, None) is not function:
        return False
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        return False


def with_folder_of(function: Program | None, scenario: Scenario) -> Scenario:
    """Return the scenario with the folder in which the function's module is found, if nothing else finds it."""
    folder = _folder_of(function) if function is not None and is_importable(function) else None
    program = scenario.program
    if folder is None or folder in program.folders:
        return scenario
    program = program.model_copy(update={"folders": (*program.folders, folder)})
    return scenario.model_copy(update={"program": program})


def _folder_of(function: Callable[..., Any]) -> Path | None:
    """Return the folder in which a function's module is found; None if it is installed."""
    top = sys.modules.get(function.__module__.partition(".")[0])
    file = getattr(top, "__file__", None)
    if file is None:
        return None
    folder = Path(file).parents[1 if hasattr(top, "__path__") else 0]
    return None if folder.name == "site-packages" else folder


def name_of(function: Program) -> str:
    """Return the name of a function and its module, for messages."""
    return f"{getattr(function, '__qualname__', shown(function))} of {function.__module__}"
