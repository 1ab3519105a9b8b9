"""The section `[program]`: the programs of the vehicles, their options, and the checks of the user's own."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, field_validator, model_validator

from emulator.scenario.sections import Section
from vnet.errors import shown

_MODULE = re.compile(r"[A-Za-z_][\w. ]*:[A-Za-z_]\w*")
_FILE = re.compile(r"([^\0]*\.py)(?::([A-Za-z_]\w*))?")


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
