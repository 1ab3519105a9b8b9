"""The gateway of a vehicle: real Zenoh sessions on both sides of a radio that the test plays."""

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any, cast

import msgspec
import pytest
import zenoh

from agents.zenoh_gateway import FIX_KEY, REPORT_KEY, Gateway, Options
from vnet import Node, Packet
from vnet.errors import ProgramError

PATIENCE_S = 60.0


class Radio:
    """Frames of one vehicle reach all of `others`, unless `is_lost` says so of their number."""

    def __init__(self, name: str, max_payload: int) -> None:
        self.name, self.max_payload = name, max_payload
        self.others: list[Radio] = []
        self.is_lost: Callable[[int], bool] = lambda number: False
        self.frames: list[bytes] = []
        self.inbox: asyncio.Queue[Packet] = asyncio.Queue()

    async def broadcast(self, payload: bytes) -> None:
        assert len(payload) <= self.max_payload
        self.frames.append(payload)
        if not self.is_lost(len(self.frames) - 1):
            for other in self.others:
                other.inbox.put_nowait(Packet(self.name, 0, 0, payload))

    async def __aiter__(self) -> AsyncIterator[Packet]:
        while True:
            yield await self.inbox.get()


class Vehicle:
    """The part of a node that a gateway uses."""

    def __init__(self, name: str, max_payload: int) -> None:
        self.id, self.radio, self.options = name, Radio(name, max_payload), dict[str, Any]()
        self.reports: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self.lines: list[str] = []

    def log(self, text: str, level: str = "info") -> None:
        self.lines.append(text)

    def report(self, *estimate: Any, **values: Any) -> None:
        self.reports.put_nowait(values)


@contextmanager
def connected(gateway: Gateway) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{gateway.endpoint}"]')
    session = zenoh.open(config)
    try:
        yield session
    finally:
        session.close()  # type: ignore[no-untyped-call]


def listen(session: zenoh.Session, key: str) -> asyncio.Queue[zenoh.Sample]:
    """Subscribe, and return what comes once the router has the subscription."""
    loop, heard = asyncio.get_running_loop(), asyncio.Queue[zenoh.Sample]()
    session.declare_subscriber(key, lambda sample: loop.call_soon_threadsafe(heard.put_nowait, sample))
    for _ in session.get("@/*/router"):  # it answers after what it has been told before
        pass
    return heard


def two(
    test: Callable[[list[Vehicle], list[zenoh.Session]], Coroutine[Any, Any, None]],
    keys: tuple[str, ...] = ("**",),
    max_payload: int = 2000,
) -> None:
    """Run a test with two vehicles in range, and a client of each."""

    async def run() -> None:
        vehicles = [Vehicle(name, max_payload) for name in ("v01", "v02")]
        gateways = [Gateway(cast("Node", vehicle), Options(keys)) for vehicle in vehicles]
        vehicles[0].radio.others, vehicles[1].radio.others = [vehicles[1].radio], [vehicles[0].radio]
        try:
            for gateway in gateways:
                await gateway.open()
            tasks = [asyncio.create_task(task()) for g in gateways for task in (g.send, g.receive)]
            with connected(gateways[0]) as first, connected(gateways[1]) as second:
                await asyncio.wait_for(test(vehicles, [first, second]), PATIENCE_S)
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
        finally:
            for gateway in gateways:
                gateway.close()

    asyncio.run(run())


