"""Faults as data: what is broken, where, from when and for how long.

The same type stands in a scenario (`[[fault]]`) and in the live command (`vnet fault inject`). Every fault ends by
itself. What a kind does is in `emulator.faults`; here is what may be written down.
"""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError, field_validator, model_validator

from emulator.scenario.sections import Section, first_problem
from vnet.errors import ScenarioError, shown

Probability = Annotated[float, Field(ge=0, le=1)]
Point = tuple[float, float]
LONGEST_S = 86_400.0


class Selector(Section):
    """Which nodes: all, unless one of these says otherwise.

    Where vehicles stand their first position counts; where they move, docs/motion.md says which.
    """

    ids: tuple[str, ...] | None = None
    """Those with these names."""
    fraction: Annotated[float, Field(gt=0, le=1)] | None = None
    """This share of all, drawn from the run's seed."""
    random: Annotated[int, Field(ge=1)] | None = None
    """So many of all, drawn from the run's seed."""
    disc: tuple[float, float, Annotated[float, Field(gt=0)]] | None = None
    """Those whose position is in a disc: x, y and radius in m."""
    polygon: Annotated[tuple[Point, ...], Field(min_length=3)] | None = None
    """Those whose position is in a polygon: its corners, [x, y] in m."""
    degree: tuple[Annotated[int, Field(ge=0)], int] | None = None
    """Those with so many others in range: least and most."""

    @property
    def by_place(self) -> bool:
        """Whether it depends on where vehicles are."""
        return any(choice is not None for choice in (self.disc, self.polygon, self.degree))

    @model_validator(mode="after")
    def _at_most_one(self) -> Selector:
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} exclude each other")
        if self.degree is not None and self.degree[0] > self.degree[1]:
            raise ValueError("degree = [least, most] is upside down")
        return self


class _Fault(Section):
    """Any fault."""

    at_s: float = Field(0.0, ge=0, le=LONGEST_S)
    """When it starts, in emulated time."""
    duration_s: float = Field(gt=0, le=LONGEST_S)
    """It ends so much later, in emulated time."""


class _NodeFault(_Fault):
    """A fault of nodes."""

    nodes: Selector = Selector()
    """Whom it strikes."""


class _LinkFault(_Fault):
    """A fault of links: those with an end among `nodes`, from one of `senders`, to one of `receivers`."""

    nodes: Selector = Selector()
    """One end of the link is among these."""
    senders: Selector = Selector()
    """The sender is among these."""
    receivers: Selector = Selector()
    """The receiver is among these."""


# Processes.


class Kill(_NodeFault):
    """The processes are killed (SIGKILL); when the fault ends the programs start anew.

    `node.incarnation` is then one higher, and `node.rng` another stream.
    """

    kind: Literal["kill"]


class Restart(_NodeFault):
    """As `kill`, but the programs are ended in order: their `finally` blocks run."""

    kind: Literal["restart"]


class Pause(_NodeFault):
    """The processes stand still (SIGSTOP in real time) and find afterwards what came meanwhile."""

    kind: Literal["pause"]


# The network.


class Partition(_Fault):
    """Nothing passes between groups. Nodes that no group names are a group of their own."""

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


class Block(_LinkFault):
    """The links carry nothing; with `senders` or `receivers` in one direction only."""

    kind: Literal["block"]


class Loss(_LinkFault):
    """Frames are lost, beside the radio's own loss."""

    kind: Literal["loss"]
    probability: Probability
    """Of losing a frame, at each receiver by itself."""


class BurstLoss(_LinkFault):
    """Loss in bursts (Gilbert 1960, Elliott 1963): each link is good or bad, frame by frame.

    The mean loss is `loss_good` and `loss_bad`, weighed by `leave` and `enter`.
    """

    kind: Literal["burst_loss"]
    enter: Probability = 0.05
    """Probability that a good link turns bad, at each frame."""
    leave: Annotated[float, Field(gt=0, le=1)] = 0.3
    """Probability that a bad link turns good again, at each frame."""
    loss_bad: Probability = 1.0
    """Probability that a bad link loses a frame."""
    loss_good: Probability = 0.0
    """Probability that a good link loses a frame."""


class Delay(_LinkFault):
    """Frames arrive later."""

    kind: Literal["delay"]
    delay_ms: float = Field(gt=0, le=60_000)
    """How much later."""


class Jitter(_LinkFault):
    """Frames arrive later, each by a time of its own."""

    kind: Literal["jitter"]
    jitter_ms: float = Field(gt=0, le=60_000)
    """How much later at most; uniform from 0."""


class Reorder(_LinkFault):
    """Some frames are held back, so that later ones overtake them."""

    kind: Literal["reorder"]
    probability: Probability = 0.2
    """Of holding a frame back, at each receiver by itself."""
    delay_ms: float = Field(150.0, gt=0, le=60_000)
    """How long it is held back."""


class Duplicate(_LinkFault):
    """Some frames arrive again."""

    kind: Literal["duplicate"]
    probability: Probability = 0.2
    """Of repeating a frame, at each receiver by itself."""
    copies: int = Field(1, ge=1, le=20)
    """How many more times it arrives."""
    delay_ms: float = Field(10.0, gt=0, le=60_000)
    """Time from one of these arrivals to the next."""


class Corrupt(_LinkFault):
    """Some frames arrive with bytes changed."""

    kind: Literal["corrupt"]
    probability: Probability = 0.2
    """Of changing a frame, at each receiver by itself."""
    flips: int = Field(1, ge=1, le=65_000)
    """How many bytes; all of a shorter frame."""


