"""Hosting programs on a loop: mailboxes, endings, and programs that misbehave."""

import asyncio
import io
import logging
import logging.config
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from decimal import Decimal, getcontext
from queue import Queue
from typing import Any, Self

import numpy as np
import pytest

from vnet import Node
from vnet.errors import PayloadTooLargeError, ProgramError
from vnet.radio import INBOX_LIMIT, Mailbox, Packet
from vnet.roads.lanes import LaneMap
from vnet.runtime.arrivals import Window
from vnet.runtime.host import Host
from vnet.runtime.programs import Program, load_program
from vnet.runtime.virtual_time import VirtualTimeLoop
from vnet.transport import wire

LANES = LaneMap(np.array([[0.0, 0.0]]), np.array([0.0]), 0.85)
LAST_NS = 10_000_000_000


class Over(Exception):
    """The end of the emulated time of these tests."""


def welcome(node: str, seed: int = 1) -> wire.Welcome:
    return wire.Welcome(
        node, b"n", 0, "lockstep", "x:y", {}, LANES.to_wire(), seed, 100_000_000, 1400, 5.0, 1000, ""
    )


class World:
    """Plays the emulator for one host: a packet for every node each 0.25 s, a fix each 0.1 s."""

    def __init__(self, *nodes: str) -> None:
        self.yields: list[wire.Yield] = []
        self.loop = VirtualTimeLoop(self.exchange, spin_limit=500)
        self.host = Host([welcome(node) for node in nodes], lambda: self.loop.now_ns)
        self._packet_ns = dict.fromkeys(nodes, 250_000_000)
        self._fix_ns = dict.fromkeys(nodes, 100_000_000)

    def exchange(self, next_timer_ns: int | None) -> int:
        assert self.host.next_instant(next_timer_ns) is None, "windows of one instant"
        message = self.host.make_yield(b"n", len(self.yields), next_timer_ns)
        self.yields.append(message)
        wakes = [LAST_NS if next_timer_ns is None else next_timer_ns]
        wakes += [self._packet_ns[node] for node in message.waiting_radio]
        wakes += [self._fix_ns[node] for node in message.waiting_gnss]
        now_ns = min(wakes)
        if now_ns >= LAST_NS:
            raise Over
        packets, fixes = [], []
        for node in self.host.nodes:
            while self._packet_ns[node] <= now_ns:
                packets.append(wire.WirePacket(node, "other", 0, self._packet_ns[node], b"hi"))
                self._packet_ns[node] += 250_000_000
            while self._fix_ns[node] <= now_ns:
                fixes.append(wire.WireFix(node, self._fix_ns[node], (1.0, 2.0), (1.0, 0.0, 0.0, 1.0), None))
                self._fix_ns[node] += 100_000_000
        return self.host.open_window(wire.Grant(len(self.yields), now_ns, now_ns + 1, packets, fixes))

    def run(self, program: Program) -> Self:
        self.host.start(self.loop, dict.fromkeys(self.host.nodes, program))
        try:
            self.host.run(self.loop)
        except Over:
            self.host.close(self.loop)
        finally:
            self.loop.close()
        return self

    @property
    def endings(self) -> list[wire.Ending]:
        return [ending for traffic in self.traffic for ending in traffic.endings]

    @property
    def traffic(self) -> list[wire.Traffic]:
        return [step.traffic for message in self.yields for step in message.steps]


def test_a_host_closed_before_its_first_grant_tells_of_no_deadlock() -> None:
    world = World("v1")
    world.host.close(world.loop)
    world.loop.close()
    assert world.traffic == []


def test_a_program_that_only_waits_on_the_radio_is_woken_by_each_packet() -> None:
    heard: list[tuple[int, int]] = []

    async def program(node: Node) -> None:
        async for packet in node.radio:
            heard.append((node.now_ns, packet.received_ns))

    World("v1").run(program)
    assert heard == [(t, t) for t in range(250_000_000, LAST_NS, 250_000_000)]


