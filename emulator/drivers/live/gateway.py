"""The gateway of one vehicle whose programs speak Zenoh: the router of their sessions, between them and the radio.

What its programs put, ask, reply and declare is sent by its radio; what the radio delivers is put at them.
The gateway is in the emulator's process, in real time (docs/how-to/zenoh.md).
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import ssl
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from threading import Lock, Thread, current_thread
from typing import Any, TypeVar

import zenoh

from emulator.drivers.agent_keys import Hear
from emulator.scenario.program import Program, ZenohSessions
from vnet.errors import ProgramError, shown
from vnet.gateway import STARTUP, client_config, session_variables
from vnet.gateway.frames import (
    CrossingQuery,
    CrossingReply,
    CrossingSample,
    CrossingTokens,
    Message,
    crossing_reply,
    crossing_sample,
    entity_bytes,
    sample_options,
)
from vnet.gateway.keys import REPORT_KEY
from vnet.gateway.radio_side import RadioSide
from vnet.gateway.ros2 import Ros2
from vnet.transport.access import LEASE_MS, queues
from vnet.transport.session import open_local_router, router_endpoint

MOST_PUBLISHERS = 100_000
"""Publishers whose ids are kept for samples on their way."""
MOST_TOKENS = 2**16
"""Tokens that are read at once: Zenoh gives them within the call, which would wait for itself."""
DROPS_AFTER_US = 1_000_000
"""Time (µs) for which the router waits for programs that do not read before it drops a sample that may be dropped.

Zenoh's own 1 ms is less than what a vehicle takes to read what came while it was paused.
"""
MOST_WAITING = 10_000
"""Samples, queries and replies that wait for the programs of a vehicle, beyond which they are dropped."""
WAITS_S = 0.02
"""Time that Zenoh waits for a program, from which on others are given theirs by another thread."""
SLOW_S = 0.5
"""The same, from which on it is told."""
ANY_HOST = "0.0.0.0"
"""Host of endpoints that listen at each address: the system says at which one commands connect."""
OTHER_HOST = (62, 64)
"""OpenSSL's codes (X509_V_ERR_…_MISMATCH) of a certificate for other hosts, by name and by address."""
REMOTE = zenoh.Locality.REMOTE
_OF_AUTHORITY = re.compile(rb"\x06\x03\x55\x1d\x13(\x01\x01\xff)?\x04.\x30.\x01\x01\xff", re.DOTALL)
"""The basicConstraints of a certificate with CA:TRUE, in DER (RFC 5280, 4.2.1.9)."""

T = TypeVar("T")

_publishers: OrderedDict[bytes, zenoh.EntityGlobalId] = OrderedDict()
"""Ids of publishers whose samples have numbers, which Python cannot construct."""


