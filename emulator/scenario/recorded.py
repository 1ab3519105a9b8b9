"""The scenario of a run's folder: what the run has read, whether or not its input files are still there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from emulator.scenario.renamed import with_new_names
from emulator.scenario.scenario import Scenario
from emulator.scenario.sections import first_problem
from emulator.scenario.shipped import find_scenario
from emulator.scenario.toml import parse_toml, read_toml
from vnet.errors import ScenarioError, printable


def parse_recorded_scenario(text: str, path: Path) -> Scenario:
    """Return the scenario of a run's folder from its text; the files that it names need not be there any more.

    `path` is what messages call it. Raises `ScenarioError`.
    """
    try:
        data = parse_toml(text)
        for digests in ("inputs", "code"):
            data.pop(digests, None)
        return Scenario.model_validate(with_new_names(data))
    except ValidationError as error:
        raise ScenarioError(f"{path}: {first_problem(error, Scenario)}") from None
    except ValueError as error:
        raise ScenarioError(f"{path}: not valid TOML: {printable(str(error), 300)}") from None


def recorded_code(path: Path) -> dict[str, Any]:
    """Return the section `[code]` of a file, in which a run has recorded its code; empty if there is none."""
    code = read_toml(find_scenario(path)).get("code")
    return code if isinstance(code, dict) else {}
