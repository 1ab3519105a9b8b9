"""A vehicle whose programs speak Zenoh, unmodified: a gateway between their sessions and the radio (real time).

Each vehicle has a Zenoh router of its own, on loopback. What its programs put is sent by the vehicle's radio, and
what the radio delivers is put at the programs of the receiver, with the same key, payload, encoding, attachment,
kind, priority and timestamp. Programs of one vehicle talk to each other past the radio. docs/how-to/zenoh.md is the
guide.
"""

from __future__ import annotations

import asyncio
import json
import os
import secrets
import shutil
import sys
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import combinations, count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import msgspec
import zenoh

from vnet import Node, Packet
from vnet.errors import ProgramError, shown
from vnet.runtime.virtual_time import VirtualTimeLoop
from vnet.transport.session import RUNTIME_VARIABLE, router_endpoint
from vnet.units import NS_PER_S

OWN_KEYS = "vnet/"
"""Prefix of keys that never cross the radio: what vnet tells the programs of a vehicle, and they it."""
FIX_KEY, REPORT_KEY = f"{OWN_KEYS}fix", f"{OWN_KEYS}report"
FRAGMENT_BYTES = 24
"""Most bytes of a frame around its part of a sample."""
MOST_UNFINISHED = 64
"""Samples in parts that are kept of each sender until the rest has come; the oldest go first."""
MOST_FRAGMENTS = 65_535
MOST_SOURCES = 100_000
"""Instances of `SourceInfo` that a process keeps for samples on their way."""
END_S = 0.5
"""Seconds for which a program that has been told to end may go on."""
REMOTE = zenoh.Locality.REMOTE


Priority = Literal[
    "REAL_TIME", "INTERACTIVE_HIGH", "INTERACTIVE_LOW", "DATA_HIGH", "DATA", "DATA_LOW", "BACKGROUND"
]


# Zenoh panics on a timestamp beyond these.
Seconds = Annotated[int, msgspec.Meta(ge=0, lt=2**32)]
Nanoseconds = Annotated[int, msgspec.Meta(ge=0, lt=NS_PER_S)]
TimestampId = Annotated[bytes, msgspec.Meta(min_length=1, max_length=16)]


class Crossing(msgspec.Struct, array_like=True, frozen=True, tag="sample"):
    """A sample on its way over the radio.

    `time` is seconds, nanoseconds and id of its timestamp. `source` stands for its `SourceInfo`, which Python
    cannot construct: process and number there. Gateways of other processes put the sample without.
    """

    key: str
    payload: bytes
    encoding: str
    is_delete: bool
    attachment: bytes | None
    priority: Priority
    congestion: Literal["DROP", "BLOCK", "BLOCK_FIRST"]
    express: bool
    time: tuple[Seconds, Nanoseconds, TimestampId] | None
    source: tuple[int, int] | None


class Question(msgspec.Struct, array_like=True, frozen=True, tag="query"):
    """A query on its way over the radio, with its number among those of the asking vehicle."""

    number: int
    selector: str
    payload: bytes | None
    encoding: str | None
    attachment: bytes | None


class Answer(msgspec.Struct, array_like=True, frozen=True, tag="reply"):
    """A reply to query `number` of vehicle `to`: a sample, or payload and encoding of an error."""

    to: str
    number: int
    sample: Crossing | None
    error: tuple[bytes, str] | None = None


class Fragment(msgspec.Struct, array_like=True, frozen=True):
    """Contents of a frame: part `index` of `parts` of the sender's sample `number`."""

    number: int
    index: int
    parts: int
    content: bytes


_sources: OrderedDict[int, zenoh.SourceInfo] = OrderedDict()
_source_numbers = count()
_encode = msgspec.msgpack.Encoder().encode
_message = msgspec.msgpack.Decoder(Crossing | Question | Answer).decode
_fragment = msgspec.msgpack.Decoder(Fragment).decode