class Gateway(RadioSide[zenoh.Query]):
    """One incarnation of a vehicle's gateway. Methods are for the run's loop, except `open`.

    `keys` cross the radio. `hear` takes on any thread "gateway", what programs do ("message", "query", "token",
    "session", "report"), and the gateway with what belongs to it: `take` then takes that on the run's loop.
    It is told of a "bug", too, an exception on a thread of Zenoh's, which would only print it, and of a "note".

    Programs are given what they hear by a `giver`, in order: Zenoh waits for those who do not read.
    """

    def __init__(
        self,
        node: str,
        incarnation: int,
        keys: Sequence[str] | None,
        settings: ZenohSessions,
        hear: Hear,
        ros2: Ros2 | None = None,
        giver: Giver | None = None,
    ) -> None:
        super().__init__(node, incarnation, keys, settings.query_s, settings.liveliness_s, ros2)
        self._settings, self._tell_run = settings, hear
        self._giver = Giver() if giver is None else giver
        self.is_paused = False
        self._session: zenoh.Session | None = None
        self._closing: asyncio.Future[None] | None = None
        self._watches: list[Any] = []
        self._declared: dict[str, zenoh.LivelinessToken] = {}
        """Tokens of other vehicles, which are declared at this one's programs.

        One that a program of this vehicle has as well stays until that is gone: its owner would be told that it is.
        """
        self._tokens: set[str] = set()
        """Tokens of this vehicle's own programs that cross the radio."""
        self.sessions: set[str] = set()
        """Names of the sessions that are connected."""

    def open(self, listen: str) -> str:
        """Open the vehicle's router at an endpoint; returns it with its port. Raises TransportError.

        For a thread of its own: it takes a while.
        """
        session = open_local_router(listen, self._router_settings())
        self._session = session
        endpoint = router_endpoint(session)
        for number, key in enumerate(self._keys):
            session.declare_subscriber(key, self._telling(partial(self._put, number)), allowed_origin=REMOTE)
            # Clients of ROS 2's services ask none but complete queryables.
            is_complete, asked = self._ros2 is not None, self._telling(partial(self._asked, number))
            session.declare_queryable(key, asked, complete=is_complete, allowed_origin=REMOTE)
            watch = session.liveliness().declare_subscriber(key, self._telling(self._token), history=True)
            self._watches.append(watch)
        session.declare_subscriber(REPORT_KEY, self._telling(self._reported), allowed_origin=REMOTE)
        if self._ros2 is not None:
            own = map(session.liveliness().declare_token, self._ros2.tokens(str(session.zid())))
            self._watches.extend(own)
        info = session.info
        self._watches.append(info.declare_transport_events_listener(self._telling(self._connected), history=True))
        return endpoint

    def _router_settings(self) -> dict[str, Any]:
        """Return what the router's transport needs for certificates and users, and for those who do not read."""
        drop = dict.fromkeys(("wait_before_drop", "max_wait_before_drop_fragments"), DROPS_AFTER_US)
        link: dict[str, Any] = queues(LEASE_MS)
        link["tx"]["queue"]["congestion_control"] = {"drop": drop}
        settings = self._settings
        if settings.certificate is not None:
            link["tls"] = {
                "listen_certificate": str(settings.certificate),
                "listen_private_key": str(settings.private_key),
            }
        auth = {} if settings.users is None else {"auth": {"usrpwd": {"dictionary_file": str(settings.users)}}}
        return {"link": link, **auth}

    # Threads of Zenoh's.

    def _tell(self, what: str, item: Any) -> None:
        self._tell_run("gateway", what, (self, item))

    def _telling(self, take: Callable[[T], None]) -> zenoh.handlers.Callback[T]:
        """Return a callback for Zenoh that tells of its own exceptions.

        It is called on the thread that receives for the router. With a thread for each callback, as by default, the
        order of samples of different keys would change, that of samples, queries and tokens, and that of stamps: a
        put has one when it is routed, a delete when it is told.
        """

        def told(item: T) -> None:
            try:
                take(item)
            except Exception as error:
                self._tell("bug", error)

        return zenoh.handlers.Callback(told, indirect=False)

    def _is_first(self, number: int, key: zenoh.KeyExpr) -> bool:
        """Tell whether no expression before that of this number matches a key: Zenoh asks each."""
        return not any(each.intersects(key) for each in self._expressions[:number])

    def _put(self, number: int, sample: zenoh.Sample) -> None:
        key = sample.key_expr
        if self._is_first(number, key) and self.crosses(str(key)) and self._session is not None:
            # A delete has none, and the routers of receivers would give it theirs.
            stamp = sample.timestamp or self._session.new_timestamp()
            _keep_publisher(sample)
            self._tell("message", crossing_sample(sample, stamp))

    def _asked(self, number: int, query: zenoh.Query) -> None:
        if self._is_first(number, query.key_expr) and self.crosses(str(query.key_expr)):
            self._tell("query", query)
        else:
            query.drop()  # type: ignore[no-untyped-call]

    def _token(self, sample: zenoh.Sample) -> None:
        self._tell("token", (str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))

    def _reported(self, sample: zenoh.Sample) -> None:
        self._tell("report", sample.payload.to_bytes())

    def _connected(self, event: zenoh.TransportEvent) -> None:
        self._tell("session", (session_name(event.transport), event.kind == zenoh.SampleKind.PUT))

    # Threads of the giver's.

    def give(self, session: zenoh.Session, call: Callable[[], object]) -> None:
        """Put at the programs what has been decided on the run's loop, while the router is the same."""
        if self._session is not session:
            return
        began_s = time.monotonic()
        try:
            call()
        except zenoh.ZError as error:  # of a reply that a fault has changed, or as the router was closed
            if self._session is session:
                self._tell("note", ("debug", f"cannot be given to the programs: {error}"))
        except BaseException as error:  # Zenoh's panics are no `Exception`
            self._tell("bug", error)
        if (waited_s := time.monotonic() - began_s) >= SLOW_S:
            self.warn(f"Zenoh has waited for {waited_s:.1f} s")

    def warn(self, what: str) -> None:
        """Tell of programs that do not read."""
        self._tell("note", ("warning", f"programs do not take what arrives: {what}"))

    # The run's loop.

    def _call(self, call: Callable[[], object]) -> None:
        """Have something put at the programs, after all that was before."""
        assert self._session is not None
        self._giver.take(self, partial(self.give, self._session, call))

    async def close(self) -> None:
        """Close the router, with all that is connected to it: Zenoh waits 10 s for programs that do not read."""
        session, self._session = self._session, None
        self._declared, self._watches = {}, []
        self._told = {}
        self._tokens.clear()  # nobody tells of those that end while there is no router, and of sessions
        self.sessions.clear()
        if session is not None:
            self._closing = asyncio.ensure_future(asyncio.to_thread(session.close))
        if self._closing is not None:
            with suppress(zenoh.ZError):
                await asyncio.shield(self._closing)

    # From the programs.

    def take(self, what: str, item: Any) -> Message | None:
        """Take what `hear` was told, but for reports; returns the message that is to be sent, if any."""
        match what:
            case "message":
                message: Message = item
                return message
            case "query":
                return self.keep(item)
            case "token":
                return self._take_token(*item)
            case "session":
                who, is_there = item
                (self.sessions.add if is_there else self.sessions.discard)(who)
        return None

    def _end(self, numbers: list[int]) -> None:
        """As `RadioSide._end`, but not in a pause: what was heard meanwhile follows."""
        if self.is_paused and self._session is not None:
            asyncio.get_running_loop().call_later(self._query_s, self._end, numbers)
        else:
            super()._end(numbers)

    def _conclude(self, query: zenoh.Query) -> None:
        if self._session is not None:
            self._call(query.drop)

    def _take_token(self, key: str, is_there: bool) -> CrossingTokens | None:
        """Take a token that has appeared or is gone.

        Of a key that is declared here Zenoh tells only that the last token of programs is gone. All else of it, and
        of one that was declared here, is an echo.
        """
        if self._session is None or not self.crosses(key) or (key in self._declared and is_there):
            return None
        is_there = key not in self._declared and self._is_alive(key)
        if (key in self._tokens) == is_there:
            return None
        (self._tokens.add if is_there else self._tokens.discard)(key)
        if key not in self.heard_tokens:
            self._release(key)
        return CrossingTokens(tuple(sorted(self._tokens)))

    def _is_alive(self, key: str) -> bool:
        assert self._session is not None
        found = self._session.liveliness().get(key, zenoh.handlers.FifoChannel(MOST_TOKENS))
        return any(reply.ok is not None and str(reply.ok.key_expr) == key for reply in found)

    def tokens(self) -> CrossingTokens | None:
        """Return the tokens of the vehicle's programs, to be told again, if there are any."""
        return CrossingTokens(tuple(sorted(self._tokens))) if self._tokens else None

    # To the programs.

    def hear(self, sender: str, payload: bytes, time_ns: int) -> None:
        """As `RadioSide.hear`, while the router is open."""
        if self._session is not None:
            super().hear(sender, payload, time_ns)

    def hear_tokens(self, sender: str, tokens: CrossingTokens, time_ns: int, number: int = 0) -> None:
        """As `RadioSide.hear_tokens`, while the router is open."""
        if self._session is not None:
            super().hear_tokens(sender, tokens, time_ns, number)

    def _publish(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        if self._session is not None:
            self._call(partial(self._session.put, key, payload, attachment=attachment, allowed_destination=REMOTE))

    def _show(self, sample: CrossingSample) -> None:
        assert self._session is not None
        key = zenoh.KeyExpr(sample.key)  # a fault may have changed it
        options = {**sample_options(sample), "source_info": _known_source(sample), "allowed_destination": REMOTE}
        if sample.is_delete:
            self._call(partial(self._session.delete, key, **options))
        else:
            self._call(partial(self._session.put, key, sample.payload, encoding=sample.encoding, **options))

    def _answer(self, asker: str, query: CrossingQuery) -> None:
        assert self._session is not None

        def answered(reply: zenoh.Reply) -> None:
            if self.crosses_in(reply):
                _keep_publisher(reply.ok)
                self._tell("message", crossing_reply(asker, query, reply))

        asked = partial(
            self._session.get,
            zenoh.Selector(query.selector),
            self._telling(answered),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=self._settings.query_s,
            payload=query.payload,
            encoding=query.encoding,
            attachment=query.attachment,
            allowed_destination=REMOTE,
        )
        self._call(asked)

    def _reply(self, query: zenoh.Query, answer: CrossingReply) -> None:
        if answer.sample is None:
            content, encoding = answer.error or (b"", "")
            self._call(partial(query.reply_err, content, encoding=encoding))
            return
        sample, options = answer.sample, sample_options(answer.sample)
        if _known_source(sample) is not None:  # which Python cannot give a reply, and advanced subscribers need
            self._show(sample)
            return
        kept = {name: options[name] for name in ("attachment", "express", "timestamp")}
        if sample.is_delete:
            self._call(partial(query.reply_del, sample.key, **kept))
        else:
            self._call(partial(query.reply, sample.key, sample.payload, encoding=sample.encoding, **kept))

    def _show_token(self, key: str, is_there: bool) -> None:
        """Declare a token of another vehicle at the programs, or take it back."""
        if not is_there:
            self._release(key)
        elif key not in self._declared and self._session is not None:
            self._declared[key] = self._session.liveliness().declare_token(key)

    def _release(self, key: str) -> None:
        """Take a token of another vehicle back, unless a program of this one has it, too.

        Zenoh does not tell of a program's token while the same is declared here: it is found then.
        """
        if key in self._declared and key not in self._tokens:
            self._declared.pop(key).undeclare()  # type: ignore[no-untyped-call]
            if self._is_alive(key):
                self._tokens.add(key)


class Giver:
    """Gives programs what they hear, on a thread beside the run's loop, in order at each gateway.

    Zenoh waits for who does not read, up to 5 s. A thread that waits goes on with that gateway alone, and another
    takes the others.
    """

    def __init__(self) -> None:
        self._calls = SimpleQueue[tuple[Gateway, Callable[[], object]] | None]()
        self._lock = Lock()
        self._thread: Thread | None = None
        self._busy: tuple[Gateway, float] | None = None
        """The gateway at which the thread is, and since when (s)."""
        self._looks = False
        self._alone: dict[Gateway, deque[Callable[[], object]]] = {}
        """Calls that wait for gateways with a thread of their own."""

    def take(self, gateway: Gateway, call: Callable[[], object]) -> None:
        """Have a gateway's call made soon; on the run's loop."""
        self._calls.put((gateway, call))
        if self._thread is None:
            self._start()
        if not self._looks:
            self._looks = True
            asyncio.get_running_loop().call_later(WAITS_S, self._look)

    def _start(self) -> None:
        self._busy, self._thread = None, Thread(target=self._run, name="giver", daemon=True)
        self._thread.start()

    def _look(self) -> None:
        """Have another thread go on if the present one waits; look again while there is anything to give."""
        with self._lock:
            busy = self._busy
            if busy is not None and time.monotonic() - busy[1] >= WAITS_S:
                self._alone[busy[0]] = deque()
                self._start()
        self._looks = busy is not None or not self._calls.empty()
        if self._looks:
            asyncio.get_running_loop().call_later(WAITS_S, self._look)

    def close(self) -> None:
        """End the thread once all that was before is done."""
        self._calls.put(None)

    def _run(self) -> None:
        while (item := self._calls.get()) is not None:
            gateway, call = item
            with self._lock:
                waiting = self._alone.get(gateway)
                if waiting is None:
                    self._busy = gateway, time.monotonic()
                elif len(waiting) < MOST_WAITING:
                    waiting.append(call)
                elif len(waiting) == MOST_WAITING:
                    waiting.append(partial(gateway.warn, f"of {MOST_WAITING:,} that wait, later ones were dropped"))
            if waiting is not None:
                continue
            call()
            with self._lock:
                if self._thread is not current_thread():
                    break
                self._busy = None
        else:
            return
        while True:
            with self._lock:
                if not self._alone[gateway]:
                    del self._alone[gateway]
                    return
                call = self._alone[gateway].popleft()
            call()


def session_name(session: zenoh.Transport | zenoh.Hello) -> str:
    """Return what a session is called: its id and its mode."""
    return f"{session.zid} ({session.whatami})"


def is_peer(name: str) -> bool:
    """Return whether a session of this name is a peer, which others may find."""
    return name.endswith("(peer)")


def session_environment(
    node: str,
    endpoint: str,
    program: Program,
    folder: Path,
    inherited: Mapping[str, str],
) -> dict[str, str]:
    """Return the environment in which an unmodified program connects to its vehicle's router alone.

    Its configuration becomes a file in `folder`, which has passwords and is for this account alone.
    """
    settings = program.sessions
    client = client_config(endpoint)
    link: dict[str, Any] = queues(LEASE_MS)
    client["transport"] = transport = {"link": link}
    if settings.authority is not None:
        link["tls"] = {"root_ca_certificate": str(settings.authority)}
    if settings.users is not None:
        user, password = next(iter(read_users(settings.users).items()))
        transport["auth"] = {"usrpwd": {"user": user, "password": password}}
    path = folder / f"{node}.json5"
    path.write_text(json.dumps(client))
    path.chmod(0o600)
    searched = [str(STARTUP), inherited.get("PYTHONPATH"), *map(str, program.folders)]  # as in a simulation
    python_path = os.pathsep.join(filter(None, searched))
    return {**inherited, **session_variables(node, endpoint, client, path), "PYTHONPATH": python_path}


def read_users(path: Path) -> dict[str, str]:
    """Return the passwords of users as Zenoh reads them. Raise ProgramError for what it refuses without a line."""
    named, users = f"program.zenoh.users = {shown(str(path))}", {}
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ProgramError(f"{named}: cannot be read: {error}") from None
    for number, line in enumerate(lines, start=1):
        user, _, password = map(str.strip, line.partition(":"))
        if user and password:
            users[user] = password
        elif line.strip():
            raise ProgramError(f"{named}: line {number} is no user:password")
    if not users:
        raise ProgramError(f"{named}: has no line user:password")
    return users


def check_trust(settings: ZenohSessions) -> None:
    """Raise ProgramError if commands would not trust the certificate of their endpoint: Zenoh does not say why."""
    if settings.certificate is None or settings.private_key is None:
        return
    router, command = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    host = settings.listen.partition("/")[2].rpartition(":")[0]
    if host.startswith("["):
        raise ProgramError(
            f"program.zenoh.listen = {shown(settings.listen)}: Zenoh connects to no IPv6 address with a "
            "certificate, only to a host's name or an IPv4 address"
        )
    command.check_hostname, command.hostname_checks_common_name = host != ANY_HOST, False
    command.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN  # as Zenoh, which takes any certificate for an authority
    try:
        router.load_cert_chain(settings.certificate, settings.private_key, password="")
    except OSError as error:
        raise ProgramError(
            f"program.zenoh: private_key = {shown(str(settings.private_key))} is encrypted, or not that of "
            f"certificate = {shown(str(settings.certificate))}: {error}"
        ) from None
    named = f"program.zenoh: certificate = {shown(str(settings.certificate))}"
    try:
        command.load_verify_locations(settings.authority)
        up, down = ssl.MemoryBIO(), ssl.MemoryBIO()
        asking = command.wrap_bio(down, up, server_hostname=host)
        for side in (asking, router.wrap_bio(up, down, server_side=True)) * 2:
            with suppress(ssl.SSLWantReadError):
                side.do_handshake()
    except OSError as error:  # also of files that are none
        if getattr(error, "verify_code", 0) in OTHER_HOST:
            raise ProgramError(
                f"{named}: its subjectAltName lacks {shown(host)}, the host of listen = {shown(settings.listen)}"
            ) from None
        raise ProgramError(
            f"{named} with its private_key is none that authority = {shown(str(settings.authority))} has issued: "
            f"{getattr(error, 'verify_message', error)}"
        ) from None
    except ValueError:  # the host is none: Zenoh does say so
        return
    if _OF_AUTHORITY.search(asking.getpeercert(binary_form=True) or b""):  # OpenSSL takes it
        raise ProgramError(f"{named} is an authority's (CA:TRUE): Zenoh takes none for an endpoint, only CA:FALSE")


def _keep_publisher(sample: zenoh.Sample | None) -> None:
    if sample is not None and sample.source_info is not None:
        publisher = sample.source_info.source_id
        _publishers[entity_bytes(publisher)] = publisher
        if len(_publishers) > MOST_PUBLISHERS:
            _publishers.popitem(last=False)  # which is there again with its next sample


def _known_source(sample: CrossingSample) -> zenoh.SourceInfo | None:
    """Return the `SourceInfo` of a sample if a gateway of this process knows its publisher."""
    publisher = None if sample.source is None else _publishers.get(sample.source[0])
    return None if sample.source is None or publisher is None else zenoh.SourceInfo(publisher, sample.source[1])
