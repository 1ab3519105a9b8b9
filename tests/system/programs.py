"""Vehicle programs that behave and misbehave, for whole runs: entries are `tests.system.programs:NAME`."""

import asyncio
import contextlib
import hashlib
import json
import os
import random
import signal
import sys
import time
import zlib
from collections.abc import AsyncGenerator
from pathlib import Path

import numpy as np

from vnet import Node


async def counts_its_starts(node: Node) -> None:
    """Keeps on its disk how often it was started, tells it, and says its turn in each period."""
    path = node.folder / "starts.txt"
    starts = int(path.read_text()) + 1 if path.exists() else 1
    path.write_text(str(starts))
    node.log(f"start {starts}")
    node.event("began", starts=starts)
    async for fix in node.gnss:
        await node.radio.broadcast(fix.time_ns.to_bytes(8, "big"))
        node.report(heard=len(node.radio.drain()))


async def only_waits(node: Node) -> None:
    """Speaks once, then only ever waits on the radio; what it hears it says again, up to three hops."""
    await node.radio.broadcast(b"")
    async for packet in node.radio:
        if len(packet.payload) < 3:
            await node.radio.broadcast(packet.payload + node.id[-1:].encode())
        node.report(heard_ns=packet.received_ns)


async def never_waits(node: Node) -> None:
    """Sleeps by its own timers, at its own pace, and looks at its packets only then."""
    while True:
        await asyncio.sleep(float(node.rng.uniform(0.05, 0.15)))
        heard = node.radio.drain()
        await node.radio.broadcast(len(heard).to_bytes(2, "big"))
        node.report(heard=len(heard), first_ns=heard[0].received_ns if heard else -1)


async def computes(node: Node) -> None:
    """Computes for a while in the loop's own thread: that costs wall-clock time and no emulated time."""
    async for fix in node.gnss:
        total = sum(i * i for i in range(2_000_000 if fix.time_ns == 500_000_000 else 10))
        await node.radio.broadcast(total.to_bytes(8, "big"))


async def uses_executor(node: Node) -> None:
    """Hands work to threads, several at once, whose results decide what it sends."""
    async for fix in node.gnss:
        sums = await asyncio.gather(*(asyncio.to_thread(zlib.crc32, bytes([i]) * 50_000) for i in range(4)))
        await node.radio.broadcast(repr((fix.time_ns, sums)).encode())


async def raises(node: Node) -> None:
    """One vehicle has a bug."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"x")
        if node.id == "v02" and fix.time_ns >= 500_000_000:
            raise RuntimeError("the battery is flat")


async def exits_early(node: Node) -> None:
    """One vehicle has done its work before the others."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"x")
        if node.id == "v02" and fix.time_ns >= 500_000_000:
            return


async def dies(node: Node) -> None:
    """One vehicle's process is killed in the middle of the run, or ends itself."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"x")
        if node.id == "v02" and fix.time_ns >= 500_000_000:
            print("v02 is about to be killed", flush=True)
            if node.options.get("exits"):
                os._exit(7)
            os.kill(os.getpid(), signal.SIGKILL)


async def spins(node: Node) -> None:
    """One vehicle does not let time advance."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"x")
        while node.id == "v02" and fix.time_ns >= 500_000_000:
            await asyncio.sleep(0)


async def hangs(node: Node) -> None:
    """One vehicle never comes back from a call."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"x")
        if node.id == "v02" and fix.time_ns >= 500_000_000:
            time.sleep(3600)


async def runs_long(node: Node) -> None:
    """Speaks at every fix; for runs that are ended from outside."""
    print(f"{node.id} is on its way", flush=True)
    async for _ in node.gnss:
        await node.radio.broadcast(b"x")


async def names_neighbours(node: Node) -> None:
    """Speaks at every fix, and prints each vehicle and incarnation that it hears, once for each second."""
    heard = set()
    async for _ in node.gnss:
        await node.radio.broadcast(bytes([node.incarnation]))
        for packet in node.radio.drain():
            line = f"heard {packet.sender}.{packet.payload[-1]} in second {packet.sent_ns // 1_000_000_000}"
            if line not in heard:
                heard.add(line)
                print(line, flush=True)


async def answering(node: Node) -> None:
    """Speaks at every fix, and answers at once, in seven bytes, what it hears of the vehicle before it.

    Answers say what its radio measures, and have a power and a bit rate of their own.
    """
    before = f"v{int(node.id[1:]) - 1:0{len(node.id) - 1}}"

    async def answer() -> None:
        async for packet in node.radio:
            if packet.sender == before and len(packet.payload) == 300:
                measured = repr((packet.rssi_dbm, packet.snr_db, node.radio.busy_ratio, packet.payload[:6]))
                said = hashlib.blake2b(measured.encode(), digest_size=6).digest()
                await node.radio.broadcast(said + b"!", power_dbm=15.0, rate_mbps=12.0)

    answers = asyncio.create_task(answer())
    async for fix in node.gnss:
        await node.radio.broadcast(fix.time_ns.to_bytes(6, "big") + bytes(294))
    await answers


async def describes_process(node: Node) -> None:
    """Prints what a program sees of its process, and random numbers that nobody has seeded."""
    seen = {
        "arguments": sys.argv[:-1],  # but for the number of a descriptor
        "main": Path(str(sys.modules["__main__"].__file__)).name,
        "environment": {name: value for name, value in os.environ.items() if name != "COLUMNS"},
        "folder": str(Path.cwd()),
        "path": sys.path,
        "flags": list(sys.flags),
        "signals": {str(number): str(signal.getsignal(number)) for number in signal.valid_signals()},
        "standard input": str(Path("/proc/self/fd/0").readlink()),
        "niceness": os.getpriority(os.PRIO_PROCESS, 0),
        "own group": os.getpgrp() == os.getpid(),
        "random": [random.random(), np.random.random()],  # noqa: NPY002  # the global generators are what is asked about
    }
    print(json.dumps(seen))
    await node.radio.broadcast(b"x")


async def ends_its_host(node: Node) -> None:
    """Speaks in each period; at one second the vehicle of the options kills its host, or cuts its link."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"here")
        if node.id == node.options["vehicle"] and fix.time_ns == 1_000_000_000:
            if node.options["how"] == "kills":
                os.kill(os.getppid(), signal.SIGKILL)
            else:
                os.system("ip link set eth0 down")


async def computes_for_ever(node: Node) -> None:
    """Never yields, from half a second on."""
    await asyncio.sleep(0.5)
    while True:
        pass


async def is_told_to_end_in_its_end(node: Node) -> None:
    """Wait in a generator whose end waits, too: who closes it raises another error."""

    async def ticks() -> AsyncGenerator[int, None]:
        try:
            while True:
                await asyncio.sleep(0.1)
                yield 1
        finally:
            await asyncio.sleep(0.1)

    async with contextlib.aclosing(ticks()) as each:
        async for _ in each:
            await node.radio.broadcast(b"here")
