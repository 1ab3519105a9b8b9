"""Faults as data: what is broken, where, from when and for how long.

The same type stands in a scenario (`[[fault]]`) and in the live command (`vnet fault inject`). Every fault ends by
itself. What a kind does is in `emulator.faults`; here is what may be written down.
"""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError, field_validator, model_validator

from vnet.errors import ScenarioError, shown
from vnet.sections import Section, first_problem

Probability = Annotated[float, Field(ge=0, le=1)]
Point = tuple[float, float]
LONGEST_S = 86_400.0


class Selector(Section):
    """Which nodes: all, unless one of these says otherwise.

    `ids`; a `fraction` of all, or `random` so many of them, drawn from the run's seed; those whose position is in
    the `disc` (x, y, radius in m) or the `polygon` (corners in m); those with so many others in range (`degree`,
    least and most). Where vehicles stand their first position counts; where they move docs/motion.md says which.
    """

    ids: tuple[str, ...] | None = None
    fraction: Annotated[float, Field(gt=0, le=1)] | None = None
    random: Annotated[int, Field(ge=1)] | None = None
    disc: tuple[float, float, Annotated[float, Field(gt=0)]] | None = None
    polygon: Annotated[tuple[Point, ...], Field(min_length=3)] | None = None
    degree: tuple[Annotated[int, Field(ge=0)], int] | None = None

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
    """`at_s`: when it starts, in emulated seconds; it ends `duration_s` later."""

    at_s: float = Field(0.0, ge=0, le=LONGEST_S)
    duration_s: float = Field(gt=0, le=LONGEST_S)


class _NodeFault(_Fault):
    """A fault of nodes."""

    nodes: Selector = Selector()


class _LinkFault(_Fault):
    """A fault of links: those with an end among `nodes`, from one of `senders`, to one of `receivers`."""

    nodes: Selector = Selector()
    senders: Selector = Selector()
    receivers: Selector = Selector()


# Processes.


class Kill(_NodeFault):
    """The processes are killed (SIGKILL); when the fault ends they start anew, as new incarnations."""

    kind: Literal["kill"]


class Restart(_NodeFault):
    """The programs are ended in order (their `finally` blocks run) and start anew when the fault ends."""

    kind: Literal["restart"]


class Pause(_NodeFault):
    """The processes stand still (SIGSTOP in real time) and find afterwards what came meanwhile."""

    kind: Literal["pause"]


# The network.


class Partition(_Fault):
    """Nothing passes between groups. Nodes that no group names are a group of their own.

    `groups`: lists of ids; or `halves` (two, drawn from the seed), `one` (a single node, drawn), `ring` (each node
    hears only the majority nearest to it on a ring, so that no two agree on who is there).
    """

    kind: Literal["partition"]
    groups: Literal["halves", "one", "ring"] | tuple[tuple[str, ...], ...] = "halves"

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
    """Pairs are lost with `probability`, beside the radio's own loss."""

    kind: Literal["loss"]
    probability: Probability


class BurstLoss(_LinkFault):
    """Loss in bursts (Gilbert 1960, Elliott 1963): each link is good or bad, frame by frame.

    It turns bad with probability `enter` and good again with `leave`; a bad one loses with `loss_bad`, a good one
    with `loss_good`. The mean loss is the two weighed by leave and enter.
    """

    kind: Literal["burst_loss"]
    enter: Probability = 0.05
    leave: Annotated[float, Field(gt=0, le=1)] = 0.3
    loss_bad: Probability = 1.0
    loss_good: Probability = 0.0


class Delay(_LinkFault):
    """Pairs arrive `delay_ms` later."""

    kind: Literal["delay"]
    delay_ms: float = Field(gt=0, le=60_000)


class Jitter(_LinkFault):
    """Pairs arrive later by up to `jitter_ms`, uniformly."""

    kind: Literal["jitter"]
    jitter_ms: float = Field(gt=0, le=60_000)


class Reorder(_LinkFault):
    """With `probability` a pair is held back by `delay_ms`, so that later frames overtake it."""

    kind: Literal["reorder"]
    probability: Probability = 0.2
    delay_ms: float = Field(150.0, gt=0, le=60_000)


