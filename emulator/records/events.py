"""The events of a run: a closed set of kinds, each declared once, and one line of `events.jsonl` for each event.

`EventKind` is the only place that states a kind: its name, whom it concerns, its details, what has happened, its
level and its part in what readers conclude. Writers name its members; terminal, report, timeline, Rerun, checks,
cells and the reference page draw from it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Flag, IntEnum, StrEnum, auto
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vnet.errors import VnetError, first_names, printable

if TYPE_CHECKING:
    from typing import Self

Details = Mapping[str, Any]


class Level(IntEnum):
    """Weight of an event, in ascending order."""

    NOTE = 0
    TOLD = 1
    """A program tells it."""
    CHANGE = 2
    """A program or the run starts or ends, as it should."""
    WARNING = 3
    FAILURE = 4
    """A program, a process or a rule failed."""


class Part(Flag):
    """Parts that a kind of event has in what readers conclude from it."""

    NONE = 0
    SAMPLES = auto()
    """A series of measurements, too long for tables of events."""
    MEASURED = auto()
    """A measurement for the checks, and no news while the run is on."""
    SAID = auto()
    """A program's own words, and no news of vnet's."""
    GROUPED = auto()
    """Told once for all vehicles that fail in the same line."""
    ENDS_PROGRAM = auto()
    """The node stays down from then on."""
    CUTS_RUN = auto()
    """Emulated time ends before its due end."""


NOTE, TOLD, CHANGE, WARNING, FAILURE = Level
SAMPLES, MEASURED, SAID, GROUPED, ENDS_PROGRAM, CUTS_RUN = Part
REASONS, PAGES = ("how", "error", "reason"), ("where", "log_tail", "key")
"""Details that are told without their names, and those that are not told in a line."""
QUIET_LEVELS = ("debug", "info")
"""Levels of log lines that are no warnings."""


def _of_line(details: Details) -> Level:
    return TOLD if str(details.get("level", "")).lower() in QUIET_LEVELS else WARNING


def _if_any(details: Details) -> Level:
    return WARNING if details.get("count") else NOTE


class EventKind(StrEnum):
    """A kind of event. Its value is the `kind` of a line of `events.jsonl`.

    `node` says what the line's `node` is ("" for none), `details` names what else the line has, `meaning` says what
    has happened, for the reference page; `level` is a level, or a function of the details; `part` is its `Part`s.
    """

    node_is: str
    details: tuple[str, ...]
    meaning: str
    level: Level | Callable[[Details], Level]
    part: Part

    def __new__(
        cls,
        value: str,
        node_is: str,
        details: str,
        meaning: str,
        level: Level | Callable[[Details], Level] = NOTE,
        part: Part = Part.NONE,
    ) -> Self:
        """Make a member that is its name, and carries its facts."""
        kind = str.__new__(cls, value)
        kind._value_ = value
        kind.node_is, kind.details, kind.meaning = node_is, tuple(details.split()), meaning
        kind.level, kind.part = level, part
        return kind

    # fmt: off
    note = "note", "", "what", "oddities of the input: vehicles left out, ids escaped, ways clipped"
    code_changed = (
        "code_changed", "", "what", "program or vnet have changed since the run whose scenario this one repeats")
    started = "started", "", "start_up_s", "all have joined; time 0"
    ended = "ended", "", "wall_s", "the run is over"
    interrupted = "interrupted", "", "", "Ctrl-C or SIGTERM", WARNING, CUTS_RUN
    finished = "finished", "vehicle", "", "its program returned", CHANGE, ENDS_PROGRAM
    crashed = (
        "crashed", "vehicle", "error place where", "its program raised; where, and the traceback",
        FAILURE, GROUPED | ENDS_PROGRAM)
    exception = (
        "exception", "vehicle", "error place where", "its program raised and nobody handled it: at that instant, "
        "so that the line may come after later ones; where, and the traceback", FAILURE, GROUPED)
    log = (
        "log", "vehicle", "level text", "a line of `node.log`, or of the standard `logging` of its program",
        _of_line, SAID)
    event = "event", "vehicle", "name details", "an event of its program: `node.event`", TOLD, SAID
    left_out = (
        "left_out", "vehicle", "what count", "how many events of this kind are not here: there were too many",
        WARNING)
    files_left_out = (
        "files_left_out", "vehicle", "count which",
        "how many files of its disk are not in `files/`, and of the first three the name and the reason")
    spun = (
        "spun", "vehicle", "error place where",
        "its program did not let time advance (busy loop); where its tasks stood", FAILURE, ENDS_PROGRAM)
    died = (
        "died", "vehicle", "how log_tail process place where",
        "its process ended without being told to; its log, or the process that it shares", FAILURE,
        GROUPED | ENDS_PROGRAM)
    stalled = (
        "stalled", "vehicle", "error where refused", "its process did not yield, or did not come back, in time; "
        "why its last message was refused, if it was", FAILURE, CUTS_RUN)
    restarted = "restarted", "vehicle", "incarnation", "it is up again after a kill or restart", CHANGE
    entered = "entered", "vehicle", "incarnation", "it is in the network, and its program starts", CHANGE
    left = "left", "vehicle", "", "it is not in the network any more", CHANGE
    drive_limited = (
        "drive_limited", "vehicle", "acceleration_m_s2 limit_m_s2 lane reason",
        "`node.drive` asked for an acceleration, or a lane, that the vehicle cannot have; of an acceleration "
        "the first time in a row")
    collision = (
        "collision", "vehicle", "with closing_m_s",
        "a driven vehicle has run into another, which was ahead, or crossed its way")
    lane_ended = (
        "lane_ended", "vehicle", "lane", "on a map: a driven vehicle's lane has ended, and it is in this one now")
    rule_failed = (
        "rule_failed", "", "fault rule sender error where", "a rule, a sensor or figures of your own raised, did "
        "not answer, or answered nonsense: it lets everything pass, or they are unknown, from then on", FAILURE)
    fault_started = "fault_started", "", "fault nodes", "a fault begins to act, and on whom"
    fault_ended = "fault_ended", "", "fault", "it has healed"
    judged_by_test = (
        "judged_by_test", "", "checks", "which properties of a test have judged the run, beside its scenario")
    emulator_restarted = "emulator_restarted", "", "down_s", "the emulator's connection is back", CHANGE
    router_restarted = (
        "router_restarted", "", "down_s", "the separate router, or that of each vehicle, is back", CHANGE)
    refused = "refused", "vehicle", "key reason", "the first message on this key that was not believed", WARNING
    refused_total = "refused_total", "", "key count", "how many there were", NOTE, MEASURED
    extra_session = (
        "extra_session", "vehicle", "count limit which", "more Zenoh sessions than `program.zenoh.sessions` are "
        "connected to its endpoint: a way around the radio, and no isolation", FAILURE)
    session_gone = (
        "session_gone", "vehicle", "", "the last Zenoh session of its programs, which others have started, is "
        "gone: what arrives from now on reaches no program", WARNING)
    session_back = "session_back", "vehicle", "", "there is one again", CHANGE
    found_session = (
        "found_session", "vehicle", "which", "this session of its program is a peer that others find by multicast, "
        "past the radio: mode `client`, which `Config.from_env()` has, prevents it", FAILURE)
    observer_ended = "observer_ended", "process", "how", "a recorder ended before the run did", WARNING
    host_gone = (
        "host_gone", "", "host where", "the connection of this host closed; its processes have `died` with it",
        FAILURE)
    host_silent = (
        "host_silent", "", "host where", "this host did not hand in all logs and files of its vehicles at the end")
    log_left_out = (
        "log_left_out", "vehicle", "bytes", "how much of the beginning of its log is still on its host")
    memory = (
        "memory", "process", "time_s private_kb", "private memory in KiB, as two lists", NOTE, SAMPLES | MEASURED)
    memory_exceeded = (
        "memory_exceeded", "process", "nodes memory_mb limit_mb",
        "its private memory exceeded `run.memory_limit_mb`, which ended the run", FAILURE, CUTS_RUN)
    router_ended = (
        "router_ended", "", "how", "the separate router's process ended, which ended the run", FAILURE, CUTS_RUN)
    transport_gap = "transport_gap", "", "count", "real time: how often something went missing on the way", WARNING
    late_deliveries = (
        "late_deliveries", "", "total count p50_ms p99_ms max_ms worst worst_s", "real time: all deliveries, those "
        "over 20 ms late, or early, beyond what restarts held back, how late they were, the processes with most of "
        "them, and the seconds in which most were told of", _if_any, MEASURED)
    # fmt: on


KINDS = {kind.value: kind for kind in EventKind}


def level_of(kind: str, details: Details) -> Level:
    """Return the weight of an event of this kind; a note where `EventKind` has no such kind."""
    level = KINDS[kind].level if kind in KINDS else NOTE
    return level if isinstance(level, Level) else level(details)


def kinds_with(part: Part) -> tuple[EventKind, ...]:
    """Return the kinds of event that have this part."""
    return tuple(kind for kind in EventKind if kind.part & part)


@dataclass(frozen=True)
class Event:
    """One line of `events.jsonl`: something that happened to a node, or to the run where `node` is None.

    A folder of another version may have kinds that `EventKind` has not; they are notes.
    """

    time_ns: int
    kind: str
    node: str | None
    details: dict[str, Any]

    @property
    def level(self) -> Level:
        """Its weight."""
        return level_of(self.kind, self.details)

    @property
    def is_bad(self) -> bool:
        """True if something failed that no planned fault was to do."""
        return self.level >= WARNING

    def has(self, part: Part) -> bool:
        """Return whether its kind has this part."""
        return self.kind in KINDS and bool(KINDS[self.kind].part & part)

    @property
    def name(self) -> str:
        """Name that the program gave to an event of its own (`node.event`); else the kind."""
        return str(self.details.get("name", "")) if self.kind == EventKind.event else self.kind

    @property
    def values(self) -> dict[str, Any]:
        """Details that the program gave to an event of its own; else those of the kind."""
        values = self.details.get("details") if self.kind == EventKind.event else self.details
        return values if isinstance(values, dict) else {}

    @property
    def why(self) -> str:
        """Error of a failure, or how its process ended, and where an exception came up."""
        error = str(self.details.get("error") or self.details.get("how", ""))
        place = str(self.details.get("place", ""))
        return error + (", " if ":" in error else ": ") * bool(place) + place

    @property
    def said(self) -> str:
        """Details in words: reasons first, without pages of text, which are in the run's folder."""
        if self.kind == EventKind.log:
            return str(self.details.get("text", ""))
        if self.kind == EventKind.exception:
            return self.why
        if self.kind == EventKind.started:
            start_up_s = self.details.get("start_up_s") or 0.0
            return f"all have joined in {start_up_s:.1f} s" if start_up_s else ""
        left_out = () if self.kind == EventKind.event else (*PAGES, *REASONS, "fault", "nodes")
        told = {key: _listed(value) for key, value in self.values.items()}
        said = [told[key] for key in (*REASONS, "nodes") if key in left_out and told.get(key)]
        return ", ".join(said + [f"{key} {value}" for key, value in told.items() if key not in left_out])

    @property
    def what(self) -> str:
        """Name and details in words, without whom it befell."""
        if self.kind in (EventKind.log, EventKind.exception):
            return self.said
        name = self.name if self.kind == EventKind.event else self.kind.replace("_", " ")
        name = name.removeprefix("fault ") if "fault" in self.details else name
        return f"{name}: {self.said}" if self.said else name

    @property
    def text(self) -> str:
        """One line: whom it befell, what, and why. `v04 died: SIGKILL`."""
        who = str(self.node or self.details.get("fault") or "")
        colon = ":" * (self.kind in (EventKind.log, EventKind.exception))
        return f"{who}{colon} {self.what}".strip()

    def line(self) -> str:
        """Return the event as a line of `events.jsonl`."""
        return json.dumps({"time_ns": self.time_ns, "kind": self.kind, "node": self.node, **self.details}) + "\n"


