"""The nodes and links on which a fault acts, from the positions of the vehicles and the run's seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.scenario.faults import LinkFault, Partition, Selector
from emulator.scenario.network import node_id
from vnet.errors import ScenarioError, first_names
from vnet.types import Array, Mask


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
