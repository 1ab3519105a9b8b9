"""Presence of vehicles and of their programs: one state a node, and nothing else.

Faults stop and start programs, vehicles enter and leave, and programs end by themselves. Pure: it is told what
happens, and says what follows.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum


class NodeState(StrEnum):
    """State of a node, from before its vehicle enters to the end of its program."""

    NEW = "new"
    """Its vehicle has not entered the network yet, and its program has never been started."""
    OUTSIDE = "outside"
    """Its vehicle has left the network, or was stopped before it had entered."""
    ENTERING = "entering"
    """Its vehicle enters; its program has been started and is not up yet."""
    UP = "up"
    """Its program runs."""
    DOWN = "down"
    """A fault has stopped its program."""
    RESTARTING = "restarting"
    """The fault is over; its program has been started again and is not up yet."""
    ENDED = "ended"
    """Its program has returned, crashed or died: it is not started again."""
    ENDED_OUTSIDE = "ended outside"
    """As ENDED, and its vehicle has left the network since."""


_S = NodeState
_STOPPED = {_S.UP: _S.DOWN, _S.RESTARTING: _S.DOWN, _S.ENTERING: _S.OUTSIDE}
"""State of a node after it is stopped, by its state before; nodes in other states cannot be stopped."""
_LEFT = {_S.DOWN: _S.OUTSIDE, _S.ENDED: _S.ENDED_OUTSIDE}
"""State of a node after its vehicle has left, by its state before. Its program is stopped first."""
_STARTED = {_S.NEW: _S.ENTERING, _S.OUTSIDE: _S.ENTERING, _S.DOWN: _S.RESTARTING}
"""State of a node after it is started, by its state before."""
_OUTSIDE = {_S.NEW, _S.OUTSIDE, _S.ENTERING, _S.ENDED_OUTSIDE}


@dataclass(frozen=True)
class Changes:
    """Nodes that are stopped, have left and are to be started, in the order of their numbers."""

    stopped: list[str]
    left: list[str]
    started: list[str]


class Presence:
    """The states of the nodes of a run. `up` and `incarnation` (starts before this one) are kept by node."""

    def __init__(self, node_ids: Sequence[str], absent: Collection[str] = ()) -> None:
        self._states = {node: _S.NEW if node in absent else _S.UP for node in node_ids}
        self.up = {node: node not in absent for node in node_ids}
        self.incarnation = dict.fromkeys(node_ids, 0)

    def state(self, node: str) -> NodeState:
        """State of a node."""
        return self._states[node]

    def is_outside(self, node: str) -> bool:
        """Return whether a vehicle is not in the network: it has not entered yet, or has left."""
        return self._states[node] in _OUTSIDE

    def _put(self, node: str, state: NodeState) -> None:
        self._states[node] = state
        self.up[node] = state is _S.UP

    def change(self, under_fault: Collection[str], absent: Collection[str]) -> Changes:
        """From now on faults stop the programs of these nodes, and these vehicles are not in the network."""
        down = {*under_fault, *absent}
        stopped = [node for node, state in self._states.items() if node in down and state in _STOPPED]
        for node in stopped:
            self._put(node, _STOPPED[self._states[node]])
        left = [node for node, state in self._states.items() if node in absent and state in _LEFT]
        for node in left:
            self._put(node, _LEFT[self._states[node]])
        started = [node for node, state in self._states.items() if node not in down and state in _STARTED]
        for node in started:
            self.incarnation[node] += self._states[node] is not _S.NEW
            self._put(node, _STARTED[self._states[node]])
        return Changes(stopped, left, started)

    def come_up(self, nodes: Iterable[str]) -> dict[str, bool]:
        """Those of the nodes that were started are up; returns them, and whether their vehicles enter with that."""
        entered = {
            node: self._states[node] is _S.ENTERING
            for node in nodes
            if self._states[node] in (_S.ENTERING, _S.RESTARTING)
        }
        for node in entered:
            self._put(node, _S.UP)
        return entered

    def end(self, node: str) -> bool:
        """A program has ended by itself; returns False if it was not up, and so had ended before."""
        if not self.up[node]:
            return False
        self._put(node, _S.ENDED)
        return True

    def has_ended(self, node: str) -> bool:
        """Return whether a program has ended by itself: it is not started again."""
        return self._states[node] in (_S.ENDED, _S.ENDED_OUTSIDE)