def _listed(value: object) -> str:
    return first_names(value, with_total=True) if isinstance(value, list) else str(value)


def parse_events(path: Path, content: bytes) -> list[Event]:
    """Return the events of a file. Raises VnetError where a line is JSON, but no event."""
    events = []
    for line in content.decode("utf-8", "replace").splitlines():
        try:
            data = json.loads(line)
        except (ValueError, RecursionError):
            continue  # the last line of a run that was killed
        if not isinstance(data, dict) or not data.keys() >= {"time_ns", "kind", "node"}:
            continue
        time_ns, kind, node = (data.pop(key) for key in ("time_ns", "kind", "node"))
        if type(time_ns) is not int or not isinstance(kind, str) or not isinstance(node, (str, type(None))):
            raise VnetError(f"{path}: not vnet's events: {printable(line, 100)}")
        events.append(Event(time_ns, kind, node, data))
    return events


_FRAME = re.compile(r'^ *File "(.*)", line (\d+)', re.MULTILINE)


@dataclass(frozen=True)
class Kind:
    """Failures of one kind: events in the order of their instants."""

    events: tuple[Event, ...]

    @property
    def first(self) -> Event:
        """The first of them."""
        return self.events[0]

    @property
    def nodes(self) -> list[str]:
        """Ids of the vehicles that it befell, each once."""
        return list(dict.fromkeys(str(event.node) for event in self.events))

    @property
    def who(self) -> str:
        """The vehicle, or how many there are."""
        return self.nodes[0] if len(self.nodes) == 1 else f"{len(self.nodes)} vehicles"

    @property
    def when(self) -> str:
        """The instant, or that of the first one."""
        instant = f"at {round(self.first.time_ns / 1e9, 3)} s"
        if self.first.kind == EventKind.exception:
            return instant if len(self.events) == 1 else f"first {instant}"
        return instant if len({event.time_ns for event in self.events}) == 1 else f"first {instant}"

    @property
    def untimed(self) -> str:
        """The kind in one line without its instant."""
        ended = "" if self.first.kind == EventKind.exception else f" {self.first.kind}"
        return f"{self.who}{ended}: {self.first.why}"

    def __str__(self) -> str:
        if self.first.kind == EventKind.exception:
            return f"{self.untimed}, {self.when}"
        comma = "," if self.when.startswith("first") else ""
        return f"{self.who} {self.first.kind}{comma} {self.when}: {self.first.why}"


