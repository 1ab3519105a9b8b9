"""Hosts as the emulator sees them: one bundle for each and barrier, who is let in, and what their ends mean."""

import asyncio
import signal
from typing import Any

import pytest

from emulator.drivers.hosts import messages
from emulator.drivers.hosts.messages import Call, Calls, HostHello, HostRefusal, HostWelcome
from emulator.drivers.launch import Exit
from emulator.drivers.live.fleet import ANSWER_PATIENCE_S, Fleet
from emulator.drivers.live.supervisor import DEATH_GRACE_S, ChangeSignal
from emulator.records.code_digest import vnet_digest
from tests.emulator.drivers.live.fakes import in_virtual_time, on_a_loop
from tests.support.multi_loop_driver import emulation_of, scenario_of
from vnet.errors import VnetError
from vnet.transport import wire
from vnet.transport.access import Access

PROCESSES = [["v01", "v02"], ["v03"], ["v04"]]
GRANT = wire.Grant(0, 0, 1)


def hello(host: str, nonce: bytes = b"1", **more: Any) -> bytes:
    """An encoded hello of a host."""
    values = {"host": host, "nonce": nonce, "pid": 7, "machine": "there", "digest": vnet_digest(), **more}
    return messages.encode(HostHello(**values))


class Play:
    """A fleet of the hosts a (v01 and v02 in one process) and b (v03, v04), and all that comes out of it."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, Any]] = []
        self.came: list[Any] = []
        self.access = Access.create("r", PROCESSES, hosts=["a", "b"])
        self.emulation = emulation_of(scenario_of([], "agents.beacon:main"))
        self.fleet = Fleet(
            self.access,
            self.emulation,
            lambda host, payload: self.sent.append((host, messages.decode_to_host(payload))),
            self.tell,
            lambda: 5,
            lambda: False,
            ChangeSignal(),
        )

    def tell(self, what: str, name: str, item: Any) -> None:
        self.came.append((list(item), name) if what == "lost" else (name, item))

    def join(self) -> None:
        """Both hosts join, and all processes are started."""
        for host in ("a", "b"):
            self.fleet.take(host, hello(host))
            self.fleet.take(host, hello(host, ready=True))
        self.fleet.start_agents("", self.access, PROCESSES)

    def news(self, host: str, *items: Call, nonce: bytes = b"1") -> None:
        self.fleet.take(host, messages.encode(Calls(nonce, items)))

    async def bundles(self) -> list[tuple[str, list[Any]]]:
        """The bundles sent since the last call, after some turns of the loop; each bundle by its host."""
        for _ in range(3):
            await asyncio.sleep(0)
        sent, self.sent = self.sent, []
        return [(host, list(message.calls)) for host, message in sent if isinstance(message, Calls)]

    @property
    def refused(self) -> list[str]:
        return [event.details["reason"] for event in self.emulation.folder.events if event.kind == "refused"]


async def joined() -> Play:
    """A play whose hosts have joined, and have all that this sends."""
    play = Play()
    play.join()
    await play.bundles()
    return play


def test_the_processes_are_shared_in_the_order_of_their_numbers() -> None:
    access = Access.create("r", [[f"v{number:02}"] for number in range(1, 8)], hosts=["x", "y", "z"])
    assert [len(share) for share in access.hosts.values()] == [2, 2, 3]
    assert [process_id for share in access.hosts.values() for process_id in share] == [
        nodes[0] for nodes in access.processes
    ]


@on_a_loop
async def test_grants_of_a_barrier_are_one_bundle_a_host() -> None:
    play = await joined()
    for process_id in ("v01", "v03", "v04"):
        play.fleet.send(process_id, GRANT)
    grants = {node: ("to_node", node, wire.encode(GRANT), True) for node in ("v01", "v03", "v04")}
    assert await play.bundles() == [("a", [grants["v01"]]), ("b", [grants["v03"], grants["v04"]])]
    play.fleet.send("v03", wire.StackRequest())
    assert await play.bundles() == [("b", [("to_node", "v03", wire.encode(wire.StackRequest()), False)])]


@on_a_loop
async def test_agents_are_started_once_all_hosts_are_there() -> None:
    play = Play()
    play.fleet.take("a", hello("a"))
    assert not play.fleet.is_prepared() and play.fleet.missing == ["host a", "host b"]
    ((host, welcome),) = play.sent
    assert host == "a" and isinstance(welcome, HostWelcome)
    assert welcome.processes == [["v01", "v02"]]
    play.join()
    assert play.fleet.is_prepared() and play.fleet.missing == []
    starts = await play.bundles()
    assert starts == [("a", [("start", ["v01"], [1], 0)]), ("b", [("start", ["v03", "v04"], [2, 3], 0)])]


@on_a_loop
async def test_a_host_that_cannot_start_agents_says_why() -> None:
    play = Play()
    play.fleet.take("b", hello("b", failure="no module named x"))
    with pytest.raises(VnetError, match="host b: no module named x"):
        play.fleet.is_prepared()


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (hello("a", b"2"), "host a is already present (process 7 on there)"),
        (hello("a", digest="0123456789abcdef"), "its vnet is not that of the emulator (0123456789a…"),
        (hello("b"), "a hello of 'b'"),
        (b"nonsense", "8 bytes are not a message"),
        (messages.encode(Calls(b"2", [("message", "v01", b"x")])), "a message without the nonce of its host"),
        (messages.encode(Calls(b"1", [("message", "v03", b"x")])), "'v03' is not on host a"),
        (messages.encode(Calls(b"1", [("token", "v04", True)])), "'v04' is not on host a"),
        (messages.encode(Calls(b"1", [("ended", "v03", 2, 0, "", None)])), "'v03' is not on host a"),
    ],
)
@on_a_loop
async def test_what_a_host_may_not_say_is_refused(payload: bytes, reason: str) -> None:
    play = await joined()
    play.fleet.take("a", payload)
    assert play.came == []
    assert [said[: len(reason)] for said in play.refused] == [reason]
    if reason.startswith(("host a is", "its vnet")):
        assert isinstance(play.sent[-1][1], HostRefusal)


@on_a_loop
async def test_one_wrong_item_does_not_take_the_others_with_it() -> None:
    play = await joined()
    play.news("a", ("message", "v01", b"1"), ("message", "v03", b"2"), ("message", "v02", b"3"))
    assert play.came == [("v01", b"1"), ("v02", b"3")]


@on_a_loop
async def test_the_end_of_a_process_that_has_been_replaced_is_old_news() -> None:
    play = await joined()
    play.fleet.kill("v03")
    play.fleet.start_agents("", play.access, [["v03"]])
    play.news("b", ("ended", "v03", 2, -9, "", None))
    assert play.came == [] and play.fleet.pids["v03"] == 4
    play.news("b", ("ended", "v03", 4, 1, "its last line", None))
    assert play.came == [("v03", Exit(1, "its last line"))]
    assert "v03" not in play.fleet.pids
    assert await play.bundles() == [("b", [("kill", "v03"), ("start", ["v03"], [4], 0)])]


@on_a_loop
async def test_nothing_is_said_to_a_process_that_is_not_there() -> None:
    play = await joined()
    play.fleet.detach("v04")(1.0)
    await play.bundles()
    play.fleet.kill("v04")
    play.fleet.signal("v04", signal.SIGSTOP)
    assert await play.bundles() == []


@in_virtual_time
async def test_a_host_that_is_gone_takes_its_processes_along() -> None:
    play = await joined()
    play.fleet.take_token("b", False)
    assert play.came == [], "its last messages may still arrive"
    await asyncio.sleep(DEATH_GRACE_S + 0.1)
    lost = (["v03", "v04"], "the connection of host b closed")
    assert play.came == [("v03", False), ("v04", False), lost]
    assert list(play.fleet.pids) == ["v01"]
    play.fleet.take("b", hello("b", b"2"))
    assert "the run goes on without it" in play.refused[0]
    play.fleet.send("v03", GRANT)
    assert await play.bundles() == []
    play.came.clear()
    play.fleet.start_agents("", play.access, [["v03"]])  # a fault heals
    await asyncio.sleep(0)
    assert play.came[-1] == (["v03"], "the connection of host b closed")


@in_virtual_time
async def test_the_end_waits_for_what_is_handed_in_and_not_for_the_silent() -> None:
    play = await joined()
    ending = asyncio.ensure_future(play.fleet.hand_in(1.0))
    assert [host for host, _ in await play.bundles()] == ["a", "b"]
    play.news("a", ("handing_in",))
    await asyncio.sleep(4 * ANSWER_PATIENCE_S)  # on a machine that is busy
    assert not ending.done()
    play.news("a", ("handed_in",))
    play.fleet.take_token("a", False)
    await ending
    silent = [event for event in play.emulation.folder.events if event.kind == "host_silent"]
    assert [event.details["host"] for event in silent] == ["b"]
    assert [orders for _, orders in await play.bundles()] == [[("leave",)], [("leave",)]]