def test_a_sample_crosses_the_radio_as_it_was_put_and_comes_back_to_nobody() -> None:
    async def test(vehicles: list[Vehicle], sessions: list[zenoh.Session]) -> None:
        own, heard = listen(sessions[0], "**"), listen(sessions[1], "**")
        stamp = sessions[0].new_timestamp()
        for number in range(3):
            sessions[0].put(
                f"car/{number}",
                b"here",
                encoding=zenoh.Encoding.APPLICATION_JSON,
                attachment=b"extra",
                timestamp=stamp,
                priority=zenoh.Priority.REAL_TIME,
                congestion_control=zenoh.CongestionControl.BLOCK,
                express=True,
            )
        sessions[0].delete("car/0")
        samples = [await heard.get() for _ in range(4)]
        assert [str(each.key_expr) for each in samples] == ["car/0", "car/1", "car/2", "car/0"]
        assert [each.kind for each in samples] == [zenoh.SampleKind.PUT] * 3 + [zenoh.SampleKind.DELETE]
        put = samples[0]
        assert (put.payload.to_bytes(), put.encoding) == (b"here", zenoh.Encoding.APPLICATION_JSON)
        assert put.attachment is not None and put.attachment.to_bytes() == b"extra"
        assert (put.timestamp, put.priority, put.express) == (stamp, zenoh.Priority.REAL_TIME, True)
        assert put.congestion_control == zenoh.CongestionControl.BLOCK
        assert len(vehicles[0].radio.frames) == 4
        assert vehicles[1].radio.frames == []
        assert own.qsize() == 4  # past the radio, and not again by it

    two(test)


def test_a_sample_larger_than_a_frame_is_put_together_or_lost_by_one_of_its_frames() -> None:
    async def test(vehicles: list[Vehicle], sessions: list[zenoh.Session]) -> None:
        heard = listen(sessions[1], "**")
        vehicles[0].radio.is_lost = lambda number: number == 4
        contents = [bytes([number]) * 1000 for number in range(3)]
        for content in contents:
            sessions[0].put("large", content)
        assert (await heard.get()).payload.to_bytes() == contents[0]
        assert (await heard.get()).payload.to_bytes() == contents[2]
        assert len(vehicles[0].radio.frames) % 3 == 0

    two(test, max_payload=300)


def test_only_the_keys_of_the_option_cross_and_none_of_vnet() -> None:
    async def test(vehicles: list[Vehicle], sessions: list[zenoh.Session]) -> None:
        heard = listen(sessions[1], "**")
        for key in ("lidar/points", FIX_KEY, "radio/a"):
            sessions[0].put(key, b"x")
        assert str((await heard.get()).key_expr) == "radio/a"
        assert len(vehicles[0].radio.frames) == 1

    two(test, keys=("radio/**", "vnet/**"))


def test_an_advanced_subscriber_finds_exactly_the_samples_that_the_radio_has_lost() -> None:
    async def test(vehicles: list[Vehicle], sessions: list[zenoh.Session]) -> None:
        loop, missed = asyncio.get_running_loop(), asyncio.Queue[int]()
        heard: asyncio.Queue[bytes] = asyncio.Queue()
        subscriber = zenoh.ext.declare_advanced_subscriber(
            sessions[1],
            "pose",
            lambda sample: loop.call_soon_threadsafe(heard.put_nowait, sample.payload.to_bytes()),
        )
        subscriber.sample_miss_listener(lambda miss: loop.call_soon_threadsafe(missed.put_nowait, miss.nb))
        listen(sessions[1], "other")
        vehicles[0].radio.is_lost = lambda number: number in (2, 5, 6)
        publisher = zenoh.ext.declare_advanced_publisher(
            sessions[0],
            "pose",
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
        )
        for number in range(10):
            publisher.put(bytes([number]))
        assert [(await heard.get())[0] for _ in range(7)] == [0, 1, 3, 4, 7, 8, 9]
        assert [await missed.get() for _ in range(2)] == [1, 2]

    two(test)


