"""The families of faults: what all faults have in common, and what the kinds of one family do alike.

A kind of fault is one class in `emulator.scenario.faults` that derives from a family. The class is the only place
that says how the kind is called, which parameters it has, what the reference page says about it, how a campaign
draws it, and which law it follows. The layers above act on families:

| family | carried out by | judged by |
|---|---|---|
| `ProcessFault` | `drivers/emulation.py` | `checks/faults.py` |
| `cuts = True` | `radio/link_faults.py` | `checks/faults.py` |
| `LossFault`, `DelayFault` | `radio/link_faults.py` by the kind's law | `checks/faults.py`, `checks/latency.py` |
| `SenderFault` | `radio/sender_faults.py` | `checks/senders.py` |
| `OwnRule` | `radio/own_rules.py` | `checks/own_rules.py` |
| `GnssFault`, `ClockFault` | `world/gnss_faults.py` | `checks/senders.py`, `checks/fault_effects.py` |
| `Infrastructure` | `drivers/live/processes.py` | `checks/fault_effects.py` |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, get_args

from pydantic import Field, model_validator

from emulator.scenario.fault_draws import Chooser, Drawn
from emulator.scenario.program import Entry, split_file
from emulator.scenario.renamed import RENAMED_SELECTORS
from emulator.scenario.sections import Section
from vnet.errors import shown
from vnet.types import Array, Mask

Probability = Annotated[float, Field(ge=0, le=1)]
Point = tuple[float, float]
LONGEST_S = 86_400.0
"""No fault starts later or lasts longer: a day."""
DEFAULT_RULE = "rule"
"""Function of a file that is named as a rule without one."""


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
    at_s: float = Field(0.0, ge=0, le=LONGEST_S)
    """Start of the fault, in emulated time."""
    duration_s: float = Field(gt=0, le=LONGEST_S)
    """Length of the fault, in emulated time."""

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
            pair = get_args(cls.model_fields[name].annotation) == get_args(Point)
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

    duration_s: float = Field(0.001, gt=0, le=LONGEST_S)
    """Ignored."""
    down_s: float = Field(1.0, gt=0, le=60)
    """Time from the end to the new start (wall clock)."""
