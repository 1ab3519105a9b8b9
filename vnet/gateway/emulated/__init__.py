"""Python programs that `import zenoh`, unmodified, as vehicles on virtual time.

`main` is the program of a vehicle that runs others: they find a `zenoh` of the vehicle's own, whose sessions talk
by its radio, and `time`, `threading` and other modules on the emulated clock. docs/how-to/zenoh.md is the guide.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

from vnet.errors import ProgramError
from vnet.gateway import filled_in
from vnet.gateway.emulated.modules import ENDPOINT
from vnet.gateway.emulated.programs import run_program
from vnet.gateway.emulated.vehicle import Vehicle
from vnet.gateway.ros2 import Ros2
from vnet.node import Node
from vnet.runtime.own_asyncio import Task
from vnet.runtime.virtual_time import VirtualTimeLoop


async def main(node: Node) -> None:
    """Run the programs of a scenario with `program.kind = "zenoh"` until all have ended.

    `node.options` has their commands (`command`), `keys` that cross the radio, `query_s` and `liveliness_s`, and
    `ros2`: the options of `[radio.ros2]`.
    """
    loop = asyncio.get_running_loop()
    if not isinstance(loop, VirtualTimeLoop):
        raise ProgramError('vnet.gateway.emulated needs run.pacing = "lockstep": in real time Zenoh itself runs')
    commands: Sequence[Sequence[str]] = node.options["command"]
    topics: Mapping[str, Any] | None = node.options.get("ros2")
    ros2 = None if topics is None else Ros2(node.id, topics["inside"], topics["domain"])
    query_s, liveliness_s = (node.options.get(name, 1.0) for name in ("query_s", "liveliness_s"))
    vehicle = Vehicle(node, node.options.get("keys"), query_s, liveliness_s, ros2)
    clock = [] if topics is None else [vehicle.tell_clock(topics["clock_hz"])]
    background = [Task(each, loop=loop) for each in [*vehicle.tasks(), *clock]]
    try:
        async with asyncio.TaskGroup() as tasks:
            for words in commands:
                tasks.create_task(run_program(vehicle, filled_in(words, node.id, ENDPOINT)))
    except* Exception as errors:
        error = errors.exceptions[0]
        raise error.with_traceback(_of_program(error.__traceback__)) from None
    finally:
        for task in background:
            task.cancel()


def _of_program(trace: TracebackType | None) -> TracebackType | None:
    """Return what of a traceback is the program's, all of it if nothing is."""
    inner = trace
    while inner is not None and inner.tb_frame.f_globals.get("__name__", "").startswith("vnet."):
        inner = inner.tb_next
    return inner or trace
