"""The gateway of a vehicle: real Zenoh sessions on both sides of a radio that the test plays."""

import asyncio
import subprocess
import sys
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from datetime import datetime
from functools import partial
from ipaddress import ip_address
from itertools import pairwise
from pathlib import Path
from threading import Event
from typing import Any

import msgspec
import pytest
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import NameOID

from emulator.drivers.live.gateway import Gateway, Giver, check_trust, read_users, session_environment
from emulator.scenario.program import Program, ZenohSessions
from tests.emulator.drivers.live.fakes import on_a_loop
from vnet.errors import ProgramError
from vnet.gateway.frames import CrossingReply, CrossingTokens, Fragments
from vnet.gateway.keys import FIX_KEY, RADIO_KEYS, REPORT_KEY, check_keys
from vnet.gateway.ros2 import ROS2_KEYS, Ros2
from vnet.transport.access import Access
from vnet.transport.authority import issue_certificates
from vnet.transport.wire import WireFix
from vnet.units import NS_PER_S

pytestmark = pytest.mark.slow

PATIENCE_S = 60.0
QUIET = ZenohSessions()

FIX = WireFix("v01", 5, (1.0, 2.0), (1.0, 0.0, 0.0, 1.0), None, 3.0).fix()


class Vehicle:
    """A gateway and its radio: frames reach all of `others`, unless `is_lost` says so of their number."""

    def __init__(self, name: str, keys: tuple[str, ...], max_payload: int, ros2: Ros2 | None) -> None:
        self.gateway = Gateway(name, 0, keys, QUIET, self._hear, ros2)
        self.others: list[Vehicle] = []
        self.is_lost: Callable[[int], bool] = lambda number: False
        self.frames: list[bytes] = []
        self.unread: list[str] = []
        """Complaints about frames that were no samples."""
        self.told: asyncio.Queue[tuple[str, Any]] = asyncio.Queue()
        """Reports, and changes of sessions and tokens."""
        self.time_ns = 0
        self._fragments = Fragments(max_payload)
        self._loop = asyncio.get_running_loop()

    def _hear(self, kind: str, what: str, item: tuple[Gateway, Any]) -> None:
        self._loop.call_soon_threadsafe(self._take, what, item[1])

    def _take(self, what: str, told: Any) -> None:
        if what in ("report", "session", "token"):
            self.told.put_nowait((what, told))
        message = self.gateway.take(what, told)
        for payload in [] if message is None else self._fragments.of(message):
            self.broadcast(payload)

    def broadcast(self, payload: bytes) -> None:
        self.frames.append(payload)
        if not self.is_lost(len(self.frames) - 1):
            for other in self.others:
                try:
                    other.gateway.hear(self.gateway.node_id, payload, other.time_ns)
                except ValueError as error:
                    other.unread.append(str(error))


@contextmanager
def connected(endpoint: str) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    config.insert_json5("transport/shared_memory/enabled", "false")
    session = zenoh.open(config)
    try:
        yield session
    finally:
        session.close()  # type: ignore[no-untyped-call]


def settle(session: zenoh.Session) -> None:
    """Return once the router has all that the session has declared: it answers after it."""
    for _ in session.get("@/*/router"):
        pass


def listen(session: zenoh.Session, key: str) -> asyncio.Queue[zenoh.Sample]:
    """Subscribe, and return what comes once the router has the subscription."""
    loop, heard = asyncio.get_running_loop(), asyncio.Queue[zenoh.Sample]()
    session.declare_subscriber(key, lambda sample: loop.call_soon_threadsafe(heard.put_nowait, sample))
    settle(session)
    return heard


def watch(session: zenoh.Session, key: str) -> asyncio.Queue[tuple[str, bool]]:
    """Return the tokens that appear (True) and go."""
    loop, seen = asyncio.get_running_loop(), asyncio.Queue[tuple[str, bool]]()

    def take(sample: zenoh.Sample) -> None:
        is_there = sample.kind == zenoh.SampleKind.PUT
        loop.call_soon_threadsafe(seen.put_nowait, (str(sample.key_expr), is_there))

    session.liveliness().declare_subscriber(key, take, history=True)
    return seen


