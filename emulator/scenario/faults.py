"""The kinds of faults: parameters, documentation, law, and how a campaign draws each of them.

The same tables stand in a scenario (`[[fault]]`) and behind the live command (`vnet fault inject`). Every fault
ends by itself. A kind is added by one class here; `emulator.scenario.fault_families` says what it inherits, and
CONTRIBUTING.md shows an example.
"""

from __future__ import annotations

import functools
import operator
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, cast

import numpy as np
from pydantic import Field, PlainValidator, SerializeAsAny, TypeAdapter, ValidationError, field_validator

from emulator.scenario.fault_draws import Chooser, Drawn
from emulator.scenario.fault_families import (
    LONGEST_S,
    ClockFault,
    DelayFault,
    Fault,
    GnssFault,
    Infrastructure,
    LinkFault,
    LossFault,
    NodeFault,
    OwnRule,
    Point,
    Probability,
    ProcessFault,
    SenderFault,
    half,
)
from emulator.scenario.sections import first_problem
from vnet.errors import ScenarioError, shown
from vnet.types import Array, Mask
from vnet.units import NS_PER_S

# Processes.


class Kill(ProcessFault):
    """The processes are killed (SIGKILL); when the fault ends the programs start again.

    `node.incarnation` is then one higher, and `node.rng` another stream.
    """

    campaign_weight: ClassVar[int] = 3
    ends: ClassVar[bool] = True
    forced: ClassVar[bool] = True

    kind: Literal["kill"]


class Restart(ProcessFault):
    """The programs are ended in order, so that their `finally` blocks run; else as `kill`."""

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
    """The nodes are cut off one by one, and then come back in another order, each for half of `over_s`."""

    cuts: ClassVar[bool] = True

    kind: Literal["swizzle"]
    over_s: Annotated[float, Field(gt=0, le=LONGEST_S)] | None = None
    """Time from the first cut to the last return; the duration, unless it is given."""


# Sensors and clocks.


class GnssOutage(GnssFault):
    """No fixes."""

    kind: Literal["gnss_outage"]


class GnssJump(GnssFault):
    """Fixes are off by a constant."""

    kind: Literal["gnss_jump"]
    offset_m: Annotated[Point, Drawn(-50, 50)]
    """Offset of the fixes, east and north."""

    def displacement_m(self, since_ns: int) -> Array | None:
        """Return the offset (2,)."""
        return np.array(self.offset_m)


class GnssRamp(GnssFault):
    """Fixes drift away, from 0 at the start."""

    kind: Literal["gnss_ramp"]
    rate_m_s: Annotated[Point, Drawn(-3, 3)]
    """Speed of the drift, east and north."""

    def displacement_m(self, since_ns: int) -> Array | None:
        """Return the offset (2,) that has accumulated since the start."""
        return np.asarray(np.array(self.rate_m_s) * since_ns / NS_PER_S)


class GnssFreeze(GnssFault):
    """Fixes repeat the last position, with new times."""

    follows_vehicles: ClassVar[bool] = False

    kind: Literal["gnss_freeze"]


class Skew(ClockFault):
    """The nodes' clocks are off by a constant.

    `node.now_ns`, the times at which packets are received, and all timers of a program follow them.
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
    offset_m: Annotated[Point, Drawn(-50, 50)] = (50.0, 0.0)
    """Offset of the fixes, east and north."""

    def displacement_m(self, since_ns: int) -> Array | None:
        """Return the offset (2,)."""
        return np.array(self.offset_m)


class RandomPos(GnssFault):
    """The nodes' own fixes are anywhere in a disc around their true fixes, drawn again each time."""

    chapter: ClassVar[str] = "Misbehaviour"

    kind: Literal["RandomPos"]
    radius_m: Annotated[float, Drawn(1, 300)] = Field(300.0, gt=0)
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

    In lockstep no emulated time passes meanwhile.
    """

    kind: Literal["emulator_restart"]


class RouterRestart(Infrastructure):
    """The separate router is ended and started again; agents are told first."""

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


AnyFault = Annotated[SerializeAsAny[Fault], PlainValidator(_validate)]
"""A fault of any kind, as the type of a scenario's key."""


def parse_fault(data: object) -> Fault:
    """Return the fault that plain data, as of JSON or TOML, describe. Raises ScenarioError in one line."""
    try:
        return _validate(data)
    except ValidationError as error:
        raise ScenarioError(f"fault: {first_problem(error, Fault)}") from None
