"""In which order a node is shown what happens to it at one instant: FIFO, or another that a machine can show.

Packets, a fix, timers and results of executor jobs that come at the same instant come in a fixed order in virtual
time (FIFO). On a machine each may be a little earlier or later, and the event loop may have run callbacks in
between. At each *decision* one of these is next: one of the events that are due, or the round itself ("go on").
A `Chooser` makes a node's decisions; it knows nothing of other nodes, so the division of nodes into processes does
not matter. What differs from FIFO is a *deviation*, and the deviations of a run are its *tape*.

PCT: Burckhardt, Kothari, Musuvathi and Nagarakatte, "A randomized scheduler with probabilistic guarantees of
finding bugs", ASPLOS 2010.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from vnet.transport.orders import Deviation, Order

GO_ON = "go on"
"""The choice to run what is ready before anything else happens."""


@dataclass(frozen=True, slots=True)
class Option:
    """An option of a decision: `label` names it among the others, `source` is what it belongs to."""

    label: str
    source: str


class Chooser(Protocol):
    """Interface of what makes the decisions of one node."""

    def choose(self, time_ns: int, decision: int, options: Sequence[Option]) -> int:
        """Return the number of the option that comes next; 0 is FIFO's. `decision` counts from 0 each instant."""
        ...


class Shuffle:
    """Any option, each as likely as the others."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)

    def choose(self, time_ns: int, decision: int, options: Sequence[Option]) -> int:
        """Draw an option."""
        return int(self._random.random() * len(options))


class Pct:
    """The option whose source has the highest priority, where `depth` - 1 times the highest becomes the lowest.

    A source is a task, the radio, the receiver or a job. Priorities are drawn when a source is first seen, and the
    decisions at which one falls among the first `steps`. A bug that `depth` events in the right order show is found
    with a probability of at least 1 / (sources · steps^(depth - 1)).
    """

    def __init__(self, seed: int, depth: int, steps: int) -> None:
        self._random = random.Random(seed)
        self._priority: dict[str, float] = {}
        self._falls = {self._random.randrange(max(steps, 1)): number for number in range(1, depth)}
        self._step = 0

    def choose(self, time_ns: int, decision: int, options: Sequence[Option]) -> int:
        """Take the highest priority, after it has fallen if this is the decision for it."""
        for option in options:
            if option.source not in self._priority:
                self._priority[option.source] = self._random.random()
        fall = self._falls.get(self._step)
        self._step += 1
        if fall is not None:
            self._priority[options[self._highest(options)].source] = -float(fall)
        return self._highest(options)

    def _highest(self, options: Sequence[Option]) -> int:
        return max(range(len(options)), key=lambda number: (self._priority[options[number].source], -number))


class Taped:
    """FIFO but for the deviations of a tape, as far as they fit: an option of that label at that decision."""

    def __init__(self, tape: Sequence[Deviation]) -> None:
        self._labels = {(each.time_ns, each.decision): each.label for each in tape}

    def choose(self, time_ns: int, decision: int, options: Sequence[Option]) -> int:
        """Return what the tape says for this decision, else FIFO's choice."""
        label = self._labels.get((time_ns, decision))
        return next((number for number, option in enumerate(options) if option.label == label), 0)


def chooser_of(order: Order) -> Chooser:
    """Return what makes the decisions of a node whose welcome has this order."""
    if order.kind == "shuffle":
        return Shuffle(order.seed)
    if order.kind == "pct":
        return Pct(order.seed, order.depth, order.steps)
    return Taped(order.tape)
