"""An agent's attachment: what comes from the emulator is taken as it is meant, and anything else is dropped."""

import asyncio
import queue
import time
from contextlib import ExitStack, nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

from agents import host
from agents.host import UNSEEN_NS, Attachment, Found, Lost, _RealTimeAgent
from tests.support.multi_loop_driver import emulation_of, scenario_of
from vnet.errors import TransportError
from vnet.transport import wire
from vnet.transport.wire import MessageRef, WireSendResult


def attachment() -> Attachment:
    """The attachment of v01, to a session that does nothing."""
    declare = SimpleNamespace(
        declare_token=lambda *a: nullcontext(), declare_subscriber=lambda *a, **k: nullcontext()
    )
    session: Any = SimpleNamespace(
        declare_publisher=lambda *a, **k: nullcontext(),
        declare_subscriber=declare.declare_subscriber,
        liveliness=lambda: declare,
    )
    return Attachment(session, "run", ["v01"], ExitStack())


@pytest.mark.parametrize("data", [b"\xc1", b"", b"\x93\xa5Grant\xa1x", b"\x91\xa9Nonsense1", b"\x81\x01\x02"])
def test_malformed_messages_are_dropped_counted_and_logged_once(
    data: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    attached = attachment()
    grant = wire.Grant(0, 7, 8, [], [], [], next_fixes=[], busy=[], results=[], messages=[])
    for message in (data, data, wire.encode(grant)):
        attached.inbox.put((message, 0))
    assert attached.next_message() == grant
    (first,) = capsys.readouterr().err.splitlines()
    assert first.startswith("vnet-agent: v01: a message of the emulator is dropped: ")
    attached.write_total()
    assert capsys.readouterr().err == "vnet-agent: v01: malformed messages dropped: 2\n"


def test_where_nothing_was_dropped_nothing_is_said_of_it(capsys: pytest.CaptureFixture[str]) -> None:
    attachment().write_total()
    assert capsys.readouterr().err == ""


def test_an_emulator_of_another_version_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    attached = attachment()
    monkeypatch.setattr(attached, "say_hello", lambda: None)
    lanes = [[0.0, 0.0], [0.0], 0.85]
    welcome = wire.Welcome("v01", attached.nonce, 0, "lockstep", "x:y", {}, lanes, 1, 10**8, 1400, 5.0, 1000, "")
    attached.inbox.put((wire.encode(welcome), 0))
    with pytest.raises(TransportError, match=r"emulator speaks version 1 of the messages, this agent version 2"):
        attached.join(5.0)


def test_in_real_time_a_result_wakes_the_program_that_awaits_it() -> None:
    """Other batches wait until the program asks for them, or for a second."""
    welcome = emulation_of(scenario_of((), "agents.beacon:main", radio={"mac": {}})).welcome("v01", b"n")
    said: list[Any] = []
    attached: Any = SimpleNamespace(nonce=b"n", say=said.append, publish=said.append)
    attached.inbox, attached.units = queue.SimpleQueue(), None
    attached.decode = lambda item: wire.decode_rx(item[0])

    async def awaits_a_result() -> None:
        agent = _RealTimeAgent(attached, [welcome], {}, None)
        agent._loop, agent._started = asyncio.get_running_loop(), True  # type: ignore[assignment]
        result = wire.encode(wire.Batch([], 0, [], results=[WireSendResult("v01", 0, 1, True, 2)]))
        agent._wake(result)
        assert not agent._wake_pending
        sending = asyncio.create_task(agent._host.nodes["v01"].radio.send("v02", b"x"))
        await asyncio.sleep(0)
        attached.inbox.put((result, 0))
        agent._wake(result)
        assert agent._wake_pending
        assert await sending == (True, 2)
        sending = asyncio.create_task(agent._host.nodes["v01"].radio.send("v02", b"x"))
        await asyncio.sleep(0)
        agent._flush()
        *_, frames = [message for message in said if isinstance(message, wire.Frames) and message.traffic.frames]
        attached.inbox.put((wire.encode(wire.Batch([], 1, [], lost=[(frames.seq + 1, frames.seq + 9)])), 0))
        agent._drain()
        assert not sending.done()
        attached.inbox.put((wire.encode(wire.Batch([], 2, [], lost=[(frames.seq, frames.seq)])), 0))
        agent._drain()
        assert await sending == (False, 0)

    asyncio.run(awaits_a_result())


def test_in_real_time_the_end_of_a_program_is_said_again_if_its_message_is_lost() -> None:
    """And what it has told and left unhandled; its frames are lost with the message."""
    welcome = emulation_of(scenario_of((), "agents.beacon:main")).welcome("v01", b"n")
    said: list[Any] = []
    attached: Any = SimpleNamespace(nonce=b"n", say=said.append, publish=said.append, units=None)

    async def crashes() -> None:
        agent = _RealTimeAgent(attached, [welcome], {}, None)
        agent._loop = asyncio.get_running_loop()  # type: ignore[assignment]
        node = agent._host.nodes["v01"]
        await node.radio.broadcast(b"x")
        node.event("seen")
        agent._flush()
        agent._host.end("v01", "crashed", "ValueError: boom")
        agent._flush()
        for number in range(3):
            agent._take(wire.Batch([], number, [], lost=[(0, min(number, 1))]), 0)
            agent._flush()
        agent._flush(final=True)  # nobody would say any more that it is lost

    asyncio.run(crashes())
    parts = [each.traffic for each in said if isinstance(each, wire.Frames) and each.traffic]
    told = [(len(each.frames), len(each.notes), [ending.error for ending in each.endings]) for each in parts]
    end = (0, 0, ["ValueError: boom"])
    assert told == [(1, 1, []), end, (0, 1, []), end, end]


def test_in_real_time_an_agent_speaks_as_soon_as_the_emulator_is_back_and_says_how_much_it_has_sent() -> None:
    """It may have been paused: the emulator waits for it."""
    welcome = emulation_of(scenario_of((), "agents.beacon:main")).welcome("v01", b"n")
    attached, said = attachment(), list[Any]()
    attached._publishers = {"v01": SimpleNamespace(put=lambda data: said.append(wire.decode_tx(data)))}  # type: ignore[dict-item]
    sample: Any = SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: wire.encode(wire.StackRequest())))

    async def loses_the_emulator() -> None:
        agent = _RealTimeAgent(attached, [welcome], {}, None)
        agent._loop, agent._started = asyncio.get_running_loop(), True  # type: ignore[assignment]
        for state in (Lost, Found):
            attached.inbox.put(state)
        agent._drain()
        await asyncio.sleep(0)
        attached._on_rx(sample)

    asyncio.run(loses_the_emulator())
    frames, answer = said
    assert (frames.seq, answer.seq) == (0, 1)