@dataclass(frozen=True)
class Options:
    """`[program.options]`: `keys` that cross the radio, `commands` to start, the `port` of the first vehicle.

    `query_s` is for how long replies to a query are awaited: who will answer over the radio is not known.
    """

    keys: tuple[str, ...] = ("**", "**/@adv/**")
    commands: tuple[tuple[str, ...], ...] = ()
    port: int = 0
    query_s: float = 1.0

    @classmethod
    def of(cls, node: Node) -> Options:
        """Return the options of a node. Raise ProgramError for what cannot be."""
        given = dict(node.options)
        keys, command = given.pop("keys", cls.keys), given.pop("command", [])
        port, query_s = given.pop("port", cls.port), given.pop("query_s", cls.query_s)
        if given:
            raise ProgramError(f"program.options.{next(iter(given))}: allowed are keys, command, port and query_s")
        keys = _texts("keys", keys)
        for key in keys:
            try:
                zenoh.KeyExpr(key)
            except zenoh.ZError:
                raise ProgramError(f"program.options.keys: {shown(key)} is no key expression of Zenoh") from None
        for one, other in combinations(keys, 2):  # a sample of both would be sent twice
            if zenoh.KeyExpr(one).intersects(other):
                raise ProgramError(f"program.options.keys: {shown(one)} and {shown(other)} overlap")
        several = isinstance(command, list) and all(isinstance(words, list) for words in command)
        commands = [_texts("command", words) for words in (command if several else [command])]
        if not all(commands):
            raise ProgramError(f"program.options.command = {shown(command)}: a command has a word at least")
        if not isinstance(port, int) or not 0 <= port <= 65_535:
            raise ProgramError(f"program.options.port = {shown(port)}: 0 to 65535")
        if not isinstance(query_s, int | float) or not 0 < query_s <= 3600:
            raise ProgramError(f"program.options.query_s = {shown(query_s)}: seconds above 0, at most 3600")
        number = int("".join(c for c in node.id if c.isdigit()) or 1)
        return cls(keys, tuple(commands), port and port + number - 1, query_s)


def _texts(name: str, given: object) -> tuple[str, ...]:
    """Return one text or a list of texts as a tuple. Raise ProgramError for anything else."""
    texts = given if isinstance(given, list | tuple) else [given]
    if not all(isinstance(text, str) for text in texts):
        raise ProgramError(f"program.options.{name} = {shown(given)}: a text or a list of texts is expected")
    return tuple(texts)


