"""The faults of a scenario: what each kind is called, what it inherits, when it acts, and how campaigns draw it.

A kind of fault is one class that derives from a family, below. The class is the only place that says how the kind
is called, which parameters it has, what the reference page says about it, how a campaign draws it, and which law it
follows. CONTRIBUTING.md shows an example. The layers above act on families:

| family | carried out by | judged by |
|---|---|---|
| `ProcessFault` | `drivers/emulation.py` | `checks/faults.py` |
| `cuts = True` | `radio/faults.py` | `checks/faults.py` |
| `LossFault`, `DelayFault` | `radio/faults.py` by the kind's law | `checks/faults.py`, `checks/channel.py` |
| `SenderFault` | `radio/faults.py` | `checks/faults.py` |
| `OwnRule` | `radio/own_rules.py` | `checks/own.py` |
| `GnssFault`, `ClockFault` | `world/truth.py` | `checks/faults.py` |
| `Infrastructure` | `drivers/live/processes.py` | `checks/faults.py` |

The same tables stand in a scenario (`[[fault]]`) and behind the live command (`vnet fault inject`). Every fault
ends by itself.
"""

from __future__ import annotations

import functools
import operator
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Protocol, TypeVar, cast, get_args, get_origin

import numpy as np
from pydantic import (
    Field,
    PlainSerializer,
    PlainValidator,
    SerializationInfo,
    TypeAdapter,
    ValidationError,
    field_validator,
    model_validator,
)

from emulator.scenario.program import Entry, split_file
from emulator.scenario.sections import DAY_S, Section, first_problem
from vnet.errors import ScenarioError, shown
from vnet.types import Array, Mask
from vnet.units import NS_PER_S

T = TypeVar("T")
RENAMED_SELECTORS = {"random": "count"}
"""Keys of selectors: the old name, and today's."""
Probability = Annotated[float, Field(ge=0, le=1)]
Point = tuple[float, float]
FURTHEST_M = 1e8
"""Largest offset of fixes; with much more a double has no room for a receiver's noise beside it."""
_Far = Annotated[float, Field(ge=-FURTHEST_M, le=FURTHEST_M)]
_Fast = Annotated[float, Field(ge=-1000, le=1000)]
DEFAULT_RULE = "rule"
"""Function of a file that is named as a rule without one."""


class Chooser(Protocol):
    """A source of choices: a random generator in campaigns, hypothesis in property tests.

    The first choice everywhere is the simplest one, so that hypothesis shrinks to it.
    """

    def integer(self, low: int, high: int) -> int:
        """Choose a whole number, low ≤ n ≤ high."""

    def choice(self, items: Sequence[T]) -> T:
        """Choose one of these."""

    def subset(self, items: Sequence[T], most: int) -> list[T]:
        """Choose at least one of these and at most `most`, in their order."""


