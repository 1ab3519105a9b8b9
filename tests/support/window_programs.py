"""Vehicle programs for the tests of windows: they do something at instants that are close to each other."""

import asyncio
import hashlib

from vnet import Node
from vnet.units import NS_PER_S


class Diary:
    """Digest of what a program saw, in order, and when: a difference shows in all that it says afterwards."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._hash = hashlib.blake2b(digest_size=6)

    def note(self, *what: object) -> bytes:
        entry = (self._node.now_ns, asyncio.get_running_loop().time(), *what)
        self._hash.update(repr(entry).encode())
        return self._hash.digest()

    @property
    def number(self) -> float:
        return float(int.from_bytes(self._hash.digest(), "big"))


async def improvises(node: Node) -> None:
    """Answer packets, sleep for fractions of a millisecond, compute on threads, raise, and end at any time."""
    diary = Diary(node)
    filling = bytes(node.options.get("filling_bytes", 0))

    async def answers() -> None:
        while True:
            packet = await node.radio.receive()
            said = diary.note(
                "packet", packet.sender, packet.sent_ns, packet.received_ns, packet.payload, packet.snr_db
            )
            draw = node.rng.random()
            if node.backbone is not None and draw < 0.5:
                await node.backbone.broadcast(said)
            if draw < 0.2:
                await node.radio.broadcast(said + filling)
            elif draw < 0.3:
                node.event("answered", digest=diary.number)
            elif draw < 0.35:
                await asyncio.sleep(float(node.rng.uniform(0, 0.003)))
                diary.note("drained", [(p.sender, p.received_ns) for p in node.radio.drain()])
            elif draw < 0.37:
                await node.radio.broadcast(b"last words of " + said)
                return
            elif draw < 0.39:
                raise ValueError(f"{node.id} dislikes a packet at {node.now_ns}")

    async def looks_seldom() -> None:
        while True:
            await asyncio.sleep(float(node.rng.uniform(0.0001, 0.05)))
            heard = [(p.sender, p.sent_ns, p.received_ns, p.payload) for p in node.radio.drain()]
            said = diary.note("heard", heard, node.radio.busy_ratio)
            if node.rng.random() < 0.3:
                await node.radio.broadcast(said + bytes(int(node.rng.integers(0, 300))))

    async def listens_with_a_limit() -> None:
        while True:
            try:
                packet = await asyncio.wait_for(node.radio.receive(), float(node.rng.uniform(0.0002, 0.03)))
                diary.note("in time", packet.received_ns)
            except TimeoutError:
                diary.note("nothing")
                await asyncio.sleep(0.02)

    async def relays() -> None:
        assert node.backbone is not None
        async for message in node.backbone:
            said = diary.note("wire", message.sender, message.sent_ns, message.payload)
            await node.radio.broadcast(said + filling)

    async def locates() -> None:
        async for fix in node.gnss:
            said = diary.note("fix", fix.time_ns, fix.position_m.tolist())
            for _ in range(int(node.rng.integers(1, 4))):
                await node.radio.broadcast(said + filling)
            if node.rng.random() < 0.2:
                digest = await asyncio.get_running_loop().run_in_executor(None, hashlib.sha256, said)
                await node.radio.broadcast(digest.digest()[:8])
            node.report(fix.position_m, digest=diary.number)
            node.log(f"digest {diary.number:.0f}")

    def strike(number: int) -> None:
        """A timer of the loop's, without a task, that fires a few times within a millisecond."""
        diary.note("strike", number, node.radio.busy_ratio)
        asyncio.get_running_loop().call_later(0.0003 if number % 5 else 0.05, strike, number + 1)

    asyncio.get_running_loop().call_later(0.01, strike, 1)
    hear = {"awaits": answers, "polls": looks_seldom, "limits": listens_with_a_limit}
    names = list(hear)
    chosen = names[int(node.id.lstrip("vrsu")) % 3]
    life_s = float(node.rng.uniform(0.2, 3.0))
    async with asyncio.timeout(life_s if node.rng.random() < 0.3 else None):  # one in three crashes by TimeoutError
        more = [] if node.backbone is None else [relays()]
        tasks = [asyncio.create_task(each) for each in (hear[chosen](), locates(), *more)]
        ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        assert ended
        await tasks[1]


