"""Mailbox: what waits for a program to read it, packets of its radio or fixes of its receiver."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

T = TypeVar("T")

INBOX_LIMIT = 4096
"""Packets (or fixes) that are kept for a program that does not read them; beyond it the oldest are dropped."""


class Waits:
    """The number of tasks that wait at some mailboxes; those of a process that was killed count on."""

    count = 0


class Mailbox(Generic[T]):
    """A bounded queue with one side for the transport (`deliver`) and one for the program.

    `waiting` tells the transport that a task of the program waits here: only then does an arrival wake the node;
    otherwise the program finds the item when it next runs. `refill` is called before the program reads, so that a
    transport may leave items in its own buffer until then (real time).
    `guard` is called before that, and raises where the program may not read. `waits` counts the tasks that wait
    here, with those at others, so that a transport of many mailboxes need not ask each.
    """

    def __init__(self) -> None:
        self.refill: Callable[[], None] = lambda: None
        self.guard: Callable[[], None] = lambda: None
        self.waits = Waits()
        self._items: deque[T] = deque(maxlen=INBOX_LIMIT)
        self._waiters: deque[asyncio.Future[None]] = deque()

    @property
    def awaited(self) -> bool:
        """True if a task may be waiting here; may be read from another thread."""
        return bool(self._waiters)

    @property
    def waiting(self) -> bool:
        """True if a task waits for the next item."""
        for waiter in self._waiters:  # noqa: SIM110 (`any` costs six times as much)
            if not waiter.done():
                return True
        return False

    def deliver(self, items: Sequence[T]) -> None:
        """Append items and wake the waiting tasks."""
        self._items.extend(items)
        for waiter in self._waiters:
            if not waiter.done():
                waiter.set_result(None)

    async def get(self) -> T:
        """Remove and return the oldest item; wait for one if there is none. Cancelling it loses no item."""
        self.guard()
        self.refill()
        while not self._items:
            waiter = asyncio.get_running_loop().create_future()
            self._waiters.append(waiter)
            self.waits.count += 1
            try:
                self.refill()  # again: an item that came before the waiter was visible woke no task
                await waiter
            finally:
                self._waiters.remove(waiter)
                self.waits.count -= 1
        return self._items.popleft()

    def drain(self) -> list[T]:
        """Remove and return all items, oldest first, without waiting."""
        self.guard()
        self.refill()
        items = list(self._items)
        self._items.clear()
        return items