@dataclass(frozen=True)
class Drawn:
    """A parameter's range in campaigns: whole numbers from `low` to `high`, times `times`, divided by `per`.

    Written beside the type of a field, `Annotated[float, Drawn(1, 10, per=10)]`. A parameter that is a pair of
    numbers gets two draws. A parameter without one keeps its default.
    """

    low: int
    high: int
    times: int = 1
    per: int = 1

    @property
    def step(self) -> float:
        """Distance of two neighbouring numbers that can be drawn."""
        return self.times / self.per

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and greatest number that can be drawn."""
        return self.low * self.times / self.per, self.high * self.times / self.per

    def between(self, low: float, high: float) -> Drawn:
        """Return the same steps between other bounds. Raises ValueError for what is no multiple of a step."""
        steps = [round(bound / self.step) for bound in (low, high)]
        if (
            any(abs(n * self.step - bound) > 1e-9 for n, bound in zip(steps, (low, high), strict=True))
            or low > high
        ):
            raise ValueError(f"two multiples of {self.step:g} are needed, the lower one first")
        return Drawn(steps[0], steps[1], self.times, self.per)

    def draw(self, choose: Chooser) -> float:
        """Draw one number."""
        number = choose.integer(self.low, self.high) * self.times
        return number if self.per == 1 else number / self.per


class Selector(Section):
    """A choice of nodes: all, unless one of these keys says otherwise. A list is short for `ids`.

    Positions are those at the start of the run where vehicles stand; docs/motion.md says which where they move.
    """

    ids: tuple[str, ...] | None = None
    """The nodes with these names."""
    fraction: Annotated[float, Field(gt=0, le=1)] | None = None
    """This share of all nodes, drawn from the run's seed."""
    count: Annotated[int, Field(ge=1)] | None = None
    """This many nodes, drawn from the run's seed."""
    disc: tuple[float, float, Annotated[float, Field(gt=0)]] | None = None
    """The nodes in a disc: x, y and radius in m."""
    polygon: Annotated[tuple[Point, ...], Field(min_length=3)] | None = None
    """The nodes in a polygon: its corners, [x, y] in m."""
    degree: tuple[Annotated[int, Field(ge=0)], int] | None = None
    """The nodes with this many others in range: least and most."""

    @property
    def by_position(self) -> bool:
        """True if the choice depends on the positions of vehicles."""
        return any(choice is not None for choice in (self.disc, self.polygon, self.degree))

    @model_validator(mode="before")
    @classmethod
    def _is_list_or_table(cls, given: Any) -> Any:
        if isinstance(given, (list, tuple)):
            return {"ids": given}
        if not isinstance(given, (dict, Selector)):
            raise ValueError('a selector is a list of ids, as ["v01", "v02"], or a table, as { count = 3 }')
        if isinstance(given, dict):
            for old, new in RENAMED_SELECTORS.items():
                if old in given:
                    raise ValueError(f"{old} is called {new}: write {{ {new} = {shown(given[old])} }}")
        return given

    @model_validator(mode="after")
    def _at_most_one(self) -> Selector:
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} exclude each other")
        if self.degree is not None and self.degree[0] > self.degree[1]:
            raise ValueError("degree = [least, most] is upside down")
        return self


class Fault(Section):
    """A fault of any kind. Deriving a class that narrows `kind` to one literal registers that kind."""

    kinds: ClassVar[dict[str, type[Section]]] = {}
    """The classes of all kinds by their names."""
    chapter: ClassVar[str] = "The network"
    """The heading of the kind's family in docs/reference/faults.md."""
    acts_on: ClassVar[str] = "the network"
    """Targets of the kind, in the words of the reference page."""
    campaign_weight: ClassVar[int] = 1
    """Frequency at which campaigns draw the kind, relative to others; 0: never."""
    live_only: ClassVar[bool] = False
    """True if a simulation has nothing that the kind could act on; campaigns then never draw it."""
    cuts: ClassVar[bool] = False
    """True if no frame passes a link on which the fault acts."""
    follows_vehicles: ClassVar[bool] = False
    """True if a selector by position is evaluated again each period; otherwise once, at the fault's start."""

    kind: str
    """Name of the kind."""
    at_s: float = Field(0.0, ge=0, le=DAY_S)
    """Start of the fault, in emulated time."""
    duration_s: float = Field(gt=0, le=DAY_S)
    """Length of the fault, in emulated time."""
    draws_of: int | None = Field(None, ge=0, lt=2**16)
    """Place in the file, from 0 on, whose random draws the fault has: those that it had before others were taken
    out. If left out, its own, or the next that no fault has."""

    @property
    def title(self) -> str:
        """Name of the fault in its label: its kind, unless it has a name of its own."""
        return self.kind

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        for name in get_args(cls.model_fields["kind"].annotation):
            if name in Fault.kinds:
                raise TypeError(f"fault kind {name!r} is both {Fault.kinds[name].__name__} and {cls.__name__}")
            Fault.kinds[name] = cls

    @classmethod
    def draw_target(cls, choose: Chooser, processes: Sequence[tuple[str, ...]]) -> dict[str, Any]:
        """Draw what the fault acts on; `processes` are the ids of the vehicles, process by process."""
        return {}

    @classmethod
    def drawn_ranges(cls) -> dict[str, Drawn]:
        """Return the ranges of the parameters that campaigns draw, in the order of the fields."""
        metadata = {name: field.metadata for name, field in cls.model_fields.items()}
        return {name: each for name, found in metadata.items() for each in found if isinstance(each, Drawn)}

    @classmethod
    def draw_parameters(cls, choose: Chooser, ranges: Mapping[str, Drawn] | None = None) -> dict[str, Any]:
        """Draw every parameter with a `Drawn`, in the order of the fields; `ranges` are used in place of theirs."""
        drawn: dict[str, Any] = {}
        for name, law in (cls.drawn_ranges() | dict(ranges or {})).items():
            pair = get_origin(cls.model_fields[name].annotation) is tuple
            drawn[name] = (law.draw(choose), law.draw(choose)) if pair else law.draw(choose)
        return drawn


