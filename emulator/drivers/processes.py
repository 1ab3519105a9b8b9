"""The programs of a run as the loops of both pacings see them, wherever they are, and the rules for what they say.

`Processes` is the one interface to programs. Those of a simulation are in the emulator's event loop (`local.py`) or
in processes forked from it; those of a live run are processes on this machine or on others (`live/`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

from emulator.drivers.emulation import ProcessActions
from vnet.errors import VnetError
from vnet.node import MOMENTS_OF_FAULTS
from vnet.runtime.arrivals import Mail
from vnet.transport import wire
from vnet.transport.wire import SentMessage


class Heard(NamedTuple):
    """A message of a process, and when it came on the monotonic clock, in ns, where that matters.

    In real time a `SentMessage` has come later than the frames that refer to it, and a `StackDump` after a restart.
    """

    process_id: str
    message: wire.Yield | wire.Frames | wire.StackDump | SentMessage
    arrived_ns: int = 0


class Processes(ABC):
    """Programs of a run in one or more processes; each process bears the id of its first node."""

    @abstractmethod
    async def act(self, actions: ProcessActions) -> None:
        """Do to programs what faults and trips do: stop or kill them, start them, pause them."""

    @abstractmethod
    def send(self, process_id: str, message: wire.Grant | wire.Batch, mail: Mail | None = None) -> None:
        """Give a process a window or a batch; `mail` has the packets and fixes of a window."""

    @abstractmethod
    async def receive(self, timeout_s: float = math.inf) -> Heard | None:
        """Return the next message of a process; None if something else has come up, or after the timeout.

        In lockstep there is no timeout: raises Stalled if no process that owes a yield makes progress.
        """

    def ended(self, among: Collection[str] | None = None) -> dict[str, dict[str, Any]]:
        """Return the processes that have ended without being told to, with details, and have not been returned yet.

        Of all, or `among` these.
        """
        return {}

    def returned(self) -> list[str]:
        """Return the processes that were started and have become ready since the last call (real time)."""
        return []

    def refuse(self, process_id: str, error: ProtocolError) -> None:
        """Refuse the last message of a process."""
        raise error


class Stalled(Exception):
    """The run cannot go on: it ends with verdict unknown. An event says what was awaited."""


class ProtocolError(VnetError):
    """A message that does not fit what its process was told, or speaks for others."""


def check_ownership(nodes: Sequence[str], *traffic: wire.Traffic, waiting: Sequence[str] = ()) -> None:
    """Raise ProtocolError if the traffic of the process of `nodes`, or its `waiting` nodes, are not its own."""
    own = frozenset(nodes)  # of a simulation a thousand, each of which is looked for several times
    for node in [*waiting, *(part.node for each in traffic for parts in _told(each) for part in parts)]:
        if node not in own:
            raise ProtocolError(f"the process of {nodes[0]} speaks for {node}, which is not its own")
    for action in (action for each in traffic for action in each.actions):
        if not action.is_sound:
            raise ProtocolError(f"{action.node} asks for an acceleration that is no number")
    for note in (note for each in traffic for note in each.notes):
        if note.kind == "event" and note.text in MOMENTS_OF_FAULTS:
            raise ProtocolError(f"{note.node} tells an event {note.text}, which is a name of vnet's own")


def _told(traffic: wire.Traffic) -> Sequence[Sequence[Any]]:
    sent = traffic.frames, traffic.messages, traffic.actions
    return *sent, traffic.reports, traffic.endings, traffic.unhandled, traffic.notes, traffic.deviations


def check_yield(nodes: Sequence[str], message: wire.Yield, granted_ns: int, end_ns: int, quiet_ns: int) -> None:
    """Raise ProtocolError if a yield of these nodes' process breaks its window, `granted_ns` to `end_ns`.

    Before `quiet_ns` it may have gone on, and have steps in advance.
    """
    passed_ns = max(end_ns, message.steps[-1].time_ns + 1) if message.steps else end_ns
    if message.next_timer_ns is not None and message.next_timer_ns < passed_ns:
        raise ProtocolError(
            f"yield {message.seq} of {nodes[0]}: its next timer, {message.next_timer_ns}, lies before the end "
            f"of its window or its last step, {passed_ns}"
        )
    earliest_ns = granted_ns
    for step in message.steps:
        if not earliest_ns <= step.time_ns < max(end_ns, quiet_ns):
            raise ProtocolError(
                f"yield {message.seq} of {nodes[0]}: a step at {step.time_ns}, where {earliest_ns} to "
                f"{max(end_ns, quiet_ns) - 1} are allowed"
            )
        earliest_ns = step.time_ns + 1
    waiting = [*message.waiting_radio, *message.waiting_gnss]
    check_ownership(nodes, *(step.traffic for step in message.steps), waiting=waiting)