class Gateway:
    """The gateway of one vehicle."""

    def __init__(self, node: Node, options: Options) -> None:
        self._node = node
        self._options = options
        self._loop = asyncio.get_running_loop()
        self._put: asyncio.Queue[Crossing | Question | Answer] = asyncio.Queue()
        self._numbers = count()
        self._queries: dict[int, zenoh.Query] = {}
        self._query_numbers = count()
        self._parts: dict[str, OrderedDict[int, dict[int, bytes]]] = {}
        self._folder = TemporaryDirectory(prefix="vnet-")
        self._session: zenoh.Session | None = None
        self.endpoint = ""
        self.sent = self.heard = 0
        """Samples that were sent, and that were heard."""

    async def open(self) -> None:
        """Open the vehicle's router. Raise ProgramError if it cannot listen."""
        listen = f"tcp/127.0.0.1:{self._options.port}"
        config = {
            "mode": "router",
            "listen": {"endpoints": [listen]},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0},
            "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}},
        }
        try:
            self._session = await asyncio.to_thread(zenoh.open, zenoh.Config.from_json5(json.dumps(config)))
        except zenoh.ZError as error:
            raise ProgramError(f"{self._node.id} cannot listen at {listen}: {error}") from None
        self.endpoint = await asyncio.to_thread(router_endpoint, self._session)
        for key in self._options.keys:
            self._session.declare_subscriber(key, self._taken, allowed_origin=REMOTE)
            self._session.declare_queryable(key, self._asked, allowed_origin=REMOTE)
        self._session.declare_subscriber(REPORT_KEY, self._reported, allowed_origin=REMOTE)

    def close(self) -> None:
        """Close the router, with all that is connected to it."""
        self._folder.cleanup()
        if self._session is not None:
            self._session.close()  # type: ignore[no-untyped-call]

    # Called by Zenoh, in threads of its own.

    def _taken(self, sample: zenoh.Sample) -> None:
        if not str(sample.key_expr).startswith(OWN_KEYS):
            self._call(self._put.put_nowait, crossing_of(sample))

    def _asked(self, query: zenoh.Query) -> None:
        if not str(query.key_expr).startswith(OWN_KEYS):
            self._call(self._ask, query)
        else:
            query.drop()  # type: ignore[no-untyped-call]

    def _reported(self, sample: zenoh.Sample) -> None:
        self._call(self._report, sample.payload.to_bytes())

    def _call(self, function: Callable[[Any], object], argument: Any) -> None:
        with suppress(RuntimeError):  # the loop has been closed
            self._loop.call_soon_threadsafe(function, argument)

    def _report(self, content: bytes) -> None:
        try:
            values = msgspec.msgpack.decode(content, type=dict[str, Any])
            self._node.report(values.pop("estimate_m", None), values.pop("covariance_m2", None), **values)
        except (msgspec.MsgspecError, TypeError, ValueError) as error:
            self._node.log(f"{REPORT_KEY}: {error}", "warning")

    # Queries and replies.

    def _ask(self, query: zenoh.Query) -> None:
        """Send a query of a program by radio, and take replies to it for a while."""
        number = next(self._query_numbers)
        self._queries[number] = query
        self._loop.call_later(self._options.query_s, self._conclude, number)
        encoding = None if query.encoding is None else str(query.encoding)
        question = Question(number, str(query.selector), _bytes(query.payload), encoding, _bytes(query.attachment))
        self._put.put_nowait(question)

    def _conclude(self, number: int) -> None:
        self._queries.pop(number).drop()  # type: ignore[no-untyped-call]

    def _pass_on(self, asker: str, question: Question) -> None:
        """Ask the programs of this vehicle, and send their replies by radio."""
        assert self._session is not None

        def answered(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                answer = Answer(asker, question.number, crossing_of(reply.ok))
            else:
                assert reply.err is not None
                error = reply.err.payload.to_bytes(), str(reply.err.encoding)
                answer = Answer(asker, question.number, None, error)
            self._call(self._put.put_nowait, answer)

        self._session.get(
            question.selector,
            answered,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=self._options.query_s,
            payload=question.payload,
            encoding=question.encoding,
            attachment=question.attachment,
            allowed_destination=REMOTE,
        )

    def _reply(self, answer: Answer) -> None:
        """Give a reply to the program that has asked, if it still waits."""
        query = self._queries.get(answer.number) if answer.to == self._node.id else None
        if query is None:
            return
        if answer.sample is None:
            assert answer.error is not None
            query.reply_err(answer.error[0], encoding=answer.error[1])
            return
        sample, options = answer.sample, _options(answer.sample)
        if "source_info" in options:  # which Python cannot give a reply, and advanced subscribers need
            self._show(sample)
            return
        kept = {name: options[name] for name in ("attachment", "express", "timestamp") if name in options}
        if sample.is_delete:
            query.reply_del(sample.key, **kept)
        else:
            query.reply(sample.key, sample.payload, encoding=sample.encoding, **kept)

    def _show(self, sample: Crossing) -> None:
        """Put a sample at the programs of this vehicle."""
        assert self._session is not None
        options: dict[str, Any] = {**_options(sample), "allowed_destination": REMOTE}
        if sample.is_delete:
            self._session.delete(sample.key, **options)
        else:
            self._session.put(sample.key, sample.payload, encoding=sample.encoding, **options)

    # Tasks of the vehicle.

    async def send(self) -> None:
        """Send what the programs put, a frame or several a sample."""
        while True:
            message = await self._put.get()
            content, number = _encode(message), next(self._numbers)
            size = self._node.radio.max_payload - FRAGMENT_BYTES
            pieces = [content[start : start + size] for start in range(0, len(content), max(size, 1))]
            if size < 1 or len(pieces) > MOST_FRAGMENTS:
                text = f"a sample of {len(content)} bytes needs more than {MOST_FRAGMENTS} frames"
                self._node.log(f"{text} of radio.max_payload_bytes = {self._node.radio.max_payload}", "error")
                continue
            self.sent += isinstance(message, Crossing)
            for index, piece in enumerate(pieces):
                await self._node.radio.broadcast(_encode(Fragment(number, index, len(pieces), piece)))

    async def receive(self) -> None:
        """Put what the radio delivers at the programs."""
        async for packet in self._node.radio:
            try:
                content = self._whole(packet)
                if content is not None:
                    self._take(packet.sender, _message(content))
            except (msgspec.MsgspecError, zenoh.ZError, LookupError, ValueError, OverflowError) as error:
                # bytes that a fault has changed
                self._node.log(f"a frame of {packet.sender} is no sample: {error}", "debug")

    def _whole(self, packet: Packet) -> bytes | None:
        """Return the sample that a packet completes, if it does."""
        fragment = _fragment(packet.payload)
        if fragment.parts == 1:
            return fragment.content
        unfinished = self._parts.setdefault(packet.sender, OrderedDict())
        parts = unfinished.setdefault(fragment.number, {})
        parts[fragment.index] = fragment.content
        if len(parts) == fragment.parts:
            del unfinished[fragment.number]
            return b"".join(parts[index] for index in range(fragment.parts))
        if len(unfinished) > MOST_UNFINISHED:
            unfinished.popitem(last=False)
        return None

    def _take(self, sender: str, message: Crossing | Question | Answer) -> None:
        if isinstance(message, Question):
            self._pass_on(sender, message)
        elif isinstance(message, Answer):
            self._reply(message)
        else:
            self.heard += 1
            self._show(message)

    async def tell_fixes(self) -> None:
        """Put each fix of the receiver at the programs, and report what has crossed."""
        async for fix in self._node.gnss:
            assert self._session is not None
            content = {
                "time_ns": fix.time_ns,
                "position_m": fix.position_m.tolist(),
                "covariance_m2": fix.covariance_m2.tolist(),
                "heading_rad": fix.heading_rad,
                "speed_m_s": fix.speed_m_s,
            }
            self._session.put(FIX_KEY, _encode(content), allowed_destination=REMOTE)
            self._node.report(sent_samples=self.sent, heard_samples=self.heard)

    async def run_program(self, words: tuple[str, ...]) -> None:
        """Run a program of the vehicle until it ends. Raise ProgramError if it fails: its vehicle has crashed."""
        words = tuple(word.replace("{id}", self._node.id).replace("{endpoint}", self.endpoint) for word in words)
        name = sys.executable if words[0] in ("python", "python3") else shutil.which(words[0])
        if name is None:
            raise ProgramError(f"program.options.command: {shown(words[0])} is no command")
        command = [sys.executable, "-m", "vnet.runtime.die_with_parent", name, *words[1:]]
        process = await asyncio.create_subprocess_exec(
            *command, env=self._environment(), stdin=asyncio.subprocess.DEVNULL
        )
        try:
            status = await process.wait()
        finally:
            if process.returncode is None:
                process.terminate()
                with suppress(TimeoutError):
                    await asyncio.wait_for(process.wait(), END_S)
                if process.returncode is None:
                    process.kill()
        if status != 0:
            raise ProgramError(f"{' '.join(words)} ended with status {status}")

    def _environment(self) -> dict[str, str]:
        """Return the environment in which an unmodified program connects to this vehicle's router, and to no other.

        `ZENOH_CONFIG` is read by `Config.from_env`, `ZENOH_CONFIG_OVERRIDE` by rmw_zenoh and its clients.
        """
        config = Path(self._folder.name) / "zenoh.json5"
        connect = {"connect": {"endpoints": [self.endpoint]}, "scouting": {"multicast": {"enabled": False}}}
        config.write_text(json.dumps({"mode": "client", **connect}))
        override = f'mode="client";connect/endpoints=["{self.endpoint}"];scouting/multicast/enabled=false'
        inherited = {name: value for name, value in os.environ.items() if name != RUNTIME_VARIABLE}
        own = {"ZENOH_CONFIG": str(config), "ZENOH_CONFIG_OVERRIDE": override, "VNET_ENDPOINT": self.endpoint}
        return inherited | own | {"VNET_NODE": self._node.id}


def crossing_of(sample: zenoh.Sample) -> Crossing:
    """Return what of a sample crosses the radio."""
    stamp = sample.timestamp
    time = None
    if stamp is not None:
        ntp = stamp.get_time_as_ntp64()
        time = ntp.as_secs(), ntp.subsec_nanos(), bytes(stamp.get_id())
    return Crossing(
        str(sample.key_expr),
        sample.payload.to_bytes(),
        str(sample.encoding),
        sample.kind == zenoh.SampleKind.DELETE,
        _bytes(sample.attachment),
        _name_of(sample.priority),
        _name_of(sample.congestion_control),
        sample.express,
        time,
        None if sample.source_info is None else (_this_process(), _number_of(sample.source_info)),
    )


def _options(sample: Crossing) -> dict[str, Any]:
    """Return the arguments with which a sample is put, deleted or replied."""
    options: dict[str, Any] = {
        "attachment": sample.attachment,
        "priority": getattr(zenoh.Priority, sample.priority),
        "congestion_control": getattr(zenoh.CongestionControl, sample.congestion),
        "express": sample.express,
    }
    if sample.time is not None:
        options["timestamp"] = zenoh.Timestamp(zenoh.NTP64(*sample.time[:2]), sample.time[2])
    if sample.source is not None and sample.source[0] == _this_process() and sample.source[1] in _sources:
        options["source_info"] = _sources[sample.source[1]]
    return options


def _bytes(content: zenoh.ZBytes | None) -> bytes | None:
    return None if content is None else content.to_bytes()


def _name_of(member: zenoh.Priority | zenoh.CongestionControl) -> Any:
    return str(member).rpartition(".")[2]


@cache
def _this_process() -> int:
    """Return a number that no process on any host shares; agents are forked after the import, so not before."""
    return secrets.randbits(62)


def _number_of(source: zenoh.SourceInfo) -> int:
    number = next(_source_numbers)
    _sources[number] = source
    if len(_sources) > MOST_SOURCES:
        _sources.popitem(last=False)
    return number


async def main(node: Node) -> None:
    """Be the gateway of a vehicle, and run the programs of `program.options.command`."""
    if isinstance(asyncio.get_running_loop(), VirtualTimeLoop):
        raise ProgramError('agents.zenoh_gateway needs run.pacing = "realtime": Zenoh has the time of the machine')
    options = Options.of(node)
    gateway = Gateway(node, options)
    try:
        await gateway.open()
        node.event("zenoh_endpoint", endpoint=gateway.endpoint)
        async with asyncio.TaskGroup() as tasks:
            for task in (gateway.send(), gateway.receive(), gateway.tell_fixes()):
                tasks.create_task(task)
            for words in options.commands:
                tasks.create_task(gateway.run_program(words))
    finally:
        gateway.close()
