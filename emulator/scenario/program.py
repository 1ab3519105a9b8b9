"""`[program]`, `[[roadside]]` and `[backbone]`: programs, nodes beside the road, and the wire among them."""

from __future__ import annotations

import re
import shlex
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, field_validator, model_validator

from emulator.scenario.sections import DAY_S, FAR_M, Section
from vnet.errors import ScenarioError, shown
from vnet.gateway import FILLED_IN

_MODULE = re.compile(r"[A-Za-z_][\w. ]*:[A-Za-z_]\w*")
_FILE = re.compile(r"([^\0]*\.py)(?::([A-Za-z_]\w*))?")
_TOPIC = re.compile(r"(/([A-Za-z_]\w*|\*\*?))+", re.ASCII)
MANY_SESSIONS = 10_000
Coordinate = Annotated[float, Field(ge=-FAR_M, le=FAR_M)]
NodeId = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]


def split_file(entry: str) -> tuple[str, str] | None:
    """Return file and function of an entry such as `hello.py:main`, "" for none; None if it is no file."""
    found = _FILE.fullmatch(entry)
    return None if found is None else (found[1], found[2] or "")


def is_script(path: Path) -> bool:
    """Return whether a path is of a file, or of a folder that Python runs."""
    return path.is_file() or (path / "__main__.py").is_file()


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


def _is_topic(name: str) -> str:
    if not _TOPIC.fullmatch(name):
        raise ValueError('write it as "/tf", with * for one part of a name and ** for any number')
    return name


Topic = Annotated[str, AfterValidator(_is_topic)]


ZENOH_ENTRY = "vnet.gateway.emulated:main"
"""Entry of vehicles of kind "zenoh" in lockstep, which runs their commands on virtual time."""
PYTHON = ("python", "python3")
"""First words of a command that stand for the interpreter of vnet."""
PYTHON_NAME = re.compile(r"python(3(\.\d+)?)?")
"""Names of interpreters, all of which stand for that of vnet on virtual time: a folder may come from elsewhere."""
PLACEHOLDER = re.compile(r"\{[a-z_]+\}", re.IGNORECASE)
"""A word that is meant to be filled in. Within a word braces may be a program's own."""


def _check_words(words: Iterable[str]) -> None:
    """Raise ValueError for what no command can be given, or is meant to be filled in and is not."""
    words = list(words)
    if broken := [word for word in words if "\0" in word]:
        raise ValueError(f"{shown(broken[0])}: a NUL ends a word")
    if unknown := [word for word in words if PLACEHOLDER.fullmatch(word) and word not in FILLED_IN]:
        raise ValueError(f"{unknown[0]} is none of {', '.join(FILLED_IN)}, which are filled in")


class OneProgram(Section):
    """A program as `package.module:function`, and the options it is given."""

    command: tuple[tuple[str, ...], ...] | None = None
    """`kind = "zenoh"`: the words of the command that starts a program that speaks Zenoh, or a list of such lists.
    `{id}`, `{endpoint}` and `{port}` are filled in; `python` is vnet's own. If left out, others start them."""
    environment: dict[str, str] = Field(default_factory=dict)
    """`kind = "zenoh"`: variables that the commands have besides vnet's own, filled in as their words. Exceptions
    have their own. The run's folder has them: no place for passwords."""
    entry: Entry = "agents.beacon:main"
    """An async function of one argument, the `Node`: `package.module:function` or `file.py:function`; a file's is
    `main` if left out."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Given to the program as `node.options`; what is allowed is its own business."""

    @field_validator("command", mode="before")
    @classmethod
    def _is_one_or_several(cls, given: Any) -> Any:
        several = isinstance(given, list | tuple) and all(isinstance(words, list | tuple) for words in given)
        commands = given if given is None or several else [given]
        for words in commands or ():
            if not isinstance(words, list | tuple) or not words or not all(isinstance(word, str) for word in words):
                raise ValueError('write its words, as ["python", "talker.py", "{id}"], or a list of such lists')
            _check_words(words)
        return commands

    @field_validator("environment")
    @classmethod
    def _are_variables(cls, given: dict[str, str]) -> dict[str, str]:
        if wrong := [name for name in given if not (name.isascii() and name.isidentifier())]:
            raise ValueError(f"{shown(wrong[0])} is no variable: letters, digits and _ are allowed, no digit first")
        if told := [name for name in given if name.startswith(("VNET_", "ZENOH_CONFIG"))]:
            raise ValueError(f"{told[0]} is vnet's to set")
        _check_words(given.values())
        return given

    @model_validator(mode="after")
    def _variables_are_of_commands(self) -> Self:
        if self.environment and self.command is None:
            raise ValueError("environment goes with a command")
        return self

    @property
    def commands(self) -> tuple[tuple[str, ...], ...]:
        """The commands that vnet starts in each of the vehicles."""
        return self.command or ()