def test_a_program_that_never_waits_on_the_radio_finds_packets_with_their_true_times() -> None:
    heard: list[list[int]] = []
    world = World("v1")

    async def program(node: Node) -> None:
        while True:
            await asyncio.sleep(1.0)
            heard.append([packet.received_ns for packet in node.radio.drain()])

    world.run(program)
    assert heard[0] == [250_000_000, 500_000_000, 750_000_000, 1_000_000_000]
    assert len(world.yields) == 10, "one barrier a second: packets do not wake it"


def packet_at(node: str, received_ns: int) -> wire.WirePacket:
    return wire.WirePacket(node, "other", 0, received_ns, b"hi")


def test_a_process_passes_through_its_window_by_itself() -> None:
    """v1 awaits packets, v2 has timers: each instant is a step with its own time, and the rest waits."""
    world = World("v1", "v2")
    log: list[tuple[str, int]] = []
    fixes = [wire.WireFix("v1", 0, (1.0, 2.0), (1.0, 0.0, 0.0, 1.0), None)]
    windows = [
        wire.Grant(
            0, 0, 10, [packet_at("v1", 3), packet_at("v2", 2), packet_at("v2", 5), packet_at("v2", 9)], fixes
        ),
        wire.Grant(1, 12, 20, [packet_at("v1", 12)]),
    ]

    async def program(node: Node) -> None:
        loop = asyncio.get_running_loop()
        while True:
            if node.id == "v1":
                await node.radio.receive()
                await node.radio.broadcast(b"answer")
                log.append(("v1", node.now_ns))
            else:
                await asyncio.sleep(4e-9)
                log.append(("v2", node.now_ns))
                log.extend(("v2 has", packet.received_ns) for packet in node.radio.drain())
        assert loop

    def exchange(next_timer_ns: int | None) -> int:
        next_ns = world.host.next_instant(next_timer_ns)
        if next_ns is not None:
            return next_ns
        message = world.host.make_yield(b"n", len(world.yields), next_timer_ns)
        world.yields.append(message)
        if not windows:
            raise Over
        return world.host.open_window(windows.pop(0))

    world.loop._exchange = exchange
    world.run(program)
    assert log == [
        *(("v1", 3), ("v2", 4), ("v2 has", 2), ("v2", 8), ("v2 has", 5)),
        *(("v1", 12), ("v2", 12), ("v2 has", 9), ("v2", 16)),
    ]
    start, first, second = world.yields
    assert [(step.time_ns, len(step.traffic.frames)) for step in first.steps] == [(3, 1)]
    assert (start.instants, first.instants, first.next_timer_ns) == (1, 4, 12)
    assert [step.time_ns for step in second.steps] == [12]
    assert (second.next_timer_ns, second.waiting_radio) == (20, ["v1"])


def test_packets_come_before_fixes_and_fixes_before_timers() -> None:
    order: list[str] = []

    async def hear(node: Node) -> None:
        while (await node.radio.receive()).received_ns < 500_000_000:
            pass
        order.append("packet")

    async def locate(node: Node) -> None:
        while (await node.gnss.receive()).time_ns < 500_000_000:
            pass
        order.append("fix")

    async def program(node: Node) -> None:
        timer = asyncio.create_task(asyncio.sleep(0.5))
        timer.add_done_callback(lambda _: order.append("timer"))
        await asyncio.gather(timer, locate(node), hear(node))

    World("v1").run(program)
    assert order == ["packet", "fix", "timer"]


def test_a_timeout_on_the_radio_loses_no_packet() -> None:
    heard: list[int] = []

    async def program(node: Node) -> None:
        while node.now_ns < 2_000_000_000:
            try:
                packet = await asyncio.wait_for(node.radio.receive(), timeout=0.1)
            except TimeoutError:
                continue
            heard.append(packet.received_ns)

    World("v1").run(program)
    assert heard == list(range(250_000_000, 2_000_000_001, 250_000_000))