def two_vehicles(
    keys: tuple[str, ...] = ("**",), max_payload: int = 2000, inside: tuple[str, ...] | None = None
) -> Callable[[Callable[[list[Vehicle], list[zenoh.Session]], Coroutine[Any, Any, None]]], Callable[[], None]]:
    """Run a test with two vehicles in range, and a client of each; in ROS 2 if topics are `inside`."""

    def of(test: Callable[[list[Vehicle], list[zenoh.Session]], Coroutine[Any, Any, None]]) -> Callable[[], None]:
        async def main() -> None:
            rules = {name: None if inside is None else Ros2(name, inside, 0) for name in ("v01", "v02")}
            first, second = vehicles = [Vehicle(name, keys, max_payload, ros2) for name, ros2 in rules.items()]
            first.others, second.others = [second], [first]
            try:
                endpoints = [await asyncio.to_thread(each.gateway.open, QUIET.listen) for each in vehicles]
                with connected(endpoints[0]) as one, connected(endpoints[1]) as other:
                    await asyncio.wait_for(test(vehicles, [one, other]), PATIENCE_S)
            finally:
                for vehicle in vehicles:
                    await vehicle.gateway.close()

        return lambda: asyncio.run(main())

    return of


@pytest.mark.parametrize("congestion", ["DROP", "BLOCK"])
def test_who_reads_late_has_everything_and_nobody_waits_for_him(congestion: str) -> None:
    """As after a pause: Zenoh waits for those who do not read, and drops after 1 ms what may be dropped."""
    count, option = 300, getattr(zenoh.CongestionControl, congestion)

    @two_vehicles(max_payload=100_000)
    async def test(vehicles: list[Vehicle], sessions: list[zenoh.Session]) -> None:
        late, heard = sessions[1].declare_subscriber("k", zenoh.handlers.FifoChannel(1)), vehicles[1].gateway.hear
        settle(sessions[1])
        vehicles[0].is_lost = lambda number: True
        sessions[0].put("k", bytes(50_000), congestion_control=option)
        while not vehicles[0].frames:
            await asyncio.sleep(0)
        for _ in range(count):
            heard("v01", vehicles[0].frames[0], 0)
        assert (
            await asyncio.to_thread(lambda: sum(len(late.recv().payload) for _ in range(count))) == 50_000 * count
        )

    test()


