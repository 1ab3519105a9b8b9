"""CPU time and wake-ups of each node on a loop that hosts several."""

import asyncio
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from vnet.runtime.asyncio_internals import NodeHandle
from vnet.runtime.ready_queue import CpuMeter


def handle_of(node: str | None, loop: asyncio.AbstractEventLoop) -> asyncio.Handle:
    """A callback of a node."""
    handle = NodeHandle(lambda: None, [], loop)
    handle.node = None if node is None else SimpleNamespace(id=node)
    return handle


def clock(*times_ns: int) -> Callable[[], int]:
    """A clock that shows these times, one after the other."""
    shown = iter(times_ns)
    return lambda: next(shown)


def test_time_belongs_to_the_node_whose_callback_runs() -> None:
    loop: Any = asyncio.new_event_loop()
    meter = CpuMeter(clock(100, 130, 150, 190, 200))
    for node in ("v01", "v02", None, "v02"):
        meter.begin(handle_of(node, loop))
    meter.end()
    meter.end()  # nothing runs any more, and the clock is not asked
    loop.close()
    assert meter.cpu_ns == {"v01": 30, "v02": 20 + 10}, "from 150 to 190 something of nobody's ran"


def test_a_wake_up_is_an_instant_at_which_a_node_runs() -> None:
    loop: Any = asyncio.new_event_loop()
    meter = CpuMeter(lambda: 0)
    for nodes in (["v01", "v01", "v02"], ["v01"], [None]):
        for node in nodes:
            meter.begin(handle_of(node, loop))
        meter.end()
        meter.end_instant()
    loop.close()
    assert meter.wake_ups == {"v01": 2, "v02": 1}