def test_a_program_that_raises_ends_its_node_and_no_other() -> None:
    async def program(node: Node) -> None:
        await asyncio.sleep(1.0)
        if node.id == "v1":
            raise ValueError("no\nidea")
        await asyncio.sleep(1.0)
        await node.radio.broadcast(b"still here")

    world = World("v1", "v2").run(program)
    endings = [(e.node, e.kind, e.error) for e in world.endings]
    assert endings == [("v1", "crashed", "ValueError: no idea"), ("v2", "finished", "")]
    first = world.endings[0].details.splitlines()[1]
    assert __file__ in first, "a traceback begins in the program"
    assert "raise ValueError" in world.endings[0].details
    frames = [frame for traffic in world.traffic for frame in traffic.frames]
    assert [(frame.node, frame.payload) for frame in frames] == [("v2", b"still here")]


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (SystemExit(0), "finished"),
        (SystemExit(None), "finished"),
        (SystemExit(3), "crashed"),
        (BaseException("no"), "crashed"),
    ],
)
def test_what_is_raised_and_no_exception_ends_its_node_only(error: BaseException, kind: str) -> None:
    async def program(node: Node) -> None:
        if node.id == "v1":
            raise error
        await asyncio.sleep(1.0)

    world = World("v1", "v2").run(program)
    assert [(e.node, e.kind) for e in world.endings] == [("v1", kind), ("v2", "finished")]


def test_a_default_executor_is_its_programs_alone() -> None:
    names: dict[str, str] = {}

    async def program(node: Node) -> None:
        if node.id == "v1":
            with ThreadPoolExecutor(1, thread_name_prefix="own") as executor:
                asyncio.get_running_loop().set_default_executor(executor)
                names["v1"] = await asyncio.to_thread(lambda: threading.current_thread().name)
        await asyncio.sleep(1.0)
        if node.id == "v2":
            names["v2"] = await asyncio.to_thread(lambda: threading.current_thread().name)

    world = World("v1", "v2").run(program)
    assert [e.kind for e in world.endings] == ["finished", "finished"]
    assert names["v1"].startswith("own") and not names["v2"].startswith("own")


def test_a_job_waits_for_a_thread_of_its_own_program_alone() -> None:
    async def program(node: Node) -> None:
        queue: Queue[int] = Queue()
        waits = asyncio.create_task(asyncio.to_thread(queue.get))
        for _ in range(3):  # until the jobs of all programs wait
            await asyncio.sleep(0)
        await asyncio.to_thread(queue.put, 1)
        await waits

    nodes = [f"v{number}" for number in range(40)]  # more than there are threads for one program
    world = World(*nodes).run(program)
    assert [e.kind for e in world.endings] == ["finished"] * len(nodes)


def test_a_number_of_decimals_is_its_programs_alone() -> None:
    thirds: dict[str, Decimal] = {}

    async def program(node: Node) -> None:
        if node.id == "v1":
            getcontext().prec = 3
        await asyncio.sleep(1.0)
        thirds[node.id] = Decimal(1) / 3

    World("v1", "v2").run(program)
    assert [len(str(thirds[node])) for node in ("v1", "v2")] == [5, 30]


def test_a_program_may_configure_logging_in_main() -> None:
    root = logging.getLogger()
    before, root.handlers = root.handlers, []

    async def program(node: Node) -> None:
        if node.id == "v3":
            logging.config.dictConfig({"version": 1, "disable_existing_loggers": False, "root": {"level": "INFO"}})
        else:
            logging.basicConfig(level=logging.INFO, stream=io.StringIO(), force=node.id == "v2")
        logging.info("told by %s", node.id)

    world = World("v1", "v2", "v3")
    try:
        world.run(program)
    finally:
        root.handlers = before
        root.setLevel(logging.WARNING)
    notes = [(note.node, note.text.removeprefix("root: ")) for traffic in world.traffic for note in traffic.notes]
    assert notes == [(node, f"told by {node}") for node in ("v1", "v2", "v3")]


def test_an_early_exit_takes_the_nodes_other_tasks_with_it() -> None:
    async def chatter(node: Node) -> None:
        while True:
            await asyncio.sleep(0.1)
            await node.radio.broadcast(b"boo")

    async def program(node: Node) -> None:
        background = asyncio.create_task(chatter(node))
        await asyncio.sleep(1.05)
        assert not background.done()

    world = World("v1").run(program)
    assert sum(len(traffic.frames) for traffic in world.traffic) == 10


