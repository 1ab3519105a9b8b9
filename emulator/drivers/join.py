"""Joining: which nodes have said hello, how they share processes, and who is refused.

Pure: it is given hellos and says what to answer. A node belongs to the process that its own hello named, and
only the holder of that hello's nonce speaks for it afterwards.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from vnet.transport import wire


@dataclass
class _Member:
    process_id: str
    nonce: bytes | None  # None: it is to join again
    pid: int
    host: str
    ready: bool = False


class Membership:
    """The nodes of a run and what they said when they joined.

    Those that come `later` need not have joined before they `enter`, and may. `alone`: each is its own process.
    """

    def __init__(self, node_ids: Sequence[str], later: Iterable[str] = (), alone: bool = False) -> None:
        self._node_ids = tuple(node_ids)
        self.later = set(later)
        self._alone = alone
        self._members = {node: _Member(node, None, 0, "") for node in self.later}
        self.closed = False
        self.ahead: set[str] = set()
        """Processes that pass through quiet instants beyond their windows."""

    def hello(self, key_node: str, hello: wire.Hello) -> str | None:
        """Take a hello that came on the key of `key_node`; returns why it is refused, or None."""
        if hello.node != key_node:
            return f"a hello on the key of {key_node} names {hello.node!r}"
        if key_node not in self._node_ids or hello.process_id not in self._node_ids:
            return f"{hello.node!r} is not a node of this run"
        if self._alone and hello.process_id != hello.node:
            return f"{hello.node}: vehicles enter and leave one by one: start an agent for each"
        member = self._members.get(hello.node)
        if member is not None and member.nonce not in (None, hello.nonce):
            return f"{hello.node} is already present"
        if member is None or member.nonce is None:
            if self.closed and (member is None or member.process_id != hello.process_id):
                return "the run has started"
            first = self._members.get(hello.process_id)
            if first is not None and first.nonce not in (None, hello.nonce):
                return f"{hello.process_id} belongs to another process"
            member = self._members[hello.node] = _Member(hello.process_id, hello.nonce, hello.pid, hello.host)
            (self.ahead.add if hello.ahead else self.ahead.discard)(hello.process_id)
        member.ready = member.ready or hello.ready
        return None

    def leave(self, node: str) -> None:
        """Forget a node that went away before the start."""
        self._members.pop(node, None)

    def enter(self, node: str) -> bool:
        """A node that was to come later is due; returns whether it is there already."""
        self.later.discard(node)
        return self._is_ready(node)

    def expect(self, nodes: Sequence[str]) -> None:
        """These nodes are to join again, from new processes."""
        for node in nodes:
            self._members[node].nonce = None
            self._members[node].ready = False

    @property
    def missing(self) -> list[str]:
        """Nodes that should be there and are not ready, or not of the process they named, in number order."""
        return [node for node in self._node_ids if node not in self.later and not self._is_ready(node)]

    def _is_ready(self, node: str) -> bool:
        member = self._members.get(node)
        if member is None or not member.ready:
            return False
        first = self._members.get(member.process_id)
        return first is not None and first.process_id == member.process_id and first.nonce == member.nonce

    @property
    def joined(self) -> list[str]:
        """Nodes that have said hello, or will later, in the order of their numbers."""
        return [node for node in self._node_ids if node in self._members]

    def speaks_for(self, process_id: str, nonce: bytes) -> bool:
        """Return whether a message on the `tx` of `process_id` with this nonce is its process's own."""
        member = self._members.get(process_id)
        return member is not None and member.nonce == nonce and member.process_id == process_id

    def is_of(self, node: str, nonce: bytes) -> bool:
        """Return whether the process of a node has this nonce."""
        member = self._members.get(node)
        return member is not None and member.nonce == nonce

    def nodes_with(self, process_id: str) -> list[str]:
        """Nodes of a process, its id first."""
        others = [
            node for node in self._node_ids if node != process_id and self._members[node].process_id == process_id
        ]
        return [process_id, *others]

    def process_of(self, node: str) -> str:
        """Id of a node's process."""
        return self._members[node].process_id

    def processes(self) -> list[list[str]]:
        """Nodes of each process, its id first, in the order of the ids' numbers."""
        assert not self.missing, self.missing
        groups = {node: [node] for node in self._node_ids if self._members[node].process_id == node}
        for node in self._node_ids:
            if node not in groups:
                groups[self._members[node].process_id].append(node)
        return list(groups.values())

    def describe(self, node: str) -> str:
        """Process id and host of a node's process, for messages."""
        member = self._members[node]
        return f"process {member.pid} on {member.host}"


def split_into_processes(node_ids: Sequence[str], nodes_per_process: int) -> list[list[str]]:
    """Consecutive nodes, `nodes_per_process` at a time: how the launcher and access rules group them."""
    return [
        list(node_ids[start : start + nodes_per_process]) for start in range(0, len(node_ids), nodes_per_process)
    ]
