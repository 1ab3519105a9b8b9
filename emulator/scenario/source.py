"""The scenario of a call from Python: a path, the name of a shipped one, plain data or a Scenario, with changes."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from emulator.scenario.overrides import as_overrides
from emulator.scenario.program import from_here
from emulator.scenario.scenario import Scenario, load_scenario, scenario_from
from vnet.errors import ScenarioError, did_you_mean, shown

P = ParamSpec("P")
T = TypeVar("T")
Source = str | Path | Mapping[str, Any] | Scenario
DATA = Path("scenario")
"""The name of plain data in messages. Relative paths in it are taken from the current folder."""


def scenario_of(source: Source, changes: Mapping[str, Any], checks: Sequence[str] = ()) -> Scenario:
    """Return the scenario of a source with `changes`, values by `section.key`, and with `checks` after its own.

    None changes nothing. Raises ScenarioError that names the key, the value and what is allowed.
    """
    checks = [from_here(check) for check in checks]
    overrides = as_overrides({key: value for key, value in changes.items() if value is not None})
    if isinstance(source, (str, Path)):
        return load_scenario(Path(source), overrides, checks)
    if isinstance(source, Scenario):
        source = source.model_dump(mode="json", exclude_none=True)
    if not isinstance(source, Mapping):
        raise ScenarioError(f"scenario = {shown(source)}: a path, a shipped scenario's name, or a dict is needed")
    return scenario_from(deepcopy(dict(source)), DATA, overrides, checks=checks)


def hinting(function: Callable[P, T]) -> Callable[P, T]:
    """Have a function say which argument may have been meant by one that it does not have."""
    known = inspect.signature(function).parameters

    @wraps(function)
    def call(*arguments: P.args, **options: P.kwargs) -> T:
        for name in options:
            if name not in known:
                raise TypeError(f"{function.__name__}(): no argument {name!r}{did_you_mean(name, known)}")
        return function(*arguments, **options)

    return call
