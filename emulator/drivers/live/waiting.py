"""Waiting within a live run: the signal that its state has changed, and the error when nothing comes."""

from __future__ import annotations

import asyncio


class Stalled(Exception):
    """The run cannot go on: it ends with verdict unknown. An event says what was awaited."""


class ChangeSignal:
    """Wakes the task that waits for a change. For use on the run's event loop, by one waiting task."""

    def __init__(self) -> None:
        self._changed = asyncio.Event()

    def set(self) -> None:
        """Say that something has changed."""
        self._changed.set()

    async def wait(self, timeout_s: float) -> bool:
        """Wait for the next change; False if none came in time."""
        self._changed.clear()
        try:
            async with asyncio.timeout(max(timeout_s, 0)):
                await self._changed.wait()
        except TimeoutError:
            return False
        return True