def half(count: int) -> int:
    """Return the most vehicles, of `count`, on which a drawn fault acts: a plausible fault spares half of them."""
    return max(1, count // 2)


class NodeFault(Fault):
    """A fault of nodes."""

    acts_on: ClassVar[str] = "vehicles"

    nodes: Selector = Selector()
    """The nodes on which the fault acts."""

    @classmethod
    def draw_target(cls, choose: Chooser, processes: Sequence[tuple[str, ...]]) -> dict[str, Any]:
        """Draw up to half of the vehicles."""
        return _draw_selector(choose, processes, ("nodes",))


class LinkFault(Fault):
    """A fault of links: those with an end among `nodes`, from one of `senders`, to one of `receivers`."""

    acts_on: ClassVar[str] = "links"
    follows_vehicles: ClassVar[bool] = True

    nodes: Selector = Selector()
    """One end of the link is among these."""
    senders: Selector = Selector()
    """The sender is among these."""
    receivers: Selector = Selector()
    """The receiver is among these."""

    @classmethod
    def draw_target(cls, choose: Chooser, processes: Sequence[tuple[str, ...]]) -> dict[str, Any]:
        """Draw up to half of the vehicles as one end of the links, as their senders, or as their receivers."""
        return _draw_selector(choose, processes, ("nodes", "senders", "receivers"))


def _draw_selector(
    choose: Chooser, processes: Sequence[tuple[str, ...]], selectors: Sequence[str]
) -> dict[str, Any]:
    ids = [node for process in processes for node in process]
    chosen = choose.subset(ids, half(len(ids)))
    return {choose.choice(selectors): {"ids": chosen}}


class ProcessFault(NodeFault):
    """A fault of processes: their programs are ended, or paused, until the fault ends."""

    chapter: ClassVar[str] = "Processes"
    ends: ClassVar[bool] = False
    """True if the programs are ended and start again after the fault; otherwise they are paused."""
    forced: ClassVar[bool] = False
    """True if the programs are ended without notice."""

    @classmethod
    def draw_target(cls, choose: Chooser, processes: Sequence[tuple[str, ...]]) -> dict[str, Any]:
        """Draw up to half of the processes: the nodes of one process start, pause and die together."""
        chosen = choose.subset(processes, half(len(processes)))
        return {"nodes": {"ids": [node for process in chosen for node in process]}}


class LossFault(LinkFault):
    """A fault that loses frames by chance, at each receiver independently."""

    @property
    def mean_loss(self) -> float:
        """The expected share of lost receptions, in the long run."""
        raise NotImplementedError

    def lost(self, draws: Array, bad: Mask) -> Mask:
        """Return which receivers (N,) lose a frame, from uniform draws (2, N) in [0, 1).

        `bad` (N,) is the memory of the links from the frame's sender, all False at first; a law that has a memory
        changes it in place.
        """
        raise NotImplementedError


class DelayFault(LinkFault):
    """A fault that adds to the latency of receptions."""

    @property
    def bounds_ms(self) -> tuple[float, float]:
        """Least and greatest extra latency in ms."""
        raise NotImplementedError

    def added_ms(self, draws: Array) -> Array:
        """Return the extra latency (N,) in ms at each receiver, from uniform draws (N,) in [0, 1)."""
        raise NotImplementedError


class SenderFault(NodeFault):
    """A fault of senders: frames of their own are sent again, or in place of others."""

    chapter: ClassVar[str] = "Misbehaviour"


class OwnRule(Fault):
    """A fault whose effect a function of the user's own decides, frame by frame."""

    chapter: ClassVar[str] = "Rules of your own"
    campaign_weight: ClassVar[int] = 0

    rule: Entry
    """Function that is called with each frame: `package.module:function` or `file.py:function`; a file's is `rule`
    if left out. It is looked for beside the scenario first, then in the current folder."""
    name: str | None = Field(None, pattern=r"^[A-Za-z][A-Za-z0-9_]{0,39}$")
    """Name in the trace, in events and in checks, before the fault's number; the function's, unless it is given."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Given to the rule as `frame.options`; what is allowed is its own business."""

    @property
    def title(self) -> str:
        """The name, or that of the function."""
        file = split_file(self.rule)
        function = file[1] if file is not None else self.rule.rpartition(":")[2]
        return self.name or function or DEFAULT_RULE

    def __hash__(self) -> int:
        """Return a hash as all faults have one, from all but the options, which are tables."""
        others = (getattr(self, name) for name in type(self).model_fields if name != "options")
        return hash((type(self), *others))


class GnssFault(NodeFault):
    """A fault of GNSS receivers."""

    chapter: ClassVar[str] = "GNSS receivers"
    follows_vehicles: ClassVar[bool] = True

    def displacement_m(self, since_ns: int) -> Array | None:
        """Return what the fault adds to a fix (2,) `since_ns` after its start; None if time does not tell."""
        return None


class ClockFault(NodeFault):
    """A fault of the nodes' clocks."""

    chapter: ClassVar[str] = "Clocks"


class Infrastructure(Fault):
    """A fault of the emulator's own processes; live runs only."""

    chapter: ClassVar[str] = "Infrastructure"
    live_only: ClassVar[bool] = True

    duration_s: float = Field(0.001, gt=0, le=DAY_S)
    """Ignored."""
    down_s: float = Field(1.0, gt=0, le=60)
    """Time from the end to the new start (wall clock)."""


# Processes.


class Kill(ProcessFault):
    """The processes are killed (SIGKILL); when the fault ends the programs start again, but those that had ended.

    `node.incarnation` is then one higher, and `node.rng` another stream.
    """

    campaign_weight: ClassVar[int] = 3
    ends: ClassVar[bool] = True
    forced: ClassVar[bool] = True

    kind: Literal["kill"]


class Restart(ProcessFault):
    """The programs are ended in order: `finally` blocks run, in lockstep without waiting; else as `kill`.

    Zenoh programs are ended by SIGTERM, at which Python runs nothing more, unless in real time the program
    handles it.
    """

    ends: ClassVar[bool] = True

    kind: Literal["restart"]


class Pause(ProcessFault):
    """The processes are paused (SIGSTOP in real time) and find afterwards what arrived meanwhile."""

    campaign_weight: ClassVar[int] = 3

    kind: Literal["pause"]


# The network.


class Partition(Fault):
    """Nothing passes between groups. Nodes that no group names are a group of their own."""

    campaign_weight: ClassVar[int] = 4
    cuts: ClassVar[bool] = True

    kind: Literal["partition"]
    groups: Literal["halves", "one", "ring"] | tuple[tuple[str, ...], ...] = "halves"
    """Lists of ids; or `halves` (two, drawn from the seed), `one` (a single node, drawn), `ring` (each node hears
    only the majority nearest to it on a ring, so that no two agree on who is there)."""

    @field_validator("groups", mode="before")
    @classmethod
    def _groups_are_named_or_listed(cls, groups: Any) -> Any:
        if isinstance(groups, str) and groups in ("halves", "one", "ring"):
            return groups
        listed = isinstance(groups, (list, tuple)) and all(isinstance(group, (list, tuple)) for group in groups)
        ids = [node for group in groups for node in group] if listed else []
        if not listed or not all(isinstance(node, str) for node in ids):
            raise ValueError("write halves, one, ring, or lists of ids")
        if twice := [node for node, count in Counter(ids).items() if count > 1]:
            raise ValueError(f"{shown(twice[0])} is in two groups")
        return groups

    @classmethod
    def draw_target(cls, choose: Chooser, processes: Sequence[tuple[str, ...]]) -> dict[str, Any]:
        """Draw a shape, or one group of up to half of the vehicles."""
        shape = choose.choice(("named", "halves", "one", "ring"))
        ids = [node for process in processes for node in process]
        return {"groups": [choose.subset(ids, half(len(ids)))] if shape == "named" else shape}


class Block(LinkFault):
    """The links carry nothing; with `senders` or `receivers` in one direction only."""

    campaign_weight: ClassVar[int] = 2
    cuts: ClassVar[bool] = True

    kind: Literal["block"]


class Loss(LossFault):
    """Frames are lost, in addition to the radio's own loss."""

    kind: Literal["loss"]
    probability: Annotated[Probability, Drawn(1, 10, per=10)]
    """Probability of losing a frame, at each receiver independently."""

    @property
    def mean_loss(self) -> float:
        """The probability of losing a frame."""
        return self.probability

    def lost(self, draws: Array, bad: Mask) -> Mask:
        """Return which receivers (N,) lose a frame, without memory."""
        return np.asarray(draws[0] < self.probability)


class BurstLoss(LossFault):
    """Loss in bursts (Gilbert 1960, Elliott 1963): each link is good or bad, frame by frame.

    The mean loss is `loss_good` and `loss_bad`, weighted by `leave` and `enter`.
    """

    campaign_weight: ClassVar[int] = 2

    kind: Literal["burst_loss"]
    enter: Annotated[Probability, Drawn(1, 30, per=100)] = 0.05
    """Probability that a good link turns bad, at each frame."""
    leave: Annotated[float, Field(gt=0, le=1), Drawn(1, 10, per=10)] = 0.3
    """Probability that a bad link turns good again, at each frame."""
    loss_bad: Probability = 1.0
    """Probability that a bad link loses a frame."""
    loss_good: Probability = 0.0
    """Probability that a good link loses a frame."""

    @property
    def mean_loss(self) -> float:
        """The loss of a link in its stationary state."""
        return (self.enter * self.loss_bad + self.leave * self.loss_good) / (self.enter + self.leave)

    def lost(self, draws: Array, bad: Mask) -> Mask:
        """Return which receivers (N,) lose a frame; `bad` (N,) is the state of the links, changed in place."""
        bad[:] = np.where(bad, draws[0] >= self.leave, draws[0] < self.enter)
        return np.asarray(draws[1] < np.where(bad, self.loss_bad, self.loss_good))


class Delay(DelayFault):
    """Frames arrive later, by the same time at every receiver."""

    kind: Literal["delay"]
    delay_ms: Annotated[float, Drawn(1, 500)] = Field(gt=0, le=60_000)
    """Extra latency."""

    @property
    def bounds_ms(self) -> tuple[float, float]:
        """The delay, twice."""
        return self.delay_ms, self.delay_ms

    def added_ms(self, draws: Array) -> Array:
        """Return the delay, at every receiver (N,)."""
        return np.full(len(draws), self.delay_ms)


class Jitter(DelayFault):
    """Frames arrive later, by a random time at each receiver."""

    kind: Literal["jitter"]
    jitter_ms: Annotated[float, Drawn(1, 300)] = Field(gt=0, le=60_000)
    """Greatest extra latency; uniform from 0."""

    @property
    def bounds_ms(self) -> tuple[float, float]:
        """Zero and the greatest extra latency."""
        return 0.0, self.jitter_ms

    def added_ms(self, draws: Array) -> Array:
        """Return a uniform latency at each receiver (N,)."""
        return self.jitter_ms * draws


class Reorder(DelayFault):
    """Some frames are held back, so that later ones overtake them."""

    kind: Literal["reorder"]
    probability: Annotated[Probability, Drawn(1, 5, per=10)] = 0.2
    """Probability of holding a frame back, at each receiver independently."""
    delay_ms: Annotated[float, Drawn(1, 400)] = Field(150.0, gt=0, le=60_000)
    """Time for which a frame is held back."""

    @property
    def bounds_ms(self) -> tuple[float, float]:
        """Zero and the time for which a frame is held back."""
        return 0.0, self.delay_ms

    def added_ms(self, draws: Array) -> Array:
        """Return the delay at the receivers (N,) at which a frame is held back, else zero."""
        return np.where(draws < self.probability, self.delay_ms, 0.0)


class Duplicate(LinkFault):
    """Some frames arrive more than once."""

    kind: Literal["duplicate"]
    probability: Annotated[Probability, Drawn(1, 5, per=10)] = 0.2
    """Probability of repeating a frame, at each receiver independently."""
    copies: Annotated[int, Drawn(1, 3)] = Field(1, ge=1, le=20)
    """Number of further arrivals."""
    delay_ms: Annotated[float, Drawn(1, 100)] = Field(10.0, gt=0, le=60_000)
    """Time from one of these arrivals to the next."""


class Corrupt(LinkFault):
    """Some frames arrive with bytes changed, which tests software: on the air such frames fail their FCS."""

    campaign_weight: ClassVar[int] = 2

    kind: Literal["corrupt"]
    probability: Annotated[Probability, Drawn(1, 5, per=10)] = 0.2
    """Probability of changing a frame, at each receiver independently."""
    flips: Annotated[int, Drawn(1, 8)] = Field(1, ge=1, le=65_000)
    """Number of changed bytes; all bytes of a shorter frame."""


class Throttle(NodeFault):
    """The nodes send slowly; their queues fill."""

    kind: Literal["throttle"]
    bitrate_mbps: Annotated[float, Drawn(1, 40, per=20)] = Field(ge=1e-4, le=1e6)
    """Bitrate of the nodes; the radio's own, if that is less."""


class Range(NodeFault):
    """The radio range of the nodes shrinks, for sending and receiving."""

    cuts: ClassVar[bool] = True
    follows_vehicles: ClassVar[bool] = True

    kind: Literal["range"]
    range_m: Annotated[float, Drawn(1, 20, times=100)] = Field(gt=0, le=1e9)
    """Range of the nodes."""


class Swizzle(NodeFault):
    """The nodes are cut off one by one in the first half of `over_s`, and come back in the second in any order."""

    cuts: ClassVar[bool] = True

    kind: Literal["swizzle"]
    over_s: Annotated[float, Field(gt=0, le=DAY_S)] | None = None
    """Time from the first cut to the last return; the duration, unless it is given."""


# Sensors and clocks.


class GnssOutage(GnssFault):
    """No fixes."""

    kind: Literal["gnss_outage"]


class GnssJump(GnssFault):
    """Fixes are off by a constant."""

    kind: Literal["gnss_jump"]
    offset_m: Annotated[tuple[_Far, _Far], Drawn(-50, 50)]
    """Offset of the fixes, east and north."""

    def displacement_m(self, since_ns: int) -> Array | None:
        """Return the offset (2,)."""
        return np.array(self.offset_m)


class GnssRamp(GnssFault):
    """Fixes drift away, from 0 at the start."""

    kind: Literal["gnss_ramp"]
    rate_m_s: Annotated[tuple[_Fast, _Fast], Drawn(-3, 3)]
    """Speed of the drift, east and north."""

    def displacement_m(self, since_ns: int) -> Array | None:
        """Return the offset (2,) that has accumulated since the start."""
        return np.asarray(np.array(self.rate_m_s) * since_ns / NS_PER_S)


class GnssFreeze(GnssFault):
    """Fixes repeat the receiver's own last position, with new times; offsets of other faults are added to it."""

    follows_vehicles: ClassVar[bool] = False

    kind: Literal["gnss_freeze"]


class Skew(ClockFault):
    """The nodes' clocks are off by a constant.

    `node.now_ns`, the times at which packets are received, and timers that a program sets meanwhile follow them.
    """

    kind: Literal["skew"]
    offset_ms: Annotated[float, Drawn(-1000, 1000)] = Field(ge=-3.6e6, le=3.6e6)
    """Offset of the clock; positive: the clock is ahead."""


class Drift(ClockFault):
    """The nodes' clocks run too fast or too slow. As with `skew`, programs follow them."""

    kind: Literal["drift"]
    rate_ppm: Annotated[float, Drawn(-500, 500, times=100)] = Field(ge=-500_000, le=500_000)
    """Error of the clock's rate; positive: too fast."""


# Misbehaviour, as VeReMi names it (van der Heijden, Lukaseder, Kargl 2018; Kamel et al. 2020).


class ConstPosOffset(GnssFault):
    """The nodes' own fixes are off by a constant, and so is what they say."""

    chapter: ClassVar[str] = "Misbehaviour"

    kind: Literal["ConstPosOffset"]
    offset_m: Annotated[tuple[_Far, _Far], Drawn(-50, 50)] = (50.0, 0.0)
    """Offset of the fixes, east and north."""

    def displacement_m(self, since_ns: int) -> Array | None:
        """Return the offset (2,)."""
        return np.array(self.offset_m)


class RandomPos(GnssFault):
    """The nodes' own fixes are anywhere in a disc around their true fixes, drawn again each time."""

    chapter: ClassVar[str] = "Misbehaviour"

    kind: Literal["RandomPos"]
    radius_m: Annotated[float, Drawn(1, 300)] = Field(300.0, gt=0, le=FURTHEST_M)
    """Radius of the disc."""


class DataReplay(SenderFault):
    """The nodes send an old frame of their own with each new one, if there is one since the fault began."""

    kind: Literal["DataReplay"]
    age_s: Annotated[float, Drawn(1, 30, per=10)] = Field(1.0, gt=0, le=60)
    """Age of the old frame: the newest one that is at least this old."""


class StaleMessages(SenderFault):
    """The nodes send an old frame of their own instead of each new one, once there is one since the fault began."""

    kind: Literal["StaleMessages"]
    age_s: Annotated[float, Drawn(1, 30, per=10)] = Field(1.0, gt=0, le=60)
    """Age of the old frame: the newest one at least this old. It keeps its addressee, power and bit rate."""


class DoS(SenderFault):
    """Each frame is sent many times."""

    kind: Literal["DoS"]
    factor: Annotated[int, Drawn(2, 10)] = Field(10, ge=2, le=200)
    """Number of transmissions of each frame."""


class Sybil(SenderFault):
    """Each frame is sent again under other names: ID~1, ID~2, …"""

    kind: Literal["Sybil"]
    ghosts: Annotated[int, Drawn(1, 3)] = Field(3, ge=1, le=100)
    """Number of other names."""


# Rules of the user's own.


class Custom(OwnRule, LinkFault):
    """A function of your own lets frames pass, drops, delays, alters or duplicates them, at each receiver."""

    kind: Literal["custom"]


class CustomSender(OwnRule, SenderFault):
    """A function of your own says which frames a vehicle sends in place of each of its frames."""

    kind: Literal["custom_sender"]


# Infrastructure.


class EmulatorRestart(Infrastructure):
    """The emulator's router and sessions close and come back; agents are told first.

    In lockstep no emulated time passes meanwhile. In real time what is due meanwhile comes late, and frames,
    reports and requests of agents are lost; neither counts against the machine.
    """

    kind: Literal["emulator_restart"]


class RouterRestart(Infrastructure):
    """The separate router is ended and started again; agents are told first. Of Zenoh programs each vehicle's own
    router is."""

    kind: Literal["router_restart"]


KINDS = cast(Mapping[str, type[Fault]], Fault.kinds)
"""All kinds by their names; a class that is added later is there as well."""


@functools.lru_cache
def _adapter(kinds: tuple[type[Fault], ...]) -> TypeAdapter[Any]:
    """Return the validator of a fault that is one of these kinds."""
    fault: Any = Annotated[functools.reduce(operator.or_, kinds), Field(discriminator="kind")]
    return TypeAdapter(fault)


def _validate(data: object) -> Fault:
    """Return the fault that plain data describe. Raises ValidationError."""
    fault: Fault = _adapter(tuple(KINDS.values())).validate_python(data)
    return fault


def _plain(fault: Fault, info: SerializationInfo) -> dict[str, Any]:
    """Return a fault as plain data, as `SerializeAsAny` has it from pydantic 2.14 on for classes made late."""
    return fault.model_dump(mode=info.mode, exclude_none=info.exclude_none, exclude_defaults=info.exclude_defaults)


AnyFault = Annotated[Fault, PlainValidator(_validate), PlainSerializer(_plain)]
"""A fault of any kind, as the type of a scenario's key."""


def refuse_router_restart(faults: Iterable[Fault]) -> None:
    """Raise ScenarioError for the fault `router_restart`, where there is no router beside the emulator's own."""
    if any(fault.kind == "router_restart" for fault in faults):
        raise ScenarioError("fault router_restart: needs a router of its own: vnet run --router separate")


def parse_fault(data: object) -> Fault:
    """Return the fault that plain data, as of JSON or TOML, describe. Raises ScenarioError in one line."""
    try:
        return _validate(data)
    except ValidationError as error:
        raise ScenarioError(f"fault: {first_problem(error, Fault)}") from None
