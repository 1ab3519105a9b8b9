"""The scenario of a test: a file, plain data or a Scenario, and what the test changes about it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from emulator.cells.worker import with_folder_of
from emulator.scenario.loading import (
    Source,
    checked_scenario,
    find_scenario,
    load_scenario,
    with_absolute_paths,
    with_own_modules,
)
from emulator.scenario.scenario import Scenario
from vnet.errors import ScenarioError, did_you_mean

NAMES = {
    "vehicles": "network.vehicles",
    "program": "program.entry",
    "options": "program.options",
    "checks": "program.checks",
    "seed": "run.seed",
    "duration": "run.duration_s",
    "settle": "run.settle_s",
    "faults": "fault",
}
"""Short names of what tests change most."""


def make_scenario(source: Source, changes: Mapping[str, Any], folders: Iterable[Path] = ()) -> Scenario:
    """A scenario with `changes`, by short name or as "section.key". None changes nothing.

    A file is looked for here, and then in `folders`; programs and checks beside it, and then here. Raises
    ScenarioError.
    """
    scenario, base = _loaded(source, folders)
    given = {name: value for name, value in changes.items() if value is not None}
    if "vehicles" in given and scenario.network.kind == "file":
        raise ScenarioError(f"vehicles = {given['vehicles']}: the network's file says how many there are")
    data = scenario.model_dump(mode="json", exclude_none=True)
    for name, value in given.items():
        *sections, key = NAMES.get(name, name).split(".")
        if not sections and name != "faults":
            meant = did_you_mean(name, NAMES)
            raise ScenarioError(f"{name}: unknown{meant}; write section.key, or one of {', '.join(NAMES)}")
        table = data
        for section in sections:
            table = table.setdefault(section, {})
        table[key] = _plain(value)
    changed = checked_scenario(data)
    if given or not isinstance(source, Scenario):  # as it is, whose files are known
        changed = with_absolute_paths(changed, Path("scenario"))
    return with_folder_of(None, with_own_modules(changed, base))


def _loaded(source: Source, folders: Iterable[Path]) -> tuple[Scenario, Path | None]:
    """The scenario, and the folder of its file."""
    if isinstance(source, Scenario):
        return source, None
    if isinstance(source, Mapping):
        return checked_scenario(source), None
    found = [path for path in (Path(source), *(folder / source for folder in folders)) if path.is_file()]
    path = found[0] if found else find_scenario(source)
    return load_scenario(path), path.parent


def _plain(value: Any) -> Any:
    """Faults and other sections as the data that a file would hold."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", exclude_none=True)
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value