@pytest.mark.parametrize("sleep_s", [0.0, 1e-12])
@pytest.mark.parametrize("stubborn", [False, True])
def test_a_spinning_node_is_named_and_shown_and_the_others_go_on(stubborn: bool, sleep_s: float) -> None:
    async def spin() -> None:
        while True:
            try:
                await asyncio.sleep(sleep_s)
            except asyncio.CancelledError:
                if not stubborn:
                    raise

    async def program(node: Node) -> None:
        await asyncio.sleep(1.0)
        if node.id == "v2":
            await spin()
        await asyncio.sleep(1.0)

    world = World("v1", "v2").run(program)
    spun, finished = world.endings
    assert (spun.node, spun.kind) == ("v2", "spun")
    assert "spin" in spun.details
    assert (finished.node, finished.kind) == ("v1", "finished")


def test_a_bucket_whose_rest_is_nothing_beside_the_time_fills_all_the_same() -> None:
    """At 1 s a rest of 1e-17 s is lost when it is added; on a real clock time passes from look to look."""

    async def program(node: Node) -> None:
        loop, level, looks = asyncio.get_running_loop(), 1e-15, 0
        await asyncio.sleep(1.0)
        before_s = loop.time()
        while level > 0:
            turn = loop.create_future()
            loop.call_at(loop.time() + level / 30, turn.set_result, None)
            await turn
            now_s, looks = loop.time(), looks + 1
            level, before_s = level - 30 * (now_s - before_s), now_s
        node.event("full", looks=looks)

    world = World("v1").run(program)
    (finished,) = world.endings
    assert finished.kind == "finished"


def test_reports_and_frames_travel_with_the_yield_of_their_instant() -> None:
    async def program(node: Node) -> None:
        async for fix in node.gnss:
            node.report(fix.position_m, fix.covariance_m2, speed=3, cloud_m=np.zeros((2, 2)))

    world = World("v1").run(program)
    report = world.traffic[0].reports[0]
    assert (report.time_ns, report.node, report.estimate_m) == (100_000_000, "v1", (1.0, 2.0))
    assert report.values == {"speed": 3.0, "cloud_m": [0.0, 0.0, 0.0, 0.0]}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda node: node.report(estimate_m=[1.0]), "1 numbers given, 2 expected"),
        (lambda node: node.report(covariance_m2=[1.0, 2.0]), "2 numbers given, 4 expected"),
        (lambda node: node.report(note={"far": 1}), "note"),
        (lambda node: node.report(note=["far", "near"]), "note"),
        (lambda node: node.report(note=65 * "x"), "note"),
        (lambda node: node.report(delay_ms=10**400), r"delay_ms=1000.*: a number within ±1.8e\+308 is expected"),
        (lambda node: node.report(delay_ms=10**9000), r"delay_ms=\(int\)\): a number within"),
        (lambda node: node.report(covariance_m2=[[1, 0.5], [0.4, 1]]), "not symmetric, so no covariance"),
        (lambda node: node.report(covariance_m2=[[1, 2], [2, 1]]), r"\[2, 1\]\]\): not positive semidefinite"),
        (lambda node: node.report(covariance_m2=-np.eye(2)), "not positive semidefinite"),
        (lambda node: node.report(covariance_m2=[[np.nan, 0], [0, 1]]), "not finite, so no covariance"),
        (lambda node: node.report(common_error_covariance_m2=[[1, 0], [0, np.inf]]), "common_.*not finite"),
    ],
)
def test_a_wrong_report_is_refused_where_it_is_made(wrong: Callable[[Node], None], message: str) -> None:
    refused = []

    async def program(node: Node) -> None:
        with pytest.raises(ValueError, match=rf"report\(.*{message}"):
            wrong(node)
        refused.append(node.id)

    World("v1").run(program)
    assert refused == ["v1"]