def in_words(kinds: Sequence[Kind], most: int = 5) -> str:
    """Return the first kinds in one line."""
    return "; ".join([*map(str, kinds[:most]), *(["…"] if len(kinds) > most else [])])


def merged(events: Iterable[Event]) -> list[Event]:
    """Return the events with one for each kind of failure, which names how many vehicles it befell."""
    by_kind: dict[tuple[str, ...] | int, list[Event]] = {}
    for number, event in enumerate(events):
        by_kind.setdefault(key_of(event) if event.has(GROUPED) else number, []).append(event)
    return [replace(each[0], node=Kind(tuple(each)).who) if len(each) > 1 else each[0] for each in by_kind.values()]


def kinds_of(events: Iterable[Event]) -> list[Kind]:
    """Sort failures into their kinds: the same type of error, raised in the same line."""
    kinds: dict[tuple[str, ...], list[Event]] = {}
    for event in sorted(events, key=lambda event: event.time_ns):
        kinds.setdefault(key_of(event), []).append(event)
    return [Kind(tuple(events)) for events in kinds.values()]


def key_of(event: Event) -> tuple[str, ...]:
    """Return what failures of one kind have in common."""
    error = str(event.details.get("error") or event.details.get("how", ""))
    place = str(event.details.get("place") or _last_line(str(event.details.get("where", ""))))
    return event.kind, error.partition(":")[0], place


def _last_line(trace: str) -> str:
    """File and line of the innermost frame of a traceback."""
    frames = _FRAME.findall(trace)
    return f"{Path(frames[-1][0]).name}:{frames[-1][1]}" if frames else ""
