"""Python programs that `import zenoh`, unmodified, as vehicles on virtual time.

`main` is the program of a vehicle that runs others: they find a `zenoh` of the vehicle's own, whose sessions talk
by its radio, and `time`, `threading` and other modules on the emulated clock. docs/how-to/zenoh.md is the guide.
"""

from __future__ import annotations

import asyncio
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import zenoh

from vnet import extras
from vnet.errors import ProgramError, shown
from vnet.node import Node
from vnet.runtime.own_asyncio import Task
from vnet.runtime.virtual_time import VirtualTimeLoop

PYTHON = ("python", "python3")
"""First words of a command that can run here."""


@dataclass(frozen=True)
class Options:
    """Options of a vehicle: its `commands`, the `keys` that cross the radio, the time that replies are awaited."""

    commands: tuple[tuple[str, ...], ...]
    keys: tuple[str, ...]
    query_s: float

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Options:
        """Return checked options. Raises ProgramError in one line."""
        given = dict(options)
        command, keys = given.pop("command", []), given.pop("keys", ["**", "**/@adv/**"])
        query_s = given.pop("query_s", 1.0)
        if given:
            raise ProgramError(f"program.options.{next(iter(given))}: allowed are command, keys and query_s")
        several = isinstance(command, list) and all(isinstance(words, list) for words in command)
        commands = tuple(_texts("command", words) for words in (command if several else [command]))
        for words in commands:
            if len(words) < 2 or words[0] not in PYTHON:
                raise ProgramError(
                    f"program.options.command = {shown(shlex.join(words))}: on virtual time a command is "
                    "python SCRIPT … or python -m MODULE …"
                )
        keys = _texts("keys", keys)
        for key in keys:
            try:
                zenoh.KeyExpr(key)
            except zenoh.ZError:
                raise ProgramError(f"program.options.keys: {shown(key)} is no key expression of Zenoh") from None
        for one, other in combinations(keys, 2):  # a sample of both would be sent twice
            if zenoh.KeyExpr(one).intersects(other):
                raise ProgramError(f"program.options.keys: {shown(one)} and {shown(other)} overlap")
        if not isinstance(query_s, int | float) or not 0 < query_s <= 3600:
            raise ProgramError(f"program.options.query_s = {shown(query_s)}: seconds above 0, at most 3600")
        return cls(commands, keys, query_s)


def _texts(name: str, given: object) -> tuple[str, ...]:
    """Return one text or a list of texts as a tuple. Raises ProgramError for anything else."""
    texts = given if isinstance(given, list | tuple) else [given]
    if not all(isinstance(text, str) for text in texts):
        raise ProgramError(f"program.options.{name} = {shown(given)}: a text or a list of texts is expected")
    return tuple(texts)


async def main(node: Node) -> None:
    """Run the programs of `program.options.command`, until all have ended."""
    extras.require("a Zenoh program on virtual time", "greenlet", error=ProgramError)
    from vnet.gateway.emulated.programs import run_program
    from vnet.gateway.emulated.vehicle import Vehicle

    loop = asyncio.get_running_loop()
    if not isinstance(loop, VirtualTimeLoop):
        raise ProgramError('vnet.gateway.emulated needs run.pacing = "lockstep": in real time Zenoh itself runs')
    options = Options.of(node.options)
    vehicle = Vehicle(node, options.keys, options.query_s)
    background = [Task(each, loop=loop) for each in vehicle.tasks()]
    programs = [[word.replace("{id}", node.id) for word in words] for words in options.commands]
    try:
        if len(programs) == 1:
            await run_program(vehicle, programs[0])
        else:
            async with asyncio.TaskGroup() as tasks:
                for words in programs:
                    tasks.create_task(run_program(vehicle, words))
    finally:
        for task in background:
            task.cancel()
