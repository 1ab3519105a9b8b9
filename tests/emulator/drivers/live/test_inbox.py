"""Messages from Zenoh's threads: they come to the run's loop, in order, by their type, or are refused."""

import asyncio
import threading
from typing import Any

import pytest

from emulator.drivers.processes import Heard
from tests.emulator.drivers.live.fakes import Stage, hello, joined, on_a_loop
from vnet.transport import wire


class Post:
    """Programs in lockstep of which each owes a yield, and all that comes of them."""

    def __init__(self) -> None:
        self.stage = Stage()
        self.stage.join(begin=False)
        self.live = self.stage.live
        self.live.begin(self.stage.members.processes(), lambda: 5)
        for node in ("v01", "v02", "v03"):
            self.live.send(node, wire.Grant(0, 0, 1))

    def hear(self, node: str, payload: bytes) -> None:
        self.live.hear("message", node, payload)

    async def settle(self) -> None:
        for _ in range(3):
            await asyncio.sleep(0)

    async def came(self) -> list[tuple[str, int]]:
        heard = []
        while (each := await self.live.receive(0.0)) is not None:
            assert isinstance(each, Heard) and isinstance(each.message, wire.Yield)
            heard.append((each.process_id, each.message.seq))
        return heard

    @property
    def refused(self) -> list[tuple[str | None, str]]:
        events = self.stage.emulation.folder.events
        return [(event.node, event.details["reason"]) for event in events if event.kind == "refused"]


def yield_of(seq: int, nonce: bytes = b"1") -> bytes:
    return wire.encode(wire.Yield(nonce, seq, None, (), (), (), 1))


@on_a_loop
async def test_what_threads_put_comes_out_on_the_loop_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    post = Post()
    loop_thread = threading.current_thread()
    taken: list[tuple[str, Any]] = []
    take = post.live.take

    def noting(what: str, name: str, item: Any) -> None:
        taken.append((what, threading.current_thread()))
        take(what, name, item)

    monkeypatch.setattr(post.live, "take", noting)

    def zenoh() -> None:
        for node in ("v03", "v01", "v02"):
            post.hear(node, yield_of(0))
        post.live.hear("token", "v02", True)
        post.live.hear("token", "v02", False)
        post.live.hear("query", "status", "a query")

    await asyncio.to_thread(zenoh)
    await post.settle()
    assert taken == [(w, loop_thread) for w in ("message", "message", "message", "token", "token", "query")]
    assert await post.came() == [("v03", 0), ("v01", 0), ("v02", 0)]
    assert post.stage.queries == [("status", "a query")]


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (yield_of(0, b"of another"), "a message without the nonce of its process"),
        (wire.encode(wire.Frames(b"1", 0, 0, [], wire.Traffic())), "an unexpected Frames"),
        (b"\xc1 no message", "12 bytes are not a message"),
        (b"", "0 bytes are not a message"),
    ],
)
@on_a_loop
async def test_what_cannot_be_taken_is_refused_and_the_rest_goes_on(payload: bytes, reason: str) -> None:
    post = Post()
    post.hear("v01", payload)
    post.hear("v01", yield_of(0))
    await post.settle()
    assert await post.came() == [("v01", 0)]
    ((node, said),) = post.refused
    assert node == "v01" and said.startswith(reason)


@on_a_loop
async def test_who_comes_back_after_its_death_is_told_that_the_run_goes_on_without_it() -> None:
    stage = joined(pacing="realtime")
    stage.launcher.dies(stage.supervisor, "v01")
    for node, said in (("v01", "was here and has gone"), ("v02", "is already present")):
        stage.live.take("message", node, wire.encode(hello(node, nonce=b"2")))
        (_, end) = stage.attachment.sent.pop()
        assert isinstance(end, wire.End) and end.refused and said in end.reason


@on_a_loop
async def test_who_is_told_that_the_run_does_not_begin_may_answer() -> None:
    stage = Stage(pacing="realtime")
    for node in ("v01", "v02"):
        stage.hello(node, b"1")
    stage.live.tell_to_end()
    stage.live.take("message", "v01", wire.encode(wire.Frames(b"1", 0, 0, [], wire.Traffic(), final=True)))
    assert list(stage.emulation.folder.events) == []


@on_a_loop
async def test_a_yield_of_another_window_is_refused_as_it_comes_and_so_is_a_second_one() -> None:
    post = Post()
    for seq in (7, 0, 0):
        post.hear("v01", yield_of(seq))
    await post.settle()
    assert await post.came() == [("v01", 0)]
    assert [reason for _, reason in post.refused] == ["yield 7 of v01: expected 0"]  # the first of each key
    post.live.write_refused()
    (total,) = [e.details["count"] for e in post.stage.emulation.folder.events if e.kind == "refused_total"]
    assert total == 2


@on_a_loop
async def test_a_hello_needs_no_nonce_that_is_known() -> None:
    post = Post()
    post.hear("v09", wire.encode(hello("v09", nonce=b"new")))
    await post.settle()
    assert post.refused == [("v09", "'v09' is not a node of this run")]


@on_a_loop
async def test_of_each_key_the_first_refusal_is_logged_and_all_are_counted() -> None:
    post = Post()
    for node in ("v01", "v02", "v01", "v01"):
        post.hear(node, b"nonsense")
    await post.settle()
    assert [node for node, _ in post.refused] == ["v01", "v02"]
    post.live.write_refused()
    events = post.stage.emulation.folder.events
    totals = {e.details["key"]: e.details["count"] for e in events if e.kind == "refused_total"}
    assert sorted(totals.values()) == [1, 3]


@on_a_loop
async def test_connections_are_kept() -> None:
    post = Post()
    for node, alive in (("v01", True), ("v02", True), ("v01", False)):
        post.live.hear("token", node, alive)
    await post.settle()
    assert post.live.connected == {"v02"}


@on_a_loop
async def test_once_closed_nothing_is_handled_any_more() -> None:
    post = Post()
    post.hear("v01", yield_of(0))
    post.live.close()
    post.hear("v02", yield_of(0))
    await post.settle()
    assert await post.came() == []


@on_a_loop
async def test_an_exception_of_a_callback_ends_the_run() -> None:
    stage = joined(pacing="realtime")
    stage.live.begin(stage.members.processes(), lambda: 0)
    stage.live.hear("message", "v01", None)  # which no transport gives
    with pytest.raises(TypeError):
        await stage.live.receive(60.0)


@pytest.mark.parametrize("version", [1, wire.VERSION + 1])
@on_a_loop
async def test_an_agent_of_another_version_is_refused_in_one_line(version: int) -> None:
    stage = Stage()
    stage.live.take("message", "v01", wire.encode(hello("v01", version=version)))
    reason = (
        f"the agent speaks version {version} of the messages, this emulator version {wire.VERSION}: "
        "use the same version of vnet"
    )
    assert stage.attachment.sent == [("v01", wire.End(b"1", reason, refused=True))]
    assert [(e.kind, e.details["reason"]) for e in stage.emulation.folder.events] == [("refused", reason)]
    stage.live.take("message", "v01", wire.encode(hello("v01", ready=False)))
    ((_, welcome),) = stage.attachment.sent[1:]
    assert isinstance(welcome, wire.Welcome) and welcome.version == wire.VERSION