class ZenohSessions(Section):
    """`[program.zenoh]`: the endpoints to which programs of `kind = "zenoh"` connect, one for each vehicle."""

    listen: str = Field("tcp/127.0.0.1:0", pattern=r"^(tcp|tls|quic)/\S+:\d{1,5}$")
    """Real time: the endpoint of the first vehicle; with a port, the next vehicles have the next ports. Port 0
    stands for any: the run's `endpoints.json` has them."""
    query_s: float = Field(1.0, gt=0, le=3600)
    """Time for which replies to a query are awaited: over the radio nobody can say who will answer."""
    liveliness_s: float = Field(1.0, gt=0, le=3600)
    """Time between two frames that tell of a vehicle's liveliness tokens, if it has any. Who has not heard them for
    three such times takes them for gone."""
    sessions: int | None = Field(None, ge=1, le=MANY_SESSIONS)
    """Real time: most sessions that a vehicle's programs have at a time; more are a way around the radio. As many
    as commands if left out; no limit where others start the programs."""
    users: Path | None = None
    """Real time: a file of lines `user:password`, one of which programs then need. Commands have the first."""
    certificate: Path | None = None
    """Real time: the certificate of endpoints at `tls/…`, as a PEM file."""
    private_key: Path | None = None
    """Its key."""
    authority: Path | None = None
    """The certificate of the authority that has issued it, for the commands."""

    @model_validator(mode="after")
    def _tls_has_a_certificate(self) -> ZenohSessions:
        secure = not self.listen.startswith("tcp/")
        for name in ("certificate", "private_key", "authority"):
            if secure != (getattr(self, name) is not None):
                what = f"{name} is missing: a PEM file" if secure else f"{name} goes with tls/ or quic/"
                raise ValueError(f"listen = {shown(self.listen)}: {what}")
        return self


class Ros2Topics(Section):
    """`[radio.ros2]`: topics, services and graph of programs of ROS 2, with `radio.profile = "ros2"`."""

    inside: tuple[Topic, ...] = ("/parameter_events", "/rosout", "/tf", "/tf_static")
    """Topics and services that stay in their vehicle, with their tokens, as do `/clock` and `/vnet/**`: names as in
    `/tf`, with `*` for one part of a name and `**` for any number."""
    graph: Literal["range", "always"] = "range"
    """Nodes and topics that a vehicle sees: of vehicles whose tokens its radio hears (`range`), or of all, past the
    radio (`always`, in real time)."""
    domain: int = Field(0, ge=0, le=232)
    """`ROS_DOMAIN_ID` of commands, and of `/clock` and `/vnet/fix`. All domains cross the radio."""
    clock_hz: float = Field(10.0, gt=0, le=1000)
    """Rate at which a vehicle's own programs are told emulated time on `/clock`."""


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

    kind: Literal["vnet", "zenoh"] = "vnet"
    """`vnet`: an async function of a `Node`. `zenoh`: unmodified programs that speak Zenoh
    (docs/how-to/zenoh.md)."""
    zenoh: ZenohSessions | None = None
    """Endpoints of programs of `kind = "zenoh"`."""
    checks: tuple[Entry, ...] = ()
    """Checks of your own: `package.module:function` or `file.py:function`; a file's is `check` if left out."""
    folders: tuple[Path, ...] = ()
    """Folders, relative to the scenario file, in which programs and checks are looked for first; then in the
    scenario file's own, then in the current one. A run records the folders in which it has found them."""
    exceptions: tuple[ProgramException, ...] = ()
    """Vehicles that run another program."""

    @model_validator(mode="before")
    @classmethod
    def _entry_is_of_its_kind(cls, data: Any) -> Any:
        """Give programs of kind "zenoh" the entry that runs their commands."""
        if not isinstance(data, dict):
            return data
        exceptions = data.get("exceptions")
        exceptions = exceptions if isinstance(exceptions, list | tuple) else ()
        given = [each for each in (data, *exceptions) if isinstance(each, dict)]
        if data.get("kind", "vnet") not in ("vnet", "zenoh"):
            return data  # told of by its own field
        if data.get("kind", "vnet") == "vnet":
            if data.get("zenoh") is not None or any(each.get("command") is not None for each in given):
                raise ValueError('command and zenoh go with kind = "zenoh"')
            return data
        for each in given:
            if each.get("entry", ZENOH_ENTRY) != ZENOH_ENTRY or each.get("options"):
                raise ValueError('kind = "zenoh" has a command, and neither entry nor options')
        own = {**data, "entry": ZENOH_ENTRY}
        if exceptions:
            own["exceptions"] = [{**each, "entry": ZENOH_ENTRY} for each in given[1:]]
        return own

    @model_validator(mode="after")
    def _one_program_a_node(self) -> Program:
        named = Counter(node for exception in self.exceptions for node in exception.nodes)
        if twice := sorted(node for node, count in named.items() if count > 1):
            raise ValueError(f"node {shown(twice[0])} is in two exceptions")
        return self

    @property
    def title(self) -> str:
        """The programs of the vehicles, for people: the entry, or the commands."""
        return self.entry if self.kind == "vnet" else "; ".join(map(shlex.join, self.commands)) or "Zenoh programs"

    @property
    def sessions(self) -> ZenohSessions:
        """Endpoints of programs of `kind = "zenoh"`."""
        return self.zenoh or ZenohSessions()

    @property
    def all_commands(self) -> list[tuple[str, ...]]:
        """The commands of all vehicles."""
        return [words for each in (self, *self.exceptions) for words in each.commands]

    def commands_of(self, node: str) -> list[list[str]]:
        """Return the commands of a node, with the paths of files that are in `folders`."""
        return [self._located(words) for words in self.of(node).commands]

    def _located(self, words: Sequence[str]) -> list[str]:
        files = [next((str(f / word) for f in self.folders if is_script(f / word)), word) for word in words[:2]]
        return [*files, *words[2:]]

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