class Throttle(_NodeFault):
    """The nodes send slowly; their queues fill."""

    kind: Literal["throttle"]
    bitrate_mbps: float = Field(ge=1e-4, le=1e6)
    """Their bitrate; the radio's own, if that is less."""


class Range(_NodeFault):
    """The nodes hear and are heard less far."""

    kind: Literal["range"]
    range_m: float = Field(gt=0, le=1e9)
    """Their range."""


class Swizzle(_NodeFault):
    """The nodes are cut off one by one, and then come back in another order, each for half of `over_s`."""

    kind: Literal["swizzle"]
    over_s: Annotated[float, Field(gt=0, le=LONGEST_S)] | None = None
    """How long all of this takes; the duration, unless it is given."""


# Sensors and clocks.


class GnssOutage(_NodeFault):
    """No fixes."""

    kind: Literal["gnss_outage"]


class GnssJump(_NodeFault):
    """Fixes are off by a constant."""

    kind: Literal["gnss_jump"]
    offset_m: Point
    """East and north."""


class GnssRamp(_NodeFault):
    """Fixes stray, from 0 at the start."""

    kind: Literal["gnss_ramp"]
    rate_m_s: Point
    """East and north."""


class GnssFreeze(_NodeFault):
    """Fixes repeat the last position, with new times."""

    kind: Literal["gnss_freeze"]


class Skew(_NodeFault):
    """The nodes' clocks are off by a constant.

    `node.now_ns`, the times at which packets are received, and all timers of a program go by them.
    """

    kind: Literal["skew"]
    offset_ms: float = Field(ge=-3.6e6, le=3.6e6)
    """Positive: the clock is ahead."""


class Drift(_NodeFault):
    """The nodes' clocks run too fast or too slow. As `skew`, they are what a program goes by."""

    kind: Literal["drift"]
    rate_ppm: float = Field(ge=-500_000, le=500_000)
    """Positive: too fast."""


# Misbehaviour, as VeReMi names it (van der Heijden, Lukaseder, Kargl 2018; Kamel et al. 2020).


class ConstPosOffset(_NodeFault):
    """The nodes' own fixes are off by a constant, and so is what they say."""

    kind: Literal["ConstPosOffset"]
    offset_m: Point = (50.0, 0.0)
    """East and north."""


class RandomPos(_NodeFault):
    """The nodes' own fixes are anywhere in a disc around where they would be, a new place each time."""

    kind: Literal["RandomPos"]
    radius_m: float = Field(300.0, gt=0)
    """Radius of the disc."""


class DataReplay(_NodeFault):
    """With each frame the nodes send an old one of their own again, of those since the fault began."""

    kind: Literal["DataReplay"]
    age_s: float = Field(1.0, gt=0, le=60)
    """How old: the newest that is at least so old."""


class StaleMessages(_NodeFault):
    """In place of each frame the nodes send an old one of their own, once there is one since the fault began."""

    kind: Literal["StaleMessages"]
    age_s: float = Field(1.0, gt=0, le=60)
    """How old: the newest that is at least so old."""


class DoS(_NodeFault):
    """Each frame goes out many times."""

    kind: Literal["DoS"]
    factor: int = Field(10, ge=2, le=200)
    """How many times in all."""


class Sybil(_NodeFault):
    """Each frame goes out again under other names: ID~1, ID~2, …"""

    kind: Literal["Sybil"]
    ghosts: int = Field(3, ge=1, le=100)
    """How many other names."""


# Infrastructure.


class EmulatorRestart(_Fault):
    """The emulator's router and sessions close and come back; agents are told first.

    In lockstep no emulated time passes meanwhile.
    """

    kind: Literal["emulator_restart"]
    down_s: float = Field(1.0, gt=0, le=60)
    """How long they are away (wall clock)."""
    duration_s: float = Field(0.001, gt=0, le=LONGEST_S)
    """Means nothing here."""


class RouterRestart(_Fault):
    """The separate router is ended and started again; agents are told first."""

    kind: Literal["router_restart"]
    down_s: float = Field(1.0, gt=0, le=60)
    """How long it is away (wall clock)."""
    duration_s: float = Field(0.001, gt=0, le=LONGEST_S)
    """Means nothing here."""


ProcessFault = Kill | Restart | Pause
LinkFault = Block | Loss | BurstLoss | Delay | Jitter | Reorder | Duplicate | Corrupt
GnssFault = GnssOutage | GnssJump | GnssRamp | GnssFreeze | ConstPosOffset | RandomPos
ClockFault = Skew | Drift
SenderFault = DataReplay | StaleMessages | DoS | Sybil
NodeFault = ProcessFault | Throttle | Range | Swizzle | GnssFault | ClockFault | SenderFault
Infrastructure = EmulatorRestart | RouterRestart

Fault = Annotated[NodeFault | LinkFault | Partition | Infrastructure, Field(discriminator="kind")]

_adapter: TypeAdapter[Any] = TypeAdapter(Fault)
KINDS: tuple[str, ...] = tuple(_adapter.json_schema()["discriminator"]["mapping"])
"""The names of all kinds."""


def parse_fault(data: object) -> Fault:
    """A fault from plain data, as of JSON or TOML. Raises ScenarioError in one line."""
    try:
        fault: Fault = _adapter.validate_python(data)
    except ValidationError as error:
        raise ScenarioError(f"fault: {first_problem(error, _adapter)}") from None
    return fault