@two_vehicles()
async def test_a_sample_crosses_the_radio_as_it_was_put_and_comes_back_to_nobody(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
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
    stamped = samples[3].timestamp
    assert stamped is not None and str(stamped.get_id()) == str(sessions[0].info.routers_zid()[0])
    put = samples[0]
    assert (put.payload.to_bytes(), put.encoding) == (b"here", zenoh.Encoding.APPLICATION_JSON)
    assert put.attachment is not None and put.attachment.to_bytes() == b"extra"
    assert (put.timestamp, put.priority, put.express) == (stamp, zenoh.Priority.REAL_TIME, True)
    assert put.congestion_control == zenoh.CongestionControl.BLOCK
    assert len(vehicles[0].frames) == 4
    assert vehicles[1].frames == []
    assert [(await own.get()).kind for _ in range(4)] == [each.kind for each in samples]
    assert own.empty()  # past the radio, and not again by it


@two_vehicles(keys=("car/a", "car/b"))
async def test_samples_and_stamps_are_in_their_order_of_whatever_keys(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
    heard = listen(sessions[1], "**")
    for number in range(100):
        sessions[0].put(f"car/{'ab'[number % 2]}", str(number))
        sessions[0].delete("car/a")
    samples = [await heard.get() for _ in range(200)]
    assert [sample.payload.to_string() for sample in samples[::2]] == [str(number) for number in range(100)]
    stamps = [sample.timestamp for sample in samples if sample.timestamp is not None]
    assert len(stamps) == 200 and not any(later <= earlier for earlier, later in pairwise(stamps))


@two_vehicles(max_payload=300)
async def test_a_sample_larger_than_a_frame_is_put_together_or_lost_by_one_of_its_frames(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
    heard = listen(sessions[1], "**")
    vehicles[0].is_lost = lambda number: number == 4
    contents = [bytes([number]) * 1000 for number in range(3)]
    for content in contents:
        sessions[0].put("large", content)
    assert (await heard.get()).payload.to_bytes() == contents[0]
    assert (await heard.get()).payload.to_bytes() == contents[2]
    assert len(vehicles[0].frames) % 3 == 0
    assert all(len(frame) <= 300 for frame in vehicles[0].frames)


@two_vehicles(keys=("radio/**", "vnet/**"))
async def test_only_radio_keys_cross_and_none_of_vnet(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
    heard = listen(sessions[1], "**")
    for key in ("lidar/points", FIX_KEY, "radio/a"):
        sessions[0].put(key, b"x")
    assert str((await heard.get()).key_expr) == "radio/a"
    assert len(vehicles[0].frames) == 1


@two_vehicles(keys=("car/*/pose", "car/*/size"))
async def test_what_several_radio_keys_match_crosses_once(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
    """Those of different keys in any order: each has a thread of Zenoh's."""
    heard, keys = listen(sessions[1], "**"), ["car/**", "car/1/size", "car/*/pose"]
    for key in keys:
        sessions[0].put(key, b"x")
    assert sorted([str((await heard.get()).key_expr) for _ in keys]) == sorted(keys)
    assert len(vehicles[0].frames) == len(keys)


@two_vehicles()
async def test_an_advanced_subscriber_finds_exactly_the_samples_that_the_radio_has_lost(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
    loop, missed = asyncio.get_running_loop(), asyncio.Queue[int]()
    heard: asyncio.Queue[bytes] = asyncio.Queue()
    subscriber = zenoh.ext.declare_advanced_subscriber(
        sessions[1],
        "pose",
        lambda sample: loop.call_soon_threadsafe(heard.put_nowait, sample.payload.to_bytes()),
    )
    subscriber.sample_miss_listener(lambda miss: loop.call_soon_threadsafe(missed.put_nowait, miss.nb))
    listen(sessions[1], "other")
    vehicles[0].is_lost = lambda number: number in (2, 5, 6)
    publisher = zenoh.ext.declare_advanced_publisher(
        sessions[0],
        "pose",
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
    )
    for number in range(10):
        publisher.put(bytes([number]))
    assert [(await heard.get())[0] for _ in range(7)] == [0, 1, 3, 4, 7, 8, 9]
    assert [await missed.get() for _ in range(2)] == [1, 2]


@two_vehicles(keys=RADIO_KEYS)
async def test_an_advanced_subscriber_recovers_what_the_radio_has_lost_from_the_publishers_cache(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
    loop, heard = asyncio.get_running_loop(), asyncio.Queue[int]()
    subscriber = zenoh.ext.declare_advanced_subscriber(
        sessions[1],
        "pose",
        lambda sample: loop.call_soon_threadsafe(heard.put_nowait, sample.payload.to_bytes()[0]),
        recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
    )
    listen(sessions[1], "other")
    vehicles[0].is_lost = lambda number: number in (2, 5, 6)
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


@two_vehicles()
async def test_a_query_is_answered_by_the_programs_of_another_vehicle_with_samples_and_errors(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
    def reply(query: zenoh.Query) -> None:
        with query:
            asked = b"" if query.payload is None else query.payload.to_bytes()
            if query.parameters.get("fails"):
                query.reply_err(b"no")
            else:
                query.reply(query.key_expr, asked + b"!", attachment=b"extra", encoding="text/plain")

    sessions[1].declare_queryable("service", reply)
    listen(sessions[1], "other")
    answers = await asyncio.to_thread(lambda: list(sessions[0].get("service", payload=b"hello")))
    ok = answers[0].ok
    assert ok is not None and ok.attachment is not None
    assert (ok.payload.to_bytes(), ok.attachment.to_bytes()) == (b"hello!", b"extra")
    assert len(answers) == 1
    answers = await asyncio.to_thread(lambda: list(sessions[0].get("service?fails=1")))
    assert answers[0].err is not None and answers[0].err.payload.to_bytes() == b"no"
    assert len(vehicles[0].frames) == len(vehicles[1].frames) == 2


@two_vehicles(keys=("car/**", "other/*"))
async def test_a_query_of_several_radio_keys_is_sent_once_and_replies_of_other_keys_stay_inside(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
    def reply(query: zenoh.Query) -> None:
        with query:
            for key in (FIX_KEY, "lidar/points", "car/a", "other/b"):
                query.reply(key, b"x")

    sessions[1].declare_queryable("**", reply)
    listen(sessions[1], "other")
    ask = partial(sessions[0].get, "**", consolidation=zenoh.ConsolidationMode.NONE)
    answers = await asyncio.to_thread(lambda: [*ask()])
    assert [str(answer.ok.key_expr) for answer in answers if answer.ok] == ["car/a", "other/b"]
    assert (len(vehicles[0].frames), len(vehicles[1].frames)) == (1, 2)


@two_vehicles()
async def test_tokens_of_a_vehicle_are_seen_by_those_in_range_late_ones_too_and_are_gone_without_word(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
    first, second = vehicles
    token = sessions[0].liveliness().declare_token("car/a")
    while not first.frames:
        await first.told.get()
    early = watch(sessions[1], "car/*")
    assert await early.get() == ("car/a", True)
    late = watch(sessions[1], "car/*")  # history
    assert await late.get() == ("car/a", True)
    second.time_ns = 4 * NS_PER_S  # nothing was heard for longer than three times liveliness_s
    second.gateway.forget_tokens(second.time_ns)
    assert await early.get() == ("car/a", False)
    told = first.gateway.tokens()
    assert told == CrossingTokens(("car/a",))
    for payload in Fragments(2000).of(told):
        first.broadcast(payload)
    assert await early.get() == ("car/a", True)
    token.undeclare()  # type: ignore[no-untyped-call]
    assert await early.get() == ("car/a", False)
    assert second.frames == [], "an echo of another vehicle's token is no token of this one"
    assert first.gateway.tokens() is None


@two_vehicles()
async def test_a_token_that_two_vehicles_have_is_there_until_both_are_gone(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
    first, second = vehicles
    seen = watch(sessions[1], "leader")
    tokens = []
    for vehicle, session in zip(vehicles, sessions, strict=True):
        vehicle.is_lost = lambda number: True  # neither has heard of the other's before
        tokens.append(session.liveliness().declare_token("leader"))
        while not vehicle.gateway.tokens():
            await vehicle.told.get()
        vehicle.is_lost = lambda number: False
    assert await seen.get() == ("leader", True)
    for vehicle, other in zip(vehicles, reversed(vehicles), strict=True):
        vehicle.gateway.hear_tokens(other.gateway.node_id, CrossingTokens(("leader",)), 0)
    tokens[0].undeclare()  # type: ignore[no-untyped-call]
    while first.gateway.tokens():
        await first.told.get()
    settle(sessions[1])
    assert second.gateway.tokens() == CrossingTokens(("leader",)) and seen.empty()
    tokens[1].undeclare()  # type: ignore[no-untyped-call]
    assert await seen.get() == ("leader", False)
    while second.gateway.tokens():
        await second.told.get()


@pytest.mark.parametrize("key", ["leader", "car/@v/leader", "car/*"])
def test_a_token_that_is_handed_over_while_the_first_is_there_is_told(key: str) -> None:
    @two_vehicles(keys=("**", "car/@v/**"))
    async def handed_over(vehicles: list[Vehicle], sessions: list[zenoh.Session]) -> None:
        second, seen = vehicles[1], watch(sessions[1], key)
        tokens = [sessions[0].liveliness().declare_token(key)]
        assert await seen.get() == (key, True)
        tokens += [sessions[1].liveliness().declare_token(each) for each in (key, "car/other")]
        settle(sessions[1])
        tokens[0].undeclare()  # type: ignore[no-untyped-call]
        while key in second.gateway.heard_tokens:
            await vehicles[0].told.get()
        while second.gateway.tokens() != CrossingTokens(tuple(sorted((key, "car/other")))):
            await second.told.get()
        tokens[1].undeclare()  # type: ignore[no-untyped-call]
        while (told := second.gateway.tokens()) != CrossingTokens(("car/other",)):
            assert told is not None
            await second.told.get()

    handed_over()


@two_vehicles()
async def test_a_router_that_goes_takes_tokens_and_sessions_along(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
    """Nobody tells of those that end before there is one again."""
    gateway, token = vehicles[0].gateway, sessions[0].liveliness().declare_token("car/a")
    while not (gateway.tokens() and gateway.sessions):
        await vehicles[0].told.get()
    await gateway.close()
    assert not (gateway.tokens() or gateway.sessions)
    del token


@two_vehicles()
async def test_bytes_that_a_fault_has_changed_harm_nobody(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
    heard = listen(sessions[1], "last")
    first = listen(sessions[1], "car")
    sessions[0].put("car", b"here", attachment=b"extra", timestamp=sessions[0].new_timestamp())
    await first.get()
    frame = vehicles[0].frames[0]
    for content in (b"", b"\xc1", msgspec.msgpack.encode([0, 0, 1, b"\x90"])):
        vehicles[0].broadcast(content)
    for place in range(len(frame)):
        for change in (0x01, 0x40, 0x80, 0xFF):
            changed = bytearray(frame)
            changed[place] ^= change
            vehicles[0].broadcast(bytes(changed))
    sessions[0].put("last", b"x")
    assert str((await heard.get()).key_expr) == "last"
    assert len(vehicles[1].unread) > len(frame)


@two_vehicles()
async def test_a_query_does_not_end_in_a_pause(vehicles: list[Vehicle], sessions: list[zenoh.Session]) -> None:
    """Replies that were heard meanwhile follow."""
    first, second = vehicles
    sessions[1].declare_queryable("asked", lambda query: query.reply("asked", b"late"))
    settle(sessions[1])
    second.is_lost = lambda number: True
    replies = sessions[0].get("asked", consolidation=zenoh.ConsolidationMode.NONE)
    while not second.frames:
        await asyncio.sleep(0)
    first.gateway.is_paused = True
    first.gateway._end([0])
    first.gateway.is_paused = False
    first.gateway.hear("v02", second.frames[0], 0)
    assert (await asyncio.to_thread(replies.recv)).ok is not None


@two_vehicles()
async def test_a_reply_without_content_is_an_error_without_content(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
    """As a fault may make one of the bytes of another."""

    replies = sessions[0].get("asked")
    while not vehicles[0].frames:
        await asyncio.sleep(0)
    for payload in Fragments(2000).of(CrossingReply("v01", 0, None)):
        vehicles[1].broadcast(payload)
    error = (await asyncio.to_thread(replies.recv)).err
    assert error is not None and error.payload.to_bytes() == b""


@two_vehicles()
async def test_a_program_hears_its_fixes_and_reports_by_keys_of_vnet(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
    fixes = listen(sessions[0], FIX_KEY)
    vehicles[0].gateway.show_fix(FIX)
    fix = msgspec.msgpack.decode((await fixes.get()).payload.to_bytes())
    assert (fix["position_m"], fix["covariance_m2"], fix["speed_m_s"]) == ([1, 2], [[1, 0], [0, 1]], 3)
    content = msgspec.msgpack.encode({"speed": 3.0})
    sessions[0].put(REPORT_KEY, content)
    while (told := await vehicles[0].told.get())[0] != "report":
        pass
    assert told == ("report", content)
    assert vehicles[0].frames == []


@two_vehicles(keys=ROS2_KEYS, inside=("/inside/**",))
async def test_topics_services_and_tokens_of_ros_2_cross_or_stay_inside_with_each_other(
    vehicles: list[Vehicle], sessions: list[zenoh.Session]
) -> None:
    def key(topic: str) -> str:
        return f"0/{topic}/std_msgs::msg::dds_::String_/TypeHashNotSupported"

    def token(topic: str) -> str:
        return (
            f"@ros2_lv/0/ab/0/1/MP/%/%/node/%{topic}/std_msgs::msg::dds_::String_/TypeHashNotSupported/::,:,:,:,,"
        )

    heard, own = listen(sessions[1], "0/**"), listen(sessions[0], "0/vnet/**")
    seen = watch(sessions[1], "@ros2_lv/**")
    told = {await seen.get() for _ in range(3)}
    assert all("%vnet/gateway" in each for each, _ in told), "vnet's own node, and no other vehicle's"
    queryables = [
        sessions[1].declare_queryable(key(name), lambda query: query.reply(query.key_expr, b"yes"), complete=True)
        for name in ("add", "inside/add")
    ]
    settle(sessions[1])
    tokens = []
    for name in ("inside/a", "chatter"):
        tokens.append(sessions[0].liveliness().declare_token(token(name.replace("/", "%"))))
        sessions[0].put(key(name), b"x", attachment=bytes(33))
    sample = await heard.get()
    assert str(sample.key_expr) == key("chatter")
    assert sample.attachment is not None and sample.attachment.to_bytes() == bytes(33)
    assert await seen.get() == (token("chatter"), True)
    for name, count in (("add", 1), ("inside/add", 0)):
        target = zenoh.QueryTarget.ALL_COMPLETE
        answers = await asyncio.to_thread(lambda: list(sessions[0].get(key(name), target=target)))  # noqa: B023
        assert len(answers) == count
    vehicles[0].gateway.show_clock(5)
    vehicles[0].gateway.show_fix(FIX)
    assert str((await own.get()).key_expr).startswith("0/vnet/fix/")
    assert seen.empty() and heard.empty()
    assert len(vehicles[0].frames) == 3  # message, token, query
    assert queryables


@two_vehicles()
async def test_sessions_are_counted_by_who_they_are(vehicles: list[Vehicle], sessions: list[zenoh.Session]) -> None:
    gateway = vehicles[0].gateway
    while len(gateway.sessions) < 1:
        await vehicles[0].told.get()
    assert gateway.sessions == {f"{sessions[0].zid()} (client)"}
    sessions[0].close()  # type: ignore[no-untyped-call]
    while gateway.sessions:
        await vehicles[0].told.get()


@pytest.mark.parametrize(
    ("keys", "named"),
    [(("a//b",), "a//b"), (("a/**", "a/b"), "overlap"), (("vnet/fix",), "'vnet/fix' never crosses")],
)
def test_keys_that_cannot_be_are_named(keys: tuple[str, ...], named: str) -> None:
    with pytest.raises(ProgramError, match=named):
        check_keys(keys)


def test_a_key_that_is_not_under_vnets_may_cross() -> None:
    check_keys(["vnet", "vnets/**"])


def test_an_exception_on_a_thread_of_zenohs_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    async def first_bug() -> Exception:
        told: asyncio.Queue[tuple[str, Any]] = asyncio.Queue()
        loop = asyncio.get_running_loop()

        def hear(kind: str, what: str, item: tuple[Gateway, Any]) -> None:
            loop.call_soon_threadsafe(told.put_nowait, (what, item[1]))

        gateway = Gateway("v01", 0, RADIO_KEYS, QUIET, hear)
        with connected(await asyncio.to_thread(gateway.open, QUIET.listen)) as session:
            session.put("car/v01/pose", b"")
            while (heard := await asyncio.wait_for(told.get(), PATIENCE_S))[0] != "bug":
                pass
        await gateway.close()
        bug: Exception = heard[1]
        return bug

    monkeypatch.setattr("emulator.drivers.live.gateway.crossing_sample", lambda *_: 1 / 0)
    assert isinstance(asyncio.run(first_bug()), ZeroDivisionError)


def test_an_encrypted_private_key_is_named_and_no_password_is_asked_for(tmp_path: Path) -> None:
    issued = issue_certificates([], ["127.0.0.1"])
    key = load_pem_private_key(issued.router.private_key.encode(), None)
    locked = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"secret"))
    files = {"certificate": issued.router.certificate.encode(), "private_key": locked}
    files["authority"] = issued.authority.encode()
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    settings = ZenohSessions(listen="tls/127.0.0.1:0", **{name: tmp_path / name for name in files})
    with pytest.raises(ProgramError, match="private_key' is encrypted"):
        check_trust(settings)


def self_signed(folder: Path, names: list[x509.GeneralName], is_authority: bool, listen: str) -> ZenohSessions:
    """Settings with a certificate that is its own authority, as `openssl req -x509` makes them."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "localhost")])
    builder = x509.CertificateBuilder(name, name, key.public_key(), 1)
    builder = builder.not_valid_before(datetime(2020, 1, 1)).not_valid_after(datetime(2049, 1, 1))
    builder = builder.add_extension(x509.BasicConstraints(is_authority, None), critical=True)
    if names:
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    certificate = builder.sign(key, hashes.SHA256()).public_bytes(Encoding.PEM)
    (folder / "cert.pem").write_bytes(certificate)
    plain = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    (folder / "key.pem").write_bytes(plain)
    cert = folder / "cert.pem"
    return ZenohSessions(listen=listen, certificate=cert, private_key=folder / "key.pem", authority=cert)


LOCALHOST = x509.DNSName("localhost")
LOOPBACK = [x509.IPAddress(ip_address(address)) for address in ("127.0.0.1", "::1")]


@pytest.mark.parametrize(
    ("names", "is_authority", "listen", "says"),
    [
        ([*LOOPBACK, LOCALHOST], True, "tls/127.0.0.1:0", "an authority's .CA:TRUE.: Zenoh takes none"),
        ([LOCALHOST], False, "tls/127.0.0.1:0", "its subjectAltName lacks '127.0.0.1', the host of listen = 'tls/"),
        (LOOPBACK, False, "quic/localhost:7450", "its subjectAltName lacks 'localhost'"),
        ([], False, "tls/localhost:0", "its subjectAltName lacks 'localhost'"),
    ],
    ids=["authority", "no address", "no name", "common name alone"],
)
def test_a_certificate_that_zenoh_does_not_take_for_an_endpoint_is_named(
    tmp_path: Path, names: list[x509.GeneralName], is_authority: bool, listen: str, says: str
) -> None:
    settings = self_signed(tmp_path, names, is_authority, listen)
    with pytest.raises(ProgramError, match=f"^program.zenoh: certificate = '{settings.certificate}'.* {says}"):
        check_trust(settings)


@pytest.mark.parametrize("listen", ["tls/[::1]:0", "quic/[::1]:7450", "tls/[::]:0"])
def test_an_ipv6_address_with_a_certificate_is_refused(tmp_path: Path, listen: str) -> None:
    with pytest.raises(ProgramError, match=r"connects to no IPv6 address"):
        check_trust(self_signed(tmp_path, [*LOOPBACK, LOCALHOST], False, listen))


@pytest.mark.parametrize("listen", ["tls/127.0.0.1:0", "quic/localhost:7450", "tls/0.0.0.0:0", "tls/.:0"])
def test_a_certificate_that_names_its_host_is_trusted(tmp_path: Path, listen: str) -> None:
    """At which address of all commands connect is not known yet, and a host that is none is Zenoh's to tell."""
    check_trust(self_signed(tmp_path, [*LOOPBACK, LOCALHOST], False, listen))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("", "has no line user:password"),
        ("car:secret\nalice\n", "line 2 is no user:password"),
        (":secret", "line 1 is no user:password"),
        ("\n# users\ncar:secret", "line 2 is no user:password"),
        ("car:", "line 1 is no user:password"),
        ("tea\xe9:secret", "cannot be read"),
    ],
)
def test_a_file_that_has_not_user_and_password_in_each_line_is_named(
    tmp_path: Path, content: str, says: str
) -> None:
    path = tmp_path / "users"
    path.write_text(content, encoding="latin-1")
    with pytest.raises(ProgramError, match=f"program.zenoh.users = '{path}': {says}"):
        read_users(path)


def test_users_are_those_whom_zenoh_reads(tmp_path: Path) -> None:
    """The last password of a user counts."""
    path = tmp_path / "users"
    path.write_bytes(b"\n car : a:b \r\nbus:c\ncar:d")
    assert read_users(path) == {"car": "d", "bus": "c"}


@on_a_loop
async def test_who_does_not_read_holds_up_nobody_else_and_misses_nothing() -> None:
    """Zenoh waits with the thread for programs that do not read; each gateway's order stays."""
    giver, reads, said = Giver(), Event(), list[str]()
    slow, other = (Gateway(name, 0, RADIO_KEYS, QUIET, lambda *_: None) for name in ("v01", "v02"))
    for round_number in range(2):
        reads.clear()
        heard, all_said = asyncio.Event(), asyncio.Event()
        giver.take(slow, lambda: None if reads.wait(PATIENCE_S) else said.append("has held up another one"))
        for number in range(100):
            giver.take(slow, partial(said.append, f"{round_number}.{number}"))
        for gateway, event in ((slow, all_said), (other, heard)):
            giver.take(gateway, partial(asyncio.get_running_loop().call_soon_threadsafe, event.set))
        await heard.wait()  # though nothing more is given to anybody
        reads.set()
        await all_said.wait()
    giver.close()
    assert said == [f"{round_number}.{number}" for round_number in range(2) for number in range(100)]


def test_no_router_ends_what_a_pause_silences(tmp_path: Path) -> None:
    """Zenoh does after 10 s: a pause, which may also be injected by hand, lasts as long as it likes."""
    Access.create("r", [["v01"]]).save(tmp_path, "tcp/127.0.0.1:0", tmp_path)
    environment = session_environment("v01", "tcp/127.0.0.1:7447", Program(), tmp_path, {})
    files = tmp_path / "zenohd.json5", environment["ZENOH_CONFIG"]
    told_ms = [int(zenoh.Config.from_file(path).get_json("transport/link/tx/lease")) for path in files]
    told_ms.append(Gateway("v01", 0, RADIO_KEYS, QUIET, lambda *_: None)._router_settings()["link"]["tx"]["lease"])
    assert min(told_ms) >= 3_600_000


def test_commands_find_modules_in_the_folders_of_the_program(tmp_path: Path) -> None:
    (tmp_path / "app").mkdir()
    (tmp_path / "app" / "solo.py").write_text("print('found')")
    program = Program.model_validate({"kind": "zenoh", "command": ["python"], "folders": [str(tmp_path / "app")]})
    environment = session_environment("v01", "tcp/127.0.0.1:7447", program, tmp_path, {"PYTHONPATH": "own"})
    assert environment["PYTHONPATH"].endswith(f"own:{tmp_path / 'app'}")  # folders come last
    ran = subprocess.run([sys.executable, "-m", "solo"], env=environment, cwd=tmp_path, capture_output=True)
    assert ran.stdout == b"found\n"
