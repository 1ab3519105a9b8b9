"""Vehicle programs whose process dies once the run is over: entries are `tests.system.dies_at_the_end:NAME`."""

import asyncio
import atexit
import os
import signal
import time
from collections.abc import Awaitable, Callable

from vnet import Node


def _ends_by(at_the_end: Callable[[], object]) -> Callable[[Node], Awaitable[None]]:
    """Return a program that ends the process of v02, once the run is over."""

    async def program(node: Node) -> None:
        failed = asyncio.create_task(_fails())
        try:
            async for _ in node.gnss:
                pass
        finally:
            assert failed.done()
            if node.id == "v02":
                at_the_end()

    return program


async def _fails() -> None:
    raise LookupError("nobody looks at this")


segfaults = _ends_by(lambda: os.kill(os.getpid(), signal.SIGSEGV))
exits_3 = _ends_by(lambda: os._exit(3))
exits_0 = _ends_by(lambda: os._exit(0))
exits_at_exit = _ends_by(lambda: atexit.register(os._exit, 1))
never_ends = _ends_by(lambda: time.sleep(3600))


async def handles_at_the_end(node: Node) -> None:
    """Awaits a failed task only when the run is over."""
    failed = asyncio.create_task(_fails())
    try:
        async for _ in node.gnss:
            pass
    finally:
        try:
            await failed
        except LookupError:
            node.log("handled")
