"""Each vehicle sends its position to the next one, which acknowledges it; what is not acknowledged is sent again.

The bug: the timer starts a task that sends again, and the task takes it that the message is still in the table. If
the acknowledgement comes between the timer and the task, it is not: KeyError.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from itertools import count

from tests.hunt.programs.messages import parse, send
from vnet import Node

RING = ("v01", "v02", "v03")
RETRANSMISSION_S = 0.02
"""Time after which a message is sent again: twice the latency."""
MOST_TRIES = 4


@dataclass
class Unacknowledged:
    """A message that waits for its acknowledgement."""

    position_m: list[float]
    timer: asyncio.TimerHandle
    tries: int = 1


class Vehicle:
    """A vehicle with its unacknowledged messages by number."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._next = RING[(RING.index(node.id) + 1) % len(RING)]
        self._unacknowledged: dict[int, Unacknowledged] = {}
        self._sending: set[asyncio.Task[None]] = set()
        self._given_up = 0

    async def run(self) -> None:
        """Send positions until the run ends."""
        await asyncio.gather(self._receive(), self._send())

    async def _send(self) -> None:
        numbers = count(self._node.incarnation * 1000)
        async for fix in self._node.gnss:
            number, position_m = next(numbers), fix.position_m.tolist()
            self._unacknowledged[number] = Unacknowledged(position_m, self._start_timer(number))
            await send(self._node, "data", self._next, number, position_m)
            self._node.report(fix.position_m, unacknowledged=len(self._unacknowledged), given_up=self._given_up)

    def _start_timer(self, number: int) -> asyncio.TimerHandle:
        return asyncio.get_running_loop().call_later(RETRANSMISSION_S, self._expired, number)

    def _expired(self, number: int) -> None:
        task = asyncio.create_task(self._send_again(number))
        self._sending.add(task)
        task.add_done_callback(self._sending.discard)

    async def _send_again(self, number: int) -> None:
        message = self._unacknowledged[number]
        if message.tries == MOST_TRIES:
            del self._unacknowledged[number]
            self._given_up += 1
            return
        message.tries += 1
        message.timer = self._start_timer(number)
        await send(self._node, "data", self._next, number, message.position_m)

    async def _receive(self) -> None:
        async for packet in self._node.radio:
            kind, (addressee, number, *_) = parse(packet.payload)
            if addressee != self._node.id:
                continue
            if kind == "data":
                await send(self._node, "acknowledgement", packet.sender, number)
            elif (message := self._unacknowledged.pop(number, None)) is not None:
                message.timer.cancel()


class RepairedVehicle(Vehicle):
    """A vehicle that looks again before it sends again."""

    async def _send_again(self, number: int) -> None:
        if number in self._unacknowledged:
            await super()._send_again(number)


async def main(node: Node) -> None:
    """Send positions, with the bug."""
    await Vehicle(node).run()


async def repaired(node: Node) -> None:
    """Send positions."""
    await RepairedVehicle(node).run()
