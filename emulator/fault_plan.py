"""The plan of a run's faults: those that act at an instant, their nodes and links, and the next change.

The acting faults are always computed from the plan and the time, never by doing and undoing. So faults may overlap,
and end in any order, without leaving anything behind.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import count

import numpy as np
from numpy.typing import NDArray

from emulator.scenario import random_streams
from emulator.scenario.faults import Fault, LinkFault, NodeFault, Partition, ProcessFault, Selector, Swizzle
from emulator.scenario.network import node_id
from emulator.scenario.scenario import Scenario
from vnet.errors import ScenarioError, first_names
from vnet.types import Array, Mask
from vnet.units import NS_PER_S

MIN_DURATION_NS = 0.1
"""Duration in ns of a fault that was healed before it began: less than an instant, so that it does not act."""
Selection = tuple[Mask, Mask | None]
"""The nodes (N,) and the links (N, N) on which a fault acts."""


@dataclass(frozen=True)
class Nodes:
    """The input of selectors: ids, positions (N, 2) in metres, and the number of others in range (N,).

    A vehicle that is not in the network has position NaN and a negative degree.
    """

    ids: Sequence[str]
    position_m: Array
    degree: NDArray[np.intp]

    def numbers(self, ids: Sequence[str]) -> list[int]:
        """Return the numbers of nodes, by their ids or those of a file of trips, `flow#1` for `flow-23-1`.

        Raises ScenarioError for an id that no node has.
        """
        return [self._number(node) for node in ids]

    def _number(self, node: str) -> int:
        for known in (node, node_id(node)):
            if known in self.ids:
                return self.ids.index(known)
        raise ScenarioError(f"{node!r} is no vehicle of the network; they are {first_names(self.ids)}")


def select(selector: Selector, nodes: Nodes, rng: np.random.Generator) -> Mask:
    """Return the selected nodes (N,); `rng` draws what the selector leaves open. Raises ScenarioError."""
    count = len(nodes.ids)
    chosen = np.zeros(count, dtype=bool)
    if selector.ids is not None:
        chosen[nodes.numbers(selector.ids)] = True
    elif selector.fraction is not None:
        chosen[rng.permutation(count)[: max(1, round(selector.fraction * count))]] = True
    elif selector.count is not None:
        chosen[rng.permutation(count)[: selector.count]] = True
    elif selector.disc is not None:
        x, y, radius_m = selector.disc
        chosen = np.hypot(*(nodes.position_m - (x, y)).T) <= radius_m
    elif selector.polygon is not None:
        chosen = _inside(np.array(selector.polygon), nodes.position_m)
    elif selector.degree is not None:
        chosen = (selector.degree[0] <= nodes.degree) & (nodes.degree <= selector.degree[1])
    else:
        chosen[:] = True
    return chosen


def _inside(corner_m: Array, point_m: Array) -> Mask:
    """Mask of the points (N, 2) in a polygon (C, 2): a ray to the right crosses an odd number of its sides."""
    odd = np.zeros(len(point_m), dtype=bool)
    x, y = point_m.T
    for (x1, y1), (x2, y2) in zip(corner_m, np.roll(corner_m, -1, axis=0), strict=True):
        spans = (y1 > y) != (y2 > y)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            odd ^= spans & (x < x1 + (y - y1) * (x2 - x1) / (y2 - y1))
    return odd


def links_of(fault: LinkFault, nodes: Nodes, rng: np.random.Generator) -> Mask:
    """Return the links (N, N), rows are senders, on which a fault of links acts. Raises ScenarioError."""
    end = select(fault.nodes, nodes, rng)
    sender, receiver = select(fault.senders, nodes, rng), select(fault.receivers, nodes, rng)
    return (end[:, None] | end[None, :]) & sender[:, None] & receiver[None, :]


def partitioned_links(fault: Partition, nodes: Nodes, rng: np.random.Generator) -> Mask:
    """Return the links (N, N), rows are senders, that a partition cuts. Raises ScenarioError."""
    count = len(nodes.ids)
    if fault.groups == "ring":
        return _outside_majority(rng.permutation(count))
    group = np.zeros(count, dtype=int)
    if fault.groups == "halves":
        group[rng.permutation(count)[: count // 2]] = 1
    elif fault.groups == "one":
        group[rng.integers(count)] = 1
    else:
        for number, ids in enumerate(fault.groups, start=1):
            group[nodes.numbers(ids)] = number
    return np.asarray(group[:, None] != group[None, :])


def _outside_majority(order: NDArray[np.int64]) -> Mask:
    """Links to nodes from those outside their majority: themselves and the nearest on a ring in this `order`."""
    count = len(order)
    index = np.empty(count, dtype=int)
    index[order] = np.arange(count)
    ahead = (index[:, None] - index[None, :]) % count
    others = count // 2  # of a majority, without the node itself: half of them on either side, or one more ahead
    return np.asarray((ahead > (others + 1) // 2) & (count - ahead > others // 2))


@dataclass(frozen=True)
class PlannedFault:
    """A fault with its number in the plan, the time [start, end) in which it acts, and its nodes and links.

    `draws_of` is the number by which its random draws are keyed.

    `nodes` (N,) are those selected; `links` (N, N), rows are senders, those it acts on; None for faults of nodes.
    `moving` selects both again at each instant, where vehicles drive into a region and out of it.
    """

    number: int
    draws_of: int
    fault: Fault
    start_ns: int
    end_ns: int
    nodes: Mask
    links: Mask | None
    moving: Callable[[int], Selection] | None = None

    @property
    def label(self) -> str:
        """Its name in trace, events and commands, for example `partition-0`."""
        return f"{self.fault.title}-{self.number}"

    def acts_at(self, time_ns: int) -> bool:
        """Return whether the fault acts at this instant."""
        return self.start_ns <= time_ns < self.end_ns

    def acts_between(self, start_ns: int, end_ns: int) -> bool:
        """Return whether the fault acts at any instant in [start, end)."""
        return max(self.start_ns, start_ns) < min(self.end_ns, end_ns)

    def placed(self, time_ns: int) -> PlannedFault:
        """Return the fault with the nodes and links on which it acts at this instant."""
        if self.moving is None:
            return self
        nodes, links = self.moving(time_ns)
        return replace(self, nodes=nodes, links=links)


class FaultPlan:
    """All faults of a run, past and future. Raises ScenarioError if one does not fit.

    `nodes_at` returns the nodes in a period, if they move; else they stay as in `nodes`.
    """

    def __init__(self, scenario: Scenario, nodes: Nodes, nodes_at: Callable[[int], Nodes] | None = None) -> None:
        self._seed = scenario.run.seed
        self._healed_ns = round(scenario.healed_s * NS_PER_S)
        self._period_ns = scenario.period_ns
        self._nodes = nodes
        self._nodes_at = nodes_at
        self._groups = scenario.run.nodes_per_process
        self.faults: list[PlannedFault] = []
        for fault in scenario.fault:
            self.add(fault)

    def add(self, fault: Fault) -> PlannedFault:
        """Plan one more fault; it ends by the time the network must be at rest. Raises ScenarioError."""
        number = len(self.faults)
        drawn, taken = fault.draws_of, {each.draws_of: each for each in self.faults}
        if drawn is None:
            drawn = next(free for free in count(number) if free not in taken)
        elif drawn in taken:
            raise ScenarioError(f"{fault.title}-{number}: draws_of = {drawn}: {taken[drawn].label} has these draws")
        start_ns = round(fault.at_s * NS_PER_S)
        if start_ns >= self._healed_ns:
            limit_s = self._healed_ns / NS_PER_S
            raise ScenarioError(f"{fault.kind}: at_s = {fault.at_s:g}: must be less than {limit_s:g}")
        end_ns = min(start_ns + round(fault.duration_s * NS_PER_S), self._healed_ns)
        moving = None
        try:
            if self._nodes_at is None or not _selects_by_position(fault):
                nodes, links = _selection(fault, self._nodes, fault_stream(self._seed, drawn, "select"))
            else:
                moving = self._moving(fault, drawn, self._nodes_at)
                nodes, links = moving(start_ns)
        except ScenarioError as error:
            raise ScenarioError(f"{fault.title}-{number}: {error}") from None
        if not fault.follows_vehicles:
            moving = None
        planned = PlannedFault(number, drawn, fault, start_ns, end_ns, nodes, links, moving)
        self._refuse_parts_of_processes(planned)
        self.faults.append(planned)
        return planned

    def _moving(self, fault: Fault, draws_of: int, nodes_at: Callable[[int], Nodes]) -> Callable[[int], Selection]:
        """Return what gives the nodes and links of a fault at an instant; an answer holds for a whole period."""

        @lru_cache(1)
        def in_period(period: int) -> Selection:
            return _selection(fault, nodes_at(period), fault_stream(self._seed, draws_of, "select"))

        return lambda time_ns: in_period(time_ns // self._period_ns)

    def _refuse_parts_of_processes(self, planned: PlannedFault) -> None:
        """Raise ScenarioError for a fault of some nodes of a process: they start, pause and die together."""
        if not isinstance(planned.fault, ProcessFault):
            return
        for start in range(0, len(planned.nodes), self._groups):
            part = planned.nodes[start : start + self._groups]
            if part.any() and not part.all():
                ids = self._nodes.ids[start : start + self._groups]
                named = [node for node, chosen in zip(ids, part, strict=True) if chosen]
                others = [node for node, chosen in zip(ids, part, strict=True) if not chosen]
                raise ScenarioError(
                    f"{planned.label}: {', '.join(named)} shares a process with {', '.join(others)}: "
                    "name them all, or set run.nodes_per_process = 1"
                )

    def heal(self, label: str, time_ns: int) -> PlannedFault:
        """End a fault at `time_ns` at the latest; healing twice is harmless. Raises ScenarioError if unknown."""
        for number, planned in enumerate(self.faults):
            if planned.label == label:
                healed = replace(planned, end_ns=max(planned.start_ns, min(planned.end_ns, time_ns)))
                self.faults[number] = healed
                return healed
        known = ", ".join(planned.label for planned in self.faults) or "none"
        raise ScenarioError(f"no fault {label!r}; there are: {known}")

    @property
    def last_end_ns(self) -> int:
        """Time at which all faults of the plan have healed, in ns."""
        return max((max(planned.end_ns, planned.start_ns + 1) for planned in self.faults), default=0)

    def next_change_ns(self, after_ns: int) -> int | None:
        """Return the next instant at which a fault starts, ends, or may act on other nodes than before."""
        changes = [t for planned in self.faults for t in _changes(planned, self._seed) if t > after_ns]
        period_ns = (after_ns // self._period_ns + 1) * self._period_ns
        if any(planned.moving and planned.start_ns < period_ns < planned.end_ns for planned in self.faults):
            changes.append(period_ns)
        return min(changes, default=None)

    def active(self, time_ns: int) -> list[PlannedFault]:
        """Return the faults that act at this instant, with their nodes and links, by number."""
        return [planned.placed(time_ns) for planned in self.faults if planned.acts_at(time_ns)]

    def as_written(self) -> tuple[Fault, ...]:
        """Return the faults as a scenario states them, with their actual times."""
        return tuple(map(_as_written, self.faults))


def _as_written(planned: PlannedFault) -> Fault:
    lasting_ns = planned.end_ns - planned.start_ns or MIN_DURATION_NS  # healed before it began: it keeps its number
    update = {"at_s": planned.start_ns / NS_PER_S, "duration_s": lasting_ns / NS_PER_S}
    if isinstance(planned.fault, Swizzle):
        update["over_s"] = planned.fault.over_s or planned.fault.duration_s
    return planned.fault.model_copy(update=update)


def _selects_by_position(fault: Fault) -> bool:
    """Return whether a selector of the fault depends on positions."""
    selectors = (getattr(fault, name, None) for name in ("nodes", "senders", "receivers"))
    return any(selector is not None and selector.by_position for selector in selectors)


def _selection(fault: Fault, nodes: Nodes, rng: np.random.Generator) -> Selection:
    if isinstance(fault, Partition):
        severed = partitioned_links(fault, nodes, rng)
        return _ends(severed), severed
    if isinstance(fault, LinkFault):
        links = links_of(fault, nodes, rng)
        return _ends(links), links
    if isinstance(fault, NodeFault):
        return select(fault.nodes, nodes, rng), None
    return np.ones(len(nodes.ids), dtype=bool), None


def _ends(links: Mask) -> Mask:
    """The nodes (N,) at either end of a link (N, N)."""
    return np.asarray(links.any(axis=0) | links.any(axis=1))


def fault_stream(seed: int, draws_of: int, what: str) -> np.random.Generator:
    """Return the random stream of one fault of the plan, named by what it decides."""
    return random_streams.stream(seed, f"fault {draws_of} {what}")


def swizzle_times_ns(planned: PlannedFault, seed: int) -> list[tuple[int, int, int]]:
    """Return (node, cut off at, back at) of each node of a swizzle: off in the first half, back in the second."""
    assert isinstance(planned.fault, Swizzle)
    chosen = np.flatnonzero(planned.nodes)
    rng = fault_stream(seed, planned.draws_of, "swizzle")
    half_ns = round((planned.fault.over_s or planned.fault.duration_s) * NS_PER_S) // 2
    step_ns = half_ns // max(1, len(chosen))
    back = dict(zip(rng.permutation(chosen).tolist(), range(len(chosen)), strict=True))
    return [
        (node, planned.start_ns + index * step_ns, planned.start_ns + half_ns + (back[node] + 1) * step_ns)
        for index, node in enumerate(rng.permutation(chosen).tolist())
    ]


def _changes(planned: PlannedFault, seed: int) -> Iterator[int]:
    yield planned.start_ns
    yield planned.end_ns
    if isinstance(planned.fault, Swizzle):
        for _, off_ns, back_ns in swizzle_times_ns(planned, seed):
            yield min(off_ns, planned.end_ns)
            yield min(back_ns, planned.end_ns)
