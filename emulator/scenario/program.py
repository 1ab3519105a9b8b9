"""`[program]`, `[[roadside]]` and `[backbone]`: programs, nodes beside the road, and the wire among them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, field_validator, model_validator

from emulator.scenario.sections import DAY_S, FAR_M, Section
from vnet.errors import ScenarioError, shown

_MODULE = re.compile(r"[A-Za-z_][\w. ]*:[A-Za-z_]\w*")
_FILE = re.compile(r"([^\0]*\.py)(?::([A-Za-z_]\w*))?")
Coordinate = Annotated[float, Field(ge=-FAR_M, le=FAR_M)]
NodeId = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]


def split_file(entry: str) -> tuple[str, str] | None:
    """Return file and function of an entry such as `hello.py:main`, "" for none; None if it is no file."""
    found = _FILE.fullmatch(entry)
    return None if found is None else (found[1], found[2] or "")


def from_here(entry: str) -> str:
    """Return an entry of a command line or a call; a file that is there is meant from the current folder."""
    name, function = split_file(entry) or ("", "")
    if not name or not Path(name).is_file():
        return entry
    return f"{Path(name).resolve()}:{function}" if function else str(Path(name).resolve())


def _is_entry(entry: str) -> str:
    if not _MODULE.fullmatch(entry) and split_file(entry) is None:
        raise ValueError("write it as package.module:function, or as file.py:function")
    return entry


Entry = Annotated[str, AfterValidator(_is_entry)]


class OneProgram(Section):
    """A program as `package.module:function`, and the options it is given."""

    entry: Entry = "agents.beacon:main"
    """An async function of one argument, the `Node`: `package.module:function` or `file.py:function`; a file's is
    `main` if left out."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Given to the program as `node.options`; what is allowed is its own business."""


class ProgramException(OneProgram):
    """`[[program.exceptions]]`: vehicles that run another program than all others, with options of its own."""

    nodes: tuple[str, ...] = Field(min_length=1)
    """Ids of the vehicles: a list, or a table as in faults, `{ ids = […] }`."""

    @field_validator("nodes", mode="before")
    @classmethod
    def _are_ids(cls, given: Any) -> Any:
        if isinstance(given, dict):
            if given.keys() != {"ids"}:
                raise ValueError('write the ids of the vehicles, as ["v01", "v02"] or { ids = ["v01", "v02"] }')
            return given["ids"]
        return given


class Program(OneProgram):
    """`[program]`: the program of every vehicle, except the `exceptions`."""

    checks: tuple[Entry, ...] = ()
    """Checks of your own: `package.module:function` or `file.py:function`; a file's is `check` if left out."""
    folders: tuple[Path, ...] = ()
    """Folders, relative to the scenario file, in which programs and checks are looked for first; then in the
    scenario file's own, then in the current one. A run records the folders in which it has found them."""
    exceptions: tuple[ProgramException, ...] = ()
    """Vehicles that run another program."""

    @model_validator(mode="after")
    def _one_program_a_node(self) -> Program:
        named = Counter(node for exception in self.exceptions for node in exception.nodes)
        if twice := sorted(node for node, count in named.items() if count > 1):
            raise ValueError(f"node {shown(twice[0])} is in two exceptions")
        return self

    def of(self, node: str) -> OneProgram:
        """Return the program of `node`."""
        return next((exception for exception in self.exceptions if node in exception.nodes), self)


class RoadsideUnit(Section):
    """`[[roadside]]`: a node that stands, at a position that its program knows."""

    position_m: tuple[Coordinate, Coordinate]
    """Its position, east and north, in the metres of the network."""
    id: NodeId | None = None
    """Its name; `rsu01`, `rsu02`, … by its place in the file if left out."""
    height_m: float = Field(6.0, ge=0, le=1000)
    """Height of its antenna above the ground. It counts in path losses; that of vehicles is 1.5 m, or what the
    two-ray model says."""
    tx_power_dbm: float | None = Field(None, ge=-100, le=100)
    """Its transmit power, antenna gain included; that of vehicles if left out."""
    entry: Entry | None = Field(None, exclude=True)
    """Its program, `package.module:function` or `file.py:function`; that of vehicles if left out."""
    options: dict[str, Any] | None = Field(None, exclude=True)
    """Options of a program of its own."""

    @property
    def name(self) -> str:
        """Its id."""
        assert self.id is not None  # a scenario has seen to it
        return self.id

    @model_validator(mode="after")
    def _options_are_of_its_own_program(self) -> RoadsideUnit:
        if self.options is not None and self.entry is None:
            raise ValueError("options go with an entry: without one the unit runs the program of the vehicles")
        return self


class Backbone(Section):
    """`[backbone]`: the wired network among roadside units. It keeps the order of messages between two units."""

    latency_ms: float = Field(5.0, ge=0.001, le=1000 * DAY_S)
    """Least time from sending to arrival."""
    jitter_ms: float = Field(0.0, ge=0, le=1000 * DAY_S)
    """Jitter of the latency: uniform from 0, drawn for each message and receiver."""
    loss: float = Field(0.0, ge=0, le=1)
    """Probability that a message is lost, independently at each receiver."""
    max_message_bytes: int = Field(65_000, ge=1, le=1_000_000)
    """A longer message is refused."""


def with_names(units: Sequence[RoadsideUnit]) -> tuple[RoadsideUnit, ...]:
    """Return units of which each has a name. Raise ValueError for a name that two have."""
    named = [unit.model_copy(update={"id": unit.id or f"rsu{n:02d}"}) for n, unit in enumerate(units, start=1)]
    for number, unit in enumerate(named):
        if unit.id in [other.id for other in named[:number]]:
            raise ValueError(f"another unit is named {unit.id}")
    return tuple(named)


def with_programs(program: Program, units: Sequence[RoadsideUnit]) -> Program:
    """Return `[program]` with the programs of units as exceptions. Raise ScenarioError for a unit with two."""
    excepted = {node for exception in program.exceptions for node in exception.nodes}
    own = [unit for unit in units if unit.entry is not None]
    for unit in own:
        if unit.name in excepted:
            raise ScenarioError(f"roadside: {unit.name} has an entry, and is in program.exceptions: leave one out")
    added = [
        ProgramException(nodes=(unit.name,), entry=unit.entry or "", options=unit.options or {}) for unit in own
    ]
    return program.model_copy(update={"exceptions": (*program.exceptions, *added)})