def test_a_message_of_the_backbone_that_has_come_while_the_program_computed_is_not_asked_for_again() -> None:
    welcome = emulation_of(scenario_of((), "agents.beacon:main")).welcome("v01", b"n")
    there: list[MessageRef] = []
    said: list[Any] = []

    def take(refs: list[MessageRef]) -> tuple[list[Any], list[MessageRef]]:
        return [], [ref for ref in refs if ref not in there]

    attached: Any = SimpleNamespace(nonce=b"n", say=said.append, publish=said.append)
    attached.units = SimpleNamespace(take=take)
    agent = _RealTimeAgent(attached, [welcome], {}, None)
    agent._loop = SimpleNamespace()  # type: ignore[assignment]
    batch = wire.Batch([], 0, [], messages=[MessageRef("v01", 0), MessageRef("v01", 1)])
    agent._take(batch, time.monotonic_ns() - UNSEEN_NS)
    there.append(MessageRef("v01", 0))
    agent._flush()
    assert said[0].unseen == [MessageRef("v01", 1)]


@pytest.mark.parametrize(
    ("origin_s", "namespace", "is_shared"),
    [(-0.05, "", True), (500.0, "", False), (-100.0, "", False), (-0.05, "time:[5]", False)],
    ids=["the same clock", "one that is ahead", "one that is behind", "one of another time namespace"],
)
def test_a_vehicle_begins_with_batch_0_where_the_emulator_s_clock_is_not_its_own(
    origin_s: float, namespace: str, is_shared: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    welcome = emulation_of(scenario_of((), "agents.beacon:main")).welcome("v01", b"n")
    if namespace:
        monkeypatch.setattr("os.readlink", lambda path: namespace)
    attached: Any = SimpleNamespace(nonce=b"n", units=None, hello_ns=time.monotonic_ns() - 10**9)
    agent = _RealTimeAgent(attached, [welcome], {}, None)
    starts_s: list[float] = []
    loop = SimpleNamespace(origin_ns=0, call_later=lambda delay_s, *_: starts_s.append(delay_s))
    agent._loop = loop  # type: ignore[assignment]
    arrived_ns = time.monotonic_ns()
    batch = wire.Batch([], 0, [], origin_ns=arrived_ns + round(origin_s * 1e9))
    agent._take(batch, arrived_ns)
    assert loop.origin_ns == (batch.origin_ns if is_shared else arrived_ns + wire.HEAD_START_NS)
    assert starts_s[0] <= wire.HEAD_START_NS / 1e9


def test_a_program_may_put_emulated_time_in_place_of_the_machines(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("monotonic", "monotonic_ns"):
        monkeypatch.setattr(time, name, lambda: 0)
        assert vars(host)[name]() > 0