@pytest.mark.parametrize("factor", [1e-12, 1.0, 1e12])
def test_a_covariance_with_errors_of_rounding_is_one(factor: float) -> None:
    long_and_thin = factor * np.array([[1.0, 1.0 - 1e-9], [1.0 + 1e-9, 1.0]])

    async def program(node: Node) -> None:
        node.report(covariance_m2=long_and_thin, common_error_covariance_m2=np.zeros((2, 2)))

    world = World("v1").run(program)
    assert world.traffic[0].reports[0].covariance_m2 == tuple(long_and_thin.ravel())


@pytest.mark.parametrize("payload", ["text", 5, None, [1, 2], {"a": 1}, bytes(1401)])
def test_a_payload_that_is_not_bytes_or_above_the_limit_is_refused(payload: Any) -> None:
    refused = []

    async def program(node: Node) -> None:
        with pytest.raises(PayloadTooLargeError if isinstance(payload, bytes) else TypeError) as caught:
            await node.radio.broadcast(payload)
        refused.append(str(caught.value))

    World("v1").run(program)
    (said,) = refused
    assert said == (
        f"broadcast({payload!r}): bytes are expected, not {type(payload).__name__}; encode it first, as with "
        "msgpack.packb(…) or text.encode()"
    ) or (isinstance(payload, bytes) and "1401 bytes" in said)


@pytest.mark.parametrize(
    "payload", [b"ab", bytearray(b"ab"), memoryview(b"ab"), np.array([97, 98], dtype=np.uint8)]
)
def test_whatever_holds_bytes_is_a_payload(payload: Any) -> None:
    async def program(node: Node) -> None:
        await node.radio.broadcast(payload)

    world = World("v1").run(program)
    assert world.traffic[0].frames[0].payload == b"ab"


def test_nodes_draw_from_seeds_of_their_own() -> None:
    draws = {}

    async def program(node: Node) -> None:
        draws[node.id] = node.rng.random()

    World("v1", "v2").run(program)
    assert draws["v1"] == draws["v2"], "these two were given the same seed"
    assert draws["v1"] == np.random.default_rng(1).random()


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("no.such.module:main", "cannot import: ModuleNotFoundError"),
        ("agents.beacon:nothing", "has no 'nothing'"),
        ("agents.beacon:encode", "is not an async function"),
        ("vnet.gateway.emulated:run_program", "called with the node"),
        ("agents.liar:main", "'agents.liar:main': renamed; use agents.cooperative.attacker:main"),
    ],
)
def test_a_program_that_cannot_be_loaded_says_why(entry: str, message: str) -> None:
    with pytest.raises(ProgramError, match=message):
        load_program(entry)


def test_packets_of_a_window_wait_until_they_are_due_and_keep_their_order() -> None:
    first, early, late = (packet_at("v1", time_ns).packet() for time_ns in (3, 5, 9))
    window = Window()
    window.open(10, {"v2": [early], "v1": [first, late]})
    assert window.take_packets("v1", 5) == [first]
    assert window.take_packets("v2", 4) == []
    assert window.take_packets("v2", 5) == [early]
    assert window.take_packets("v1", 8) == []
    assert window.take_packets("v1", 9) == [late]
    assert not window.with_packets(9)


def test_packets_that_an_earlier_window_has_left_come_first() -> None:
    first, second, third = (packet_at("v1", time_ns).packet() for time_ns in (3, 5, 12))
    window = Window()
    window.open(10, {"v1": [first, second]})
    assert window.take_packets("v1", 4) == [first]
    window.open(20, {"v1": [third]})
    assert window.first_packet_ns("v1".__eq__) == 5
    assert window.take_packets("v1", 20) == [second, third]


def test_a_window_keeps_no_more_packets_than_a_mailbox_and_the_last_window_bring() -> None:
    """The packets that are kept for a node that looks for none are the last: those that its mailbox would have."""
    window, inbox = Window(), Mailbox[Packet]()
    for number in range(5):
        new = [packet_at("v1", number * INBOX_LIMIT + n).packet() for n in range(INBOX_LIMIT)]
        window.open((number + 1) * INBOX_LIMIT, {"v1": new})
    kept = window.take_packets("v1", 5 * INBOX_LIMIT)
    assert len(kept) <= 3 * INBOX_LIMIT
    inbox.deliver(kept)
    assert inbox.drain() == new