def test_a_query_is_answered_by_the_programs_of_another_vehicle_with_samples_and_errors() -> None:
    def reply(query: zenoh.Query) -> None:
        with query:
            asked = b"" if query.payload is None else query.payload.to_bytes()
            if query.parameters.get("fails"):
                query.reply_err(b"no")
            else:
                query.reply(query.key_expr, asked + b"!", attachment=b"extra", encoding="text/plain")

    async def test(vehicles: list[Vehicle], sessions: list[zenoh.Session]) -> None:
        sessions[1].declare_queryable("service", reply)
        listen(sessions[1], "other")
        answers = await asyncio.to_thread(lambda: list(sessions[0].get("service", payload=b"hello")))
        ok = answers[0].ok
        assert ok is not None and ok.attachment is not None
        assert (ok.payload.to_bytes(), ok.attachment.to_bytes()) == (b"hello!", b"extra")
        assert len(answers) == 1
        answers = await asyncio.to_thread(lambda: list(sessions[0].get("service?fails=1")))
        assert answers[0].err is not None and answers[0].err.payload.to_bytes() == b"no"
        assert len(vehicles[0].radio.frames) == len(vehicles[1].radio.frames) == 2

    two(test)


def test_an_advanced_subscriber_recovers_what_the_radio_has_lost_from_the_publishers_cache() -> None:
    async def test(vehicles: list[Vehicle], sessions: list[zenoh.Session]) -> None:
        loop, heard = asyncio.get_running_loop(), asyncio.Queue[int]()
        subscriber = zenoh.ext.declare_advanced_subscriber(
            sessions[1],
            "pose",
            lambda sample: loop.call_soon_threadsafe(heard.put_nowait, sample.payload.to_bytes()[0]),
            recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
        )
        listen(sessions[1], "other")
        vehicles[0].radio.is_lost = lambda number: number in (2, 5, 6)
        publisher = zenoh.ext.declare_advanced_publisher(
            sessions[0],
            "pose",
            cache=zenoh.ext.CacheConfig(10),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=0.5, sporadic_heartbeat=None),
        )
        for number in range(10):
            publisher.put(bytes([number]))
        assert [await heard.get() for _ in range(10)] == list(range(10))
        subscriber.undeclare()  # type: ignore[no-untyped-call]

    two(test, keys=Options().keys)


def test_bytes_that_a_fault_has_changed_harm_nobody() -> None:
    async def test(vehicles: list[Vehicle], sessions: list[zenoh.Session]) -> None:
        heard = listen(sessions[1], "last")
        first = listen(sessions[1], "car")
        sessions[0].put("car", b"here", attachment=b"extra", timestamp=sessions[0].new_timestamp())
        await first.get()
        frame = vehicles[0].radio.frames[0]
        for content in (b"", b"\xc1", msgspec.msgpack.encode([0, 0, 1, b"\x90"])):
            await vehicles[0].radio.broadcast(content)
        for place in range(len(frame)):
            for change in (0x01, 0x40, 0x80, 0xFF):
                changed = bytearray(frame)
                changed[place] ^= change
                await vehicles[0].radio.broadcast(bytes(changed))
        sessions[0].put("last", b"x")
        assert str((await heard.get()).key_expr) == "last"
        assert len(vehicles[1].lines) > len(frame)

    two(test)


def test_a_program_reports_by_its_key() -> None:
    async def test(vehicles: list[Vehicle], sessions: list[zenoh.Session]) -> None:
        sessions[0].put(REPORT_KEY, b"no map")
        sessions[0].put(REPORT_KEY, msgspec.msgpack.encode({"speed": 3.0}))
        assert await vehicles[0].reports.get() == {"speed": 3.0}
        assert len(vehicles[0].lines) == 1

    two(test)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"keys": "a//b"}, "keys"),
        ({"keys": ["a/**", "a/b"]}, "overlap"),
        ({"command": [["x"], []]}, "command"),
        ({"command": [3]}, "command"),
        ({"port": 70_000}, "port"),
        ({"query_s": 0}, "query_s"),
        ({"prot": 1}, "prot"),
    ],
)
def test_options_that_cannot_be_are_named(options: dict[str, Any], named: str) -> None:
    vehicle = Vehicle("v01", 100)
    vehicle.options = options
    with pytest.raises(ProgramError, match=named):
        Options.of(cast("Node", vehicle))
