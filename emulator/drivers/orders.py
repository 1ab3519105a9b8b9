"""In which order simultaneous events come in a run: what nodes are told of it, the medium's part, the tape.

With `run.order = "fifo"` and no tape there is nothing to do: nodes decide nothing, and frames of one instant come
to the medium in the order of the nodes.
"""

from __future__ import annotations

import hashlib
import random
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from emulator.records.tape import MediumOrder, TapeEntry, first_left, parse_tape, read_tape
from emulator.scenario.scenario import Scenario
from vnet.transport.wire import Deviation, Order


class Orders:
    """The orders of a run; see the module's text. `made` has its deviations from FIFO so far, its tape."""

    def __init__(self, scenario: Scenario) -> None:
        run = scenario.run
        self._run = run
        self.tape: Sequence[TapeEntry] = _tape_of(run.tape)
        self.explores = run.order != "fifo" or run.tape is not None or run.order_slack_us > 0
        """True if another order than FIFO is possible, or compared with what is possible."""
        self._at_medium = {entry.time_ns: entry.medium for entry in self.tape if isinstance(entry, MediumOrder)}
        self.made: list[TapeEntry] = []
        self.steps: Mapping[str, int] = {}
        """Decisions of each node, once the run has been simulated."""

    def of_node(self, node: str, incarnation: int) -> Order | None:
        """Return what the welcome of a node says of orders."""
        run = self._run
        if not self.explores:
            return None
        slack_ns, phase_ns = run.order_grid
        if run.order == "fifo":
            tape = [each for each in self.tape if isinstance(each, Deviation)]
            tape = [each for each in tape if (each.node, each.incarnation) == (node, incarnation)]
            return Order("tape", tape=tape, slack_ns=slack_ns, phase_ns=phase_ns)
        seed = self._seed(f"{node}/{incarnation}")
        return Order(run.order, seed, run.order_depth, run.order_steps or 0, (), slack_ns, phase_ns)

    def _seed(self, of: str) -> int:
        """Return a seed that says nothing about the scenario's."""
        digest = hashlib.sha256(f"vnet order/{self._run.seed}/{self._run.order_seed}/{of}".encode()).digest()
        return int.from_bytes(digest[:7], "big")

    def to_medium(self, time_ns: int, nodes: Sequence[str]) -> Sequence[str]:
        """Return the order in which the frames of `nodes`, given in FIFO's order, come to the medium."""
        if not self.explores or len(nodes) < 2:
            return nodes
        ordered = self._ordered(time_ns, nodes)
        if ordered != list(nodes):
            self.made.append(MediumOrder(time_ns, tuple(ordered)))
        return ordered

    def _ordered(self, time_ns: int, nodes: Sequence[str]) -> list[str]:
        if self._run.order == "shuffle":
            ordered = list(nodes)
            random.Random(self._seed(f"medium/{time_ns}")).shuffle(ordered)
            return ordered
        if self._run.order == "pct":
            return sorted(nodes, key=lambda node: self._seed(f"medium/{node}"))
        place = {node: number for number, node in enumerate(self._at_medium.get(time_ns, ()))}
        return sorted(nodes, key=lambda node: place.get(node, len(place)))

    def take(self, deviations: Iterable[Deviation]) -> None:
        """Note what nodes have decided otherwise than FIFO."""
        if self.explores:
            self.made.extend(deviations)

    def in_order(self) -> list[TapeEntry]:
        """Return the tape of the run, in the order of time, which does not depend on processes."""
        return sorted(self.made, key=_sort_key)

    def left(self) -> TapeEntry | None:
        """Return the first entry of the given tape that the run could not follow."""
        return first_left(self.tape, self.made)


def _tape_of(tape: Path | Sequence[str] | None) -> Sequence[TapeEntry]:
    if tape is None:
        return ()
    return read_tape(tape) if isinstance(tape, Path) else parse_tape(tape, "run.tape")


def _sort_key(entry: TapeEntry) -> tuple[int, str, int]:
    if isinstance(entry, MediumOrder):
        return entry.time_ns, "", 0
    return entry.time_ns, entry.node, entry.decision
