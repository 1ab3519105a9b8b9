"""The input files and the start time of a SUMO configuration (`.sumocfg`)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

from vnet.bounded import read_bounded
from vnet.errors import ScenarioError, shown

LARGEST_BYTES = 1 << 20
LATEST_S = 1e9
_UNITS_S = (1.0, 60.0, 3600.0, 86400.0)


def input_files(path: Path) -> list[Path]:
    """The files that SUMO reads with a configuration, so far as it names them and they are there.

    Raises ScenarioError if it is no configuration.
    """
    values = _values(path)
    named = [
        name for key, value in values.items() if key.endswith(("-file", "-files")) for name in value.split(",")
    ]
    files = [path.parent / name.strip() for name in named if name.strip()]
    return sorted({file.resolve() for file in files if file.is_file()})


def read_begin_s(path: Path) -> float:
    """The time in seconds at which a configuration begins. Raises ScenarioError."""
    text = _values(path).get("begin", "0")
    try:  # seconds, or days:hours:minutes:seconds
        begin_s = sum(float(part) * unit for part, unit in zip(reversed(text.split(":")), _UNITS_S, strict=False))
    except ValueError:
        begin_s = math.nan
    if not 0 <= begin_s <= LATEST_S:
        raise ScenarioError(f"{path}: begin = {shown(text)}: seconds, or hours:minutes:seconds, from 0 on")
    return begin_s


def _values(path: Path) -> dict[str, str]:
    """Return each option's value in a configuration, without output files."""
    values: dict[str, str] = {}
    sections: list[str] = []
    parser = expat.ParserCreate()

    def start(name: str, attributes: dict[str, str]) -> None:
        if not sections and name not in ("configuration", "sumoConfiguration"):
            raise ScenarioError(
                f"{path}: line {parser.CurrentLineNumber}: element {name!r} is no configuration of SUMO"
            )
        if "output" not in sections:
            values[name] = attributes.get("value", attributes.get("v", ""))
        sections.append(name)

    def doctype(*_: object) -> NoReturn:
        raise ScenarioError(f"{path}: line {parser.CurrentLineNumber}: a document type; SUMO writes none")

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda name: sections.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(read_bounded(path, LARGEST_BYTES), True)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, LookupError, expat.ExpatError) as error:  # an unknown encoding is a LookupError
        raise ScenarioError(f"{path}: not a SUMO configuration: {error}") from None
    return values