async def looks_as_it_begins(node: Node) -> None:
    """Tell of the packets that are there at the start; v01 sends one at 0.4955 s, v03 has a timer at 0.498 s."""
    node.log(f"{len(node.radio.drain())} packets")
    if node.id == "v01":
        await asyncio.sleep(0.4955)
        await node.radio.broadcast(bytes(1000))
    await asyncio.sleep(0.498 if node.id == "v03" else 10)
    await asyncio.sleep(10)


async def tells_of_its_mail(node: Node) -> None:
    """Await nothing but fixes; when it is ended, tell of the packets that it has by then."""
    try:
        async for fix in node.gnss:
            await node.radio.broadcast(fix.position_m.tobytes())
    finally:
        newest_ns = [packet.received_ns for packet in node.radio.drain()]
        node.log(f"{len(newest_ns)} packets at {node.now_ns / NS_PER_S:.6f} s, up to {max(newest_ns, default=0)}")


async def ticks(node: Node) -> None:
    """Neither send nor look for packets, but for v01, which sends; when ended, tell of the packets by then."""
    if node.id == "v01":
        await tells_of_its_mail(node)
    try:
        while True:
            await asyncio.sleep(0.013)
    finally:
        newest_ns = [packet.received_ns for packet in node.radio.drain()]
        node.log(f"{len(newest_ns)} packets at {node.now_ns / NS_PER_S:.6f} s, up to {max(newest_ns, default=0)}")


async def looks_once_a_period(node: Node) -> None:
    """Sleep some times after each fix, and speak meanwhile; then look for packets and send."""
    diary = Diary(node)
    async for fix in node.gnss:
        for nth in range(3):
            await asyncio.sleep(0.02)
            if nth == node.rng.integers(3):
                await node.radio.broadcast(bytes(nth))
        diary.note([(packet.sender, packet.received_ns) for packet in node.radio.drain()])
        await node.radio.broadcast(fix.position_m.tobytes())
        node.report(fix.position_m, digest=diary.number)


async def fails_unheard(node: Node) -> None:
    """Neither send nor look for packets; callbacks and programs fail or end between fixes."""

    def fails() -> None:
        raise LookupError(f"{node.id} in a callback")

    async for fix in node.gnss:
        await asyncio.sleep(0.03)
        asyncio.get_running_loop().call_later(0.005, fails)
        await asyncio.sleep(0.03)
        if fix.time_ns > 2 * NS_PER_S and node.id == "v01":
            raise KeyError("the end of a program")
        if fix.time_ns > 2 * NS_PER_S and node.id == "v02":
            raise SystemExit(0)


async def cancels_timers(node: Node) -> None:
    """Set timers and give them up, all at instants at which other tasks' timers are due."""

    async def given_up() -> None:
        while True:
            async with asyncio.timeout(0.1):
                await asyncio.sleep(0)
            await asyncio.sleep(0.1)

    async def ticks() -> None:
        while True:
            await asyncio.sleep(0.1)
            loser = asyncio.create_task(asyncio.sleep(0.1))
            await asyncio.sleep(0.05)
            await asyncio.sleep(0.05)
            loser.cancel()

    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(given_up())
        tasks.create_task(ticks())


async def races(node: Node) -> None:
    """Broadcast with each fix and fail if a packet and a timer of `after_s` come in the other order.

    Packets arrive 2 ms after the fixes, at 6 Mbit/s some µs later.
    """
    after_s = float(node.options["after_s"])
    while True:
        await node.gnss.receive()
        await node.radio.broadcast(b"here")
        timer = asyncio.create_task(asyncio.sleep(after_s))
        await node.radio.receive()
        assert timer.done() == (after_s < 0.002)


async def wakes_a_unit(node: Node) -> None:
    """The first unit says a word by wire and sends ten frames; the second sends one when the word arrives."""
    if node.backbone is None:
        return
    if node.id == "rsu01":
        await asyncio.sleep(0.1)
        await node.backbone.broadcast(b"go")
        await asyncio.sleep(0.0045)
        for _ in range(10):
            await node.radio.broadcast(bytes(300))
    else:
        await node.backbone.receive()
        await node.radio.broadcast(b"now")
