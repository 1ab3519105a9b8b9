"""Vehicle programs whose process dies once the run is over: entries are `tests.system.dies_at_the_end:NAME`."""

import asyncio
import atexit
import os
import signal
import time
from collections.abc import Callable

from vnet import Node


async def _runs(node: Node, at_the_end: Callable[[], object]) -> None:
    failed = asyncio.create_task(_fails())
    try:
        async for _ in node.gnss:
            pass
    finally:
        assert failed.done()
        if node.id == "v02":
            at_the_end()


async def _fails() -> None:
    raise LookupError("nobody looks at this")


async def segfaults(node: Node) -> None:
    """Ends its process by SIGSEGV, in v02."""
    await _runs(node, lambda: os.kill(os.getpid(), signal.SIGSEGV))


async def exits_3(node: Node) -> None:
    """Ends its process with status 3, in v02."""
    await _runs(node, lambda: os._exit(3))


async def exits_0(node: Node) -> None:
    """Ends its process with status 0, in v02."""
    await _runs(node, lambda: os._exit(0))


async def exits_at_exit(node: Node) -> None:
    """Ends its process as the interpreter ends, in v02."""
    await _runs(node, lambda: atexit.register(os._exit, 1))


async def never_ends(node: Node) -> None:
    """Sleeps for ever, in v02."""

    await _runs(node, lambda: time.sleep(3600))


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
