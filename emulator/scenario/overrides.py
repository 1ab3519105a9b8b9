"""Changes of a scenario, `section.key=value`, as they are written on a command line."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any

from emulator.scenario.toml import DEEPEST, check_plain, parse_toml
from vnet.errors import OverrideError, ScenarioError, printable, shown


def apply_override(data: dict[str, Any], override: str) -> None:
    """Change plain data by `section.key=value`: TOML, or a bare word. Raises ScenarioError."""
    key, equals, text = override.partition("=")
    parts = key.strip().split(".")
    if not equals or not 2 <= len(parts) <= DEEPEST or not all(parts):
        raise ScenarioError(
            f"--set {printable(override)}: write it as section.key=value, for example radio.loss=0.3"
        )
    table = data
    for part in parts[:-1]:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise ScenarioError(f"--set {printable(override)}: {printable(part)} is not a section")
    table[parts[-1]] = _value(text)


def wrong_value(path: PurePath, problem: str, overrides: Sequence[str]) -> ScenarioError:
    """Return the error for a problem that begins with its key: of the override of that key, else of the file."""
    found = re.match(r"[^\s:=]+", problem)
    named = f"{found[0] if found else ''}."
    keys = [override.partition("=")[0].strip() for override in overrides]
    of_key = [key for key in keys if named.startswith(f"{key}.")]
    of_section = [key for key in keys if f"{key}.".startswith(named)]
    if of_key or len(of_section) == 1:  # of several in a section nobody knows which is to blame
        return OverrideError(problem, (of_key or of_section)[0])
    return ScenarioError(f"{path}: {problem}")


def as_overrides(changes: Mapping[str, Any]) -> list[str]:
    """Return changes, values by `section.key`, as overrides. Raises ScenarioError for what TOML cannot hold."""
    return [f"{key}={_toml(key, value)}" for key, value in changes.items()]


def _toml(key: str, value: Any) -> str:
    """A value in TOML's syntax, in one line; numpy's numbers and arrays become Python's."""
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, Mapping):
        pairs = (f"{json.dumps(str(name))} = {_toml(f'{key}.{name}', each)}" for name, each in value.items())
        return "{ " + ", ".join(pairs) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(key, each) for each in value) + "]"
    if not isinstance(value, (bool, int, float, str, PurePath)):
        raise ScenarioError(f"{key} = {shown(value)}: a number, a boolean, a text, a list or a table is needed")
    try:
        check_plain(str(value) if isinstance(value, PurePath) else value)
        return json.dumps(value if isinstance(value, (bool, int, float)) else str(value), ensure_ascii=False)
    except ValueError as error:
        raise ScenarioError(f"{key} = {shown(value)}: {str(error).rpartition(': ')[2]}") from None


def parse_values(key: str, text: str) -> list[Any]:
    """Return values that are separated by commas, each in TOML's syntax or a bare word. Raises ScenarioError."""
    try:
        values = parse_toml(f"values = [{text}]")["values"]
    except ValueError:
        values = [_value(part) for part in text.split(",")]
    if not values or "" in values:
        raise ScenarioError(f"{key}={printable(text)}: write its values with commas between, as radio.loss=0,0.1")
    return list(values)


def _value(text: str) -> Any:
    """A value in TOML's syntax, or a bare word."""
    try:
        return parse_toml(f"value = {text}")["value"]
    except ValueError:
        return text.strip()