class Duplicate(_LinkFault):
    """With `probability` a pair arrives `copies` more times, `delay_ms` apart."""

    kind: Literal["duplicate"]
    probability: Probability = 0.2
    copies: int = Field(1, ge=1, le=20)
    delay_ms: float = Field(10.0, gt=0, le=60_000)


class Corrupt(_LinkFault):
    """With `probability` a pair arrives with `flips` of its bytes changed."""

    kind: Literal["corrupt"]
    probability: Probability = 0.2
    flips: int = Field(1, ge=1, le=65_000)


class Throttle(_NodeFault):
    """The nodes send at `bitrate_mbps` only; their queues fill."""

    kind: Literal["throttle"]
    bitrate_mbps: float = Field(ge=1e-4, le=1e6)


class Range(_NodeFault):
    """The nodes hear and are heard up to `range_m` only."""

    kind: Literal["range"]
    range_m: float = Field(gt=0, le=1e9)


class Swizzle(_NodeFault):
    """The nodes are cut off one by one, and then come back in another order, each for half of `over_s`.

    `over_s` is the duration unless it is given.
    """

    kind: Literal["swizzle"]
    over_s: Annotated[float, Field(gt=0, le=LONGEST_S)] | None = None


# Sensors and clocks.


class GnssOutage(_NodeFault):
    """No fixes."""

    kind: Literal["gnss_outage"]


class GnssJump(_NodeFault):
    """Fixes are off by `offset_m`."""

    kind: Literal["gnss_jump"]
    offset_m: Point


class GnssRamp(_NodeFault):
    """Fixes stray by `rate_m_s`, from 0 at the start."""

    kind: Literal["gnss_ramp"]
    rate_m_s: Point


class GnssFreeze(_NodeFault):
    """Fixes repeat the last position, with new times."""

    kind: Literal["gnss_freeze"]


class Skew(_NodeFault):
    """The nodes' clocks are off by `offset_ms`."""

    kind: Literal["skew"]
    offset_ms: float = Field(ge=-3.6e6, le=3.6e6)


class Drift(_NodeFault):
    """The nodes' clocks run too fast by `rate_ppm` (too slow if negative)."""

    kind: Literal["drift"]
    rate_ppm: float = Field(ge=-500_000, le=500_000)


# Misbehaviour, as VeReMi names it (van der Heijden, Lukaseder, Kargl 2018; Kamel et al. 2020).


class ConstPosOffset(_NodeFault):
    """The nodes' own fixes are off by a constant `offset_m`, and so is what they say."""

    kind: Literal["ConstPosOffset"]
    offset_m: Point = (50.0, 0.0)


class RandomPos(_NodeFault):
    """The nodes' own fixes are anywhere within `radius_m` of where they would be, a new place each time."""

    kind: Literal["RandomPos"]
    radius_m: float = Field(300.0, gt=0)


class DataReplay(_NodeFault):
    """With each frame the nodes send one of their own from `age_s` ago again, of those since the fault began."""

    kind: Literal["DataReplay"]
    age_s: float = Field(1.0, gt=0, le=60)


class StaleMessages(_NodeFault):
    """In place of each frame the nodes send the one from `age_s` ago, once there is one since the fault began."""

    kind: Literal["StaleMessages"]
    age_s: float = Field(1.0, gt=0, le=60)


class DoS(_NodeFault):
    """Each frame goes out `factor` times."""

    kind: Literal["DoS"]
    factor: int = Field(10, ge=2, le=200)


class Sybil(_NodeFault):
    """Each frame goes out again under `ghosts` other names: ID~1, ID~2, …"""

    kind: Literal["Sybil"]
    ghosts: int = Field(3, ge=1, le=100)


# Infrastructure.


class EmulatorRestart(_Fault):
    """The emulator's router and sessions close and come back after `down_s` of wall clock; agents are told first.

    In lockstep no emulated time passes meanwhile, and `duration_s` means nothing.
    """

    kind: Literal["emulator_restart"]
    down_s: float = Field(1.0, gt=0, le=60)
    duration_s: float = Field(0.001, gt=0, le=LONGEST_S)


class RouterRestart(_Fault):
    """The separate router is ended and started again after `down_s` of wall clock; agents are told first."""

    kind: Literal["router_restart"]
    down_s: float = Field(1.0, gt=0, le=60)
    duration_s: float = Field(0.001, gt=0, le=LONGEST_S)


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
