"""The inbox: from Zenoh's threads to the loop, in order, by the type of the message, or refused."""

import asyncio
import threading
from typing import Any

import pytest

from emulator.drivers.live.inbox import Inbox, Refusals
from emulator.drivers.processes import ProtocolError
from tests.emulator.drivers.live.fakes import Stage, hello
from vnet.transport import wire


class Post:
    """An inbox, and all that comes out of it."""

    def __init__(self) -> None:
        self.stage = Stage()
        self.stage.join()
        self.came: list[Any] = []
        self.refusals = Refusals("run", self.stage.emulation.folder, lambda: 5)
        self.inbox = Inbox(
            self.stage.members,
            self.refusals,
            self.stage.changes,
            on_disconnected=lambda node: self.came.append(("gone", node)),
            on_query=lambda verb, query: self.came.append((verb, query)),
        )
        self.inbox.handlers[wire.Yield] = self.take
        self.inbox.handlers[wire.Hello] = self.take

    def take(self, node: str, message: Any) -> None:
        if isinstance(message, wire.Yield) and message.seq == 13:
            raise ProtocolError("no yield is owed")
        self.came.append((node, getattr(message, "seq", "hello")))

    async def settle(self) -> None:
        for _ in range(3):
            await asyncio.sleep(0)

    @property
    def refused(self) -> list[tuple[str | None, str]]:
        events = self.stage.emulation.folder.events
        return [(event.node, event.details["reason"]) for event in events if event.kind == "refused"]


def yield_of(seq: int, nonce: bytes = b"1") -> bytes:
    return wire.encode(wire.Yield(nonce, seq, None, (), (), (), 1))


def test_what_threads_put_comes_out_on_the_loop_in_order() -> None:
    async def run() -> None:
        post = Post()
        loop_thread = threading.current_thread()
        threads = set()

        def take(node: str, message: Any) -> None:
            threads.add(threading.current_thread())
            post.take(node, message)

        post.inbox.handlers[wire.Yield] = take

        def zenoh() -> None:
            for seq in range(5):
                post.inbox.put_message("v01", yield_of(seq))
            post.inbox.put_token("v02", True)
            post.inbox.put_token("v02", False)
            post.inbox.put_query("status", "a query")  # type: ignore[arg-type]

        await asyncio.to_thread(zenoh)
        await post.settle()
        assert threads == {loop_thread}
        assert post.came == [*(("v01", seq) for seq in range(5)), ("gone", "v02"), ("status", "a query")]

    asyncio.run(run())


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (yield_of(0, b"of another"), "a message without the nonce of its process"),
        (yield_of(13), "no yield is owed"),
        (wire.encode(wire.Frames(b"1", 0, 0, [], wire.Traffic())), "an unexpected Frames"),
        (b"\xc1 no message", "12 bytes are not a message"),
        (b"", "0 bytes are not a message"),
    ],
)
def test_what_cannot_be_taken_is_refused_and_the_rest_goes_on(payload: bytes, reason: str) -> None:
    async def run() -> None:
        post = Post()
        post.inbox.put_message("v01", payload)
        post.inbox.put_message("v01", yield_of(1))
        await post.settle()
        assert post.came == [("v01", 1)]
        ((node, said),) = post.refused
        assert node == "v01" and said.startswith(reason)

    asyncio.run(run())


def test_a_hello_needs_no_nonce_that_is_known() -> None:
    async def run() -> None:
        post = Post()
        post.inbox.put_message("v09", wire.encode(hello("v09", nonce=b"new")))
        await post.settle()
        assert post.came == [("v09", "hello")] and post.refused == []

    asyncio.run(run())


def test_of_each_key_the_first_refusal_is_logged_and_all_are_counted() -> None:
    async def run() -> None:
        post = Post()
        for node in ("v01", "v02", "v01", "v01"):
            post.inbox.put_message(node, b"nonsense")
        await post.settle()
        assert [node for node, _ in post.refused] == ["v01", "v02"]
        post.refusals.write_totals()
        events = post.stage.emulation.folder.events
        totals = {e.details["key"]: e.details["count"] for e in events if e.kind == "refused_total"}
        assert sorted(totals.values()) == [1, 3]

    asyncio.run(run())


def test_stacks_and_connections_are_kept() -> None:
    async def run() -> None:
        post = Post()
        post.inbox.put_message("v02", wire.encode(wire.StackDump(b"1", "in main")))
        post.inbox.put_token("v01", True)
        post.inbox.put_token("v02", True)
        post.inbox.put_token("v01", False)
        await post.settle()
        assert post.inbox.stacks == {"v02": wire.StackDump(b"1", "in main", None)}
        assert post.inbox.connected == {"v02"}

    asyncio.run(run())


def test_once_closed_nothing_is_handled_any_more() -> None:
    async def run() -> None:
        post = Post()
        post.inbox.put_message("v01", yield_of(0))
        post.inbox.close()
        post.inbox.put_message("v01", yield_of(1))
        await post.settle()
        assert post.came == []

    asyncio.run(run())
