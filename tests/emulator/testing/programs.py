"""Programs with planted mistakes, for campaigns and tests to find."""

import asyncio
import ctypes
import os
import signal
import time

from vnet import Node

PERIOD_NS = 100_000_000


async def impatient(node: Node) -> None:
    """A beacon that crashes when it finds that it was paused."""
    last_ns = node.now_ns
    while True:
        await asyncio.sleep(0.1)
        await node.radio.broadcast(b"here")
        if node.now_ns - last_ns > 2 * PERIOD_NS:
            raise RuntimeError("where has the time gone?")
        last_ns = node.now_ns


async def proud(node: Node) -> None:
    """A beacon that reports a number that is none when it hears nobody for half a second."""
    heard_ns = 0
    async for fix in node.gnss:
        await node.radio.broadcast(b"here")
        if node.radio.drain():
            heard_ns = node.now_ns
        alone = node.now_ns - heard_ns > 5 * PERIOD_NS
        node.report((float("nan"), 0.0) if alone else fix.position_m, fix.covariance_m2)


async def busy(node: Node) -> None:
    """A beacon whose first vehicle presses Ctrl-C for a process after 0.5 s, and then never yields again."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"here")
        if fix.time_ns == 5 * PERIOD_NS and node.id == "v01":
            os.kill(node.options["pid"], signal.SIGINT)
            time.sleep(node.options["sleeps_s"])
            while True:
                pass


async def spinning(node: Node) -> None:
    """A beacon whose first vehicle never lets time advance from 0.5 s on."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"here")
        while fix.time_ns == 5 * PERIOD_NS and node.id == "v01":
            await asyncio.sleep(0)


async def faulty(node: Node) -> None:
    """A beacon whose first two vehicles address memory that is not there."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"here")
        if fix.time_ns == 5 * PERIOD_NS and node.id in ("v01", "v02"):
            ctypes.string_at(0)


async def interrupts(node: Node) -> None:
    """A beacon whose first vehicle interrupts the run, as Ctrl-C does."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"here")
        if fix.time_ns == 5 * PERIOD_NS and node.id == "v01":
            os.kill(os.getpid(), signal.SIGINT)


async def faulty_in_company(node: Node) -> None:
    """A beacon whose first vehicle ends its process if that is another's, too."""
    company.append(node.id)
    async for _ in node.gnss:
        await node.radio.broadcast(b"here")
        if node.id == "v01" and len(company) > 1:
            os.abort()


company: list[str] = []


async def stubborn(node: Node) -> None:
    """A beacon that hangs for good when it is restarted."""
    while node.incarnation:
        pass
    async for _ in node.gnss:
        await node.radio.broadcast(b"here")


async def growing(node: Node) -> None:
    """A beacon whose estimate is four times as far off with every fix."""
    estimate_m = 1.0
    async for fix in node.gnss:
        await node.radio.broadcast(b"here")
        estimate_m *= 4
        node.report((estimate_m, 0.0), fix.covariance_m2)


async def tells_before_it_measures(node: Node) -> None:
    """Measure and tell with the same period, and rely on measuring first: true in FIFO order alone."""
    measured = 0

    async def measure() -> None:
        nonlocal measured
        while True:
            await asyncio.sleep(0.1)
            measured += 1

    async def tell() -> None:
        told = 0
        while True:
            await asyncio.sleep(0.1)
            told += 1
            assert measured >= told, "nothing new was measured"
            await node.radio.broadcast(bytes([told]))

    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(measure())
        tasks.create_task(tell())


async def northerner(node: Node) -> None:
    """A beacon that crashes south-east of a diagonal: whether it does depends on the seed of the network alone."""
    async for fix in node.gnss:
        assert fix.position_m[1] > fix.position_m[0], "too far south-east"
        await node.radio.broadcast(b"here")


async def sends_a_set(node: Node) -> None:
    """Send in the order of a set of objects, which is that of their addresses."""
    async for _ in node.gnss:
        first, second = object(), object()
        for each in {first, second}:
            await node.radio.broadcast(b"1" if each is first else b"2")


async def counts_far(node: Node) -> None:
    """Report an estimate that is right, and a middle that is a large number."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"here")
        node.report(fix.position_m, fix.covariance_m2, middle_m=[1e12, 1e12])
