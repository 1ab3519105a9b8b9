"""The bundles of a host: what its agents say, and when it is put on the way to the emulator.

Pure: it knows no transport and no process. In lockstep the emulator waits for all that it has granted, so the
yields of a host can wait for each other; everything else must not wait.
"""

from __future__ import annotations

from collections.abc import Collection

from emulator.drivers.hosts.messages import FromNode, FromUnit, Item
from vnet.transport import wire

FULL_BYTES = 8 * 2**20
"""Bytes of agents' messages after which a bundle goes at once, so that none comes near the largest message."""


class Relay:
    """Items for the emulator in the order in which they came, and the processes that owe a yield."""

    def __init__(self) -> None:
        self._items: list[Item] = []
        self._size_bytes = 0
        self._is_urgent = False
        self._awaited: set[str] = set()

    def granted(self, process_id: str) -> None:
        """Note that a process owes a yield."""
        self._awaited.add(process_id)

    def ended(self, process_id: str) -> None:
        """Note that a process owes nothing any more."""
        self._awaited.discard(process_id)

    def hurry(self) -> None:
        """Let what there is go at once: the emulator waits for more than yields."""
        self._is_urgent = True

    def take(self, node: str, payload: bytes) -> None:
        """Take a message of an agent, which is on the `tx` of `node`; yields are on that of their process."""
        self._items.append(FromNode(node, payload))
        self._size_bytes += len(payload)
        if wire.is_yield(payload):
            self._awaited.discard(node)
        else:
            self._is_urgent = True

    def take_unit(self, unit: str, payload: bytes) -> None:
        """Take a message of a unit on its key of the backbone: it waits for the yield that refers to it."""
        self._items.append(FromUnit(unit, payload))
        self._size_bytes += len(payload)

    def add(self, item: Item) -> None:
        """Take news of the host itself, which goes at once."""
        self._items.append(item)
        self._is_urgent = True

    @property
    def awaited(self) -> Collection[str]:
        """The processes that owe a yield."""
        return self._awaited

    def take_bundle(self) -> list[Item]:
        """Return what is to go now: nothing while all that there is are yields, and one is owed."""
        is_due = self._is_urgent or not self._awaited or self._size_bytes >= FULL_BYTES
        if not is_due:
            return []
        bundle, self._items, self._size_bytes, self._is_urgent = self._items, [], 0, False
        return bundle
