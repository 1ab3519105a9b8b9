"""Programs of a live run: processes over Zenoh, on this machine, on hosts, or started by hand.

`LiveProcesses` takes what Zenoh's threads bring on the run's loop, welcomes processes, before the start and when
they return, hands their yields and frames to the loop of the pacing, and does to them what faults do. Through the
`Supervisor` the system and the connections tell of the ends of processes.
"""

from __future__ import annotations

import asyncio
import dataclasses
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Coroutine, Sequence
from typing import Any

import zenoh
from msgspec.structs import replace

from emulator.drivers.attachment import Attachment, LiveOptions
from emulator.drivers.emulation import Emulation, ProcessActions
from emulator.drivers.join import Membership, split_into_processes
from emulator.drivers.launch import Exit, Launcher
from emulator.drivers.live.fleet import Fleet
from emulator.drivers.live.gateways import Gateways
from emulator.drivers.live.supervisor import DEATH_GRACE_S, ChangeSignal, ProcessState, Supervisor
from emulator.drivers.processes import Heard, Processes, ProtocolError, Stalled, check_ownership, check_yield
from emulator.drivers.realtime import RealTime, take_what_comes
from emulator.drivers.router import ROUTER
from emulator.records.events import KINDS, EventKind
from emulator.scenario.faults import EmulatorRestart, Infrastructure
from emulator.viewer.sinks import Sinks
from vnet.errors import ProgramError, TransportError, VnetError, WireError, counted, first_names
from vnet.runtime.arrivals import Mail
from vnet.runtime.die_with_parent import STARTED_BY_VNET
from vnet.transport import keys, wire
from vnet.transport.access import OBSERVER, host_user
from vnet.transport.wire import Contents, MessageRef, SentMessage, refs_of

RECORDER = "recorder"
RECORDER_POLL_S = 0.05
"""Seconds between two looks whether the recorder listens: nothing tells of it."""
LAUNCHER_POLL_S = 0.005
"""Seconds between two looks whether agents can be started."""
STARTED_AT_ONCE = 20
"""Processes that are started before messages are taken again."""
FINAL_WAIT_S = 1.0
"""Seconds for which the last message of a process that a fault ends is awaited."""
LATE_WAIT_S = 1.0
"""Seconds for which messages of the backbone are awaited at the end: they and frames come by keys of their own."""
STACKS_WAIT_S = 1.0
"""Seconds after which the emulator looks whether processes that do not yield have sent their stacks."""
STACKS_LOOKS = 5
"""Number of looks after which it does without what is missing."""
AWAIT_WARNING_S = 0.2
"""Seconds between the announcement of a restart to the agents and the end of the connection."""
ANSWER_POLL_S = 0.1
"""Seconds between two requests to those who have not answered over the new connection."""


class LiveProcesses(Processes):
    """See the module's text. `on_query` takes an operator's query; `attach` makes the emulator's end of the wire.

    Before `begin` there is no emulated time, and processes may only join. To be made on the run's loop.
    """

    def __init__(
        self,
        emulation: Emulation,
        options: LiveOptions,
        launcher: Launcher,
        on_query: Callable[[str, zenoh.Query], None],
        attach: Callable[..., Attachment] = Attachment,
    ) -> None:
        run, node_ids = emulation.scenario.run, emulation.world.node_ids
        self._emulation, self._options, self._launcher, self._on_query = emulation, options, launcher, on_query
        self._realtime = run.pacing == "realtime"
        self._loop = asyncio.get_running_loop()
        self._incoming: deque[tuple[int, str, str, Any]] = deque()
        self._arrived_ns = 0
        """Instant of the monotonic clock at which the message that is being taken has come."""
        self._wake_pending = self._closed = False
        self._takes: dict[str, Callable[[str, Any], None]] = {
            "message": self._take_message,
            "backbone": self._take_backbone,
            "token": self._take_token,
            "query": self._take_query,
            "host_message": lambda host, payload: None if self.fleet is None else self.fleet.take(host, payload),
            "host_token": lambda host, alive: None if self.fleet is None else self.fleet.take_token(host, alive),
            "ended": lambda process_id, how: self.supervisor.child_ends(process_id, how),
            "lost": lambda how, process_ids: self.supervisor.host_lost(process_ids, how),
            "memory": self._take_memory,
            "local": self._take_decoded,
            "frames": lambda node, heard: self._take_frames(node, *heard),
            "gateway": self._take_from_gateway,
        }
        self.time_ns: Callable[[], int] = lambda: 0
        """Emulated time, for events."""
        self.changes = ChangeSignal()
        later = [node for node, up in emulation.up.items() if not up]
        self.members = Membership(node_ids, later, emulation.world.has_traffic)
        has_gateways = emulation.scenario.has_gateways
        self.attachment = attach(options, node_ids, self._realtime, self.hear, not has_gateways)
        self.fleet = self._make_fleet() if options.access.hosts else None
        self.gateways = self._make_gateways() if has_gateways else None
        if self.gateways is not None:
            self._options = options = dataclasses.replace(options, launch=True)  # gateways, if not their programs
        self._agents = self.gateways or self.fleet or launcher
        self.supervisor = Supervisor(
            emulation,
            options,
            launcher,
            self._agents,
            self.members,
            self.attachment,
            self.say,
            self._now,
            self.changes,
        )
        self._expected: type | None = None
        """The messages of the pacing, once it has begun."""
        self._heard: deque[Heard] = deque()
        self._granted: dict[str, int] = {}
        """Processes that owe a yield, and the instant that each has come to, as far as it has said."""
        self._windows: dict[str, wire.Grant] = {}
        self._incomplete: dict[str, wire.Yield] = {}
        """Yields that refer to messages of the backbone that have not come."""
        self._sent: Contents[SentMessage] = Contents()
        """Messages that units have put on the backbone, and to which nothing has referred yet."""
        self.late: set[MessageRef] = set()
        """Messages of the backbone to which frames have referred and that have not come (real time)."""
        self._so_far: dict[str, wire.Traffic] = {}
        """Exceptions left unhandled so far in processes that are to end, until their last message comes."""
        self._finals: dict[str, wire.Traffic] = {}
        self.connected: set[str] = set()
        """Nodes that hold a connection."""
        self.over_memory: list[tuple[str, float]] = []
        """Processes on hosts that hold more memory than the limit, and their megabytes."""
        self._stacks: dict[str, wire.StackDump] = {}
        self._refused: Counter[str] = Counter()
        self._reasons: dict[str, str] = {}
        """Reasons of the last refused messages, of nodes whose next yield has not come."""
        self._failure: VnetError | None = None
        self._bug: Exception | None = None
        self._loop.set_exception_handler(self._fail)
        self.attachment.open()

    def _make_fleet(self) -> Fleet:
        return Fleet(
            self._options.access,
            self._emulation,
            self.attachment.send_host,
            self.take,
            self._now,
            lambda: self.supervisor.reconnecting,
            self.changes,
        )

    def _make_gateways(self) -> Gateways:
        launcher, starts = self._launcher, self._options.launch
        return Gateways(self._emulation, launcher, starts, self.hear, self.take, self._now, self.changes)

    def _now(self) -> int:
        return self.time_ns()

    # What comes: from Zenoh's threads to the loop, in order.

    def hear(self, what: str, name: str, item: Any) -> None:
        """Enqueue what has come (a key of `_takes`), with a name and a payload or a state; on any thread."""
        self._incoming.append((time.monotonic_ns(), what, name, item))
        if not self._wake_pending and not self._closed:
            self._wake_pending = True
            self._loop.call_soon_threadsafe(self._drain)

    def close(self) -> None:
        """Take nothing any more."""
        self._closed = True
        self._loop.set_exception_handler(None)

    def _fail(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Have the run end with the exception of a callback: asyncio would only print it."""
        error = context.get("exception")
        if isinstance(error, Exception) and "future" not in context:
            self._bug = self._bug or error
            self.changes.set()
        else:
            loop.default_exception_handler(context)

    def _drain(self) -> None:
        self._wake_pending = False
        while self._incoming and not self._closed:
            self._arrived_ns, *told = self._incoming.popleft()
            self.take(*told)

    def take(self, what: str, name: str, item: Any) -> None:
        """Take what has come, on the loop."""
        self._takes[what](name, item)

    def _take_message(self, node: str, payload: bytes) -> None:
        try:
            self._take_decoded(node, wire.decode_tx(payload))
        except (WireError, ProtocolError) as error:
            self._refuse(keys.node_tx(self._options.access.run, node), node, str(error))
            self._reasons[node] = str(error)

    def _take_decoded(self, node: str, message: wire.AgentMessage) -> None:
        """Take a message on the key of a node, or of its gateway. Raises ProtocolError."""
        # A hello introduces its nonce; Membership judges it.
        if type(message) is not wire.Hello and not self.members.speaks_for(node, message.nonce):
            if type(message) is wire.Final and self._expected is None:
                return  # who had not joined answers the end of a run that does not begin
            raise ProtocolError("a message without the nonce of its process")
        match message:
            case wire.Yield() if self._expected is wire.Yield:
                self._take_yield(node, message)
                self._reasons.pop(node, None)
            case wire.Frames() if self._expected is wire.Frames:
                self._take_frames(node, message, self._arrived_ns)
            case wire.Frames(final=True) if self._realtime and self._expected is None:
                pass  # the answer to the end of a run that does not begin
            case wire.Hello():
                self._take_hello(node, message)
            case wire.Final():
                self._take_final(node, message)
            case wire.StackDump():
                self._stacks[node] = message
                if self._expected is wire.Frames:
                    self._heard.append(Heard(node, message, self._arrived_ns))
                    self.changes.set()
            case _:
                raise ProtocolError(f"an unexpected {type(message).__name__}")

    def _take_from_gateway(self, what: str, item: Any) -> None:
        if self.gateways is not None:
            self.gateways.take(what, item, self._arrived_ns)

    def _take_backbone(self, unit: str, payload: bytes) -> None:
        try:
            sent = wire.decode_sent(payload)
            if not self.members.is_of(unit, sent.nonce):
                raise ProtocolError("a message without the nonce of its process")
            self._take_sent(sent.message(unit))
        except (WireError, ProtocolError) as error:
            self._refuse(keys.backbone_tx(self._options.access.run, unit), unit, str(error))

    def _take_token(self, node: str, alive: bool) -> None:
        """Take note that the connection of a node has appeared or is gone."""
        if alive:
            self.connected.add(node)
            return
        self.connected.discard(node)
        self.supervisor.disconnected(node)
        self.changes.set()

    def _take_query(self, verb: str, query: zenoh.Query) -> None:
        self._on_query(verb, query)
        self.changes.set()

    def _take_memory(self, process_id: str, memory_mb: float) -> None:
        self.over_memory.append((process_id, memory_mb))

    def refuse(self, process_id: str, error: ProtocolError) -> None:
        """Refuse the last message of a process, which owes another one."""
        self._refuse(keys.node_tx(self._options.access.run, process_id), process_id, str(error))
        self._reasons[process_id] = str(error)
        if self._expected is wire.Yield and self.supervisor.is_there(process_id):
            self._granted.setdefault(process_id, self._now())

    def _refuse(self, key: str, node: str, reason: str) -> None:
        """Count a refused message, and log the first of each key."""
        if key not in self._refused:
            self._emulation.folder.event(self._now(), EventKind.refused, node, key=key, reason=reason)
        self._refused[key] += 1

    def write_refused(self) -> None:
        """Log how many messages were refused, by key."""
        for key, count in self._refused.items():
            self._emulation.folder.event(self._now(), EventKind.refused_total, key=key, count=count)

    # Joining, at the start and when processes return.

    def _take_hello(self, node: str, hello: wire.Hello) -> None:
        """Welcome a node, or tell it why it is refused."""
        refusal: str | None
        if hello.version != wire.VERSION:
            refusal = wire.other_version("agent", hello.version, "emulator")
        elif (refusal := self.members.hello(node, hello)) and self.supervisor.has_died(hello.process_id):
            refusal = f"{node} was here and has gone; the run goes on without it"
        if refusal is not None:
            self._refuse(keys.node_tx(self._options.access.run, node), node, refusal)
            if self.attachment.knows(node):
                self.say(node, wire.End(hello.nonce, refusal, refused=True))
            return
        if hello.failure is not None:
            self._failure = ProgramError(f"{node}: {hello.failure}")
        elif not hello.ready:
            self.say(node, self._emulation.welcome(node, hello.nonce))
        self.changes.set()

    async def join(
        self, on_state: Callable[[str], None], on_missing: Callable[[Sequence[str]], None]
    ) -> list[list[str]]:
        """Start what is to be started and wait until every node is ready; returns the nodes of each process.

        Raises VnetError if a process ends or a program cannot be loaded, TransportError if nodes are missing in the
        end.
        """
        timeout_s = self._emulation.scenario.run.join_timeout_s
        deadline = time.monotonic() + timeout_s
        await self._start_processes(on_state, deadline)
        missing: list[str] = []
        while self.members.missing or not self._recorder_listens():
            if missing != self.members.missing:
                missing = self.members.missing
                on_missing(missing)
            if failure := self._bug or self._failure or self.supervisor.failure:
                raise failure
            if time.monotonic() > deadline:
                absent, total = self.members.missing or ["the recorder"], len(self._emulation.world.node_ids)
                if self.gateways is not None and self.members.missing:
                    raise TransportError(self.gateways.missed(absent, timeout_s))
                raise TransportError(
                    f"{len(absent)} of {total} nodes have not joined within {timeout_s:g} s: {first_names(absent)}"
                )
            await self.changes.wait(RECORDER_POLL_S if self._options.record else deadline - time.monotonic())
        self.members.closed = True
        on_missing([])
        return self.members.processes()

    async def _start_processes(self, on_state: Callable[[str], None], deadline: float) -> None:
        node_ids, endpoint, later = self._emulation.world.node_ids, self.attachment.endpoint, self.members.later
        groups = split_into_processes(node_ids, self._emulation.scenario.run.nodes_per_process)
        groups = [nodes for nodes in groups if nodes[0] not in later]
        if self._options.record is not None:
            self._start_recorder(endpoint, self._options.record.inside(self._emulation.folder.path))
        hosts = list(self._options.access.hosts)
        if hosts:
            self._start_hosts(endpoint)
            on_state(f"listening at {endpoint}; waiting for {counted(len(hosts), 'host')}: {first_names(hosts)}")
        if self.gateways is not None:
            on_state(f"opening {counted(len(groups), 'endpoint')} for Zenoh programs")
            self.gateways.on_state = on_state
            self.supervisor.launch(groups)
        elif self._options.launch:
            await self._agents_prepared(deadline)
            where = f" on {counted(len(hosts), 'host')}" if hosts else ""
            agents = counted(len(groups), "agent process", "agent processes")
            on_state(f"listening at {endpoint}; starting {agents}{where}")
            for first in range(0, len(groups), STARTED_AT_ONCE):
                self.supervisor.launch(groups[first : first + STARTED_AT_ONCE])
                await asyncio.sleep(0)  # those that have joined meanwhile are welcomed
        else:
            on_state(f"listening at {endpoint}; waiting for {len(node_ids) - len(later)} vehicles")

    async def _agents_prepared(self, deadline: float) -> None:
        """Wait until agents can be started. Raises VnetError if they cannot, TransportError after the deadline."""
        while not self._agents.is_prepared():
            if failure := self.supervisor.failure:
                raise failure
            if time.monotonic() > deadline:
                timeout_s = self._emulation.scenario.run.join_timeout_s
                raise TransportError(f"not ready within {timeout_s:g} s: {first_names(self._agents.missing)}")
            await asyncio.sleep(LAUNCHER_POLL_S)

    def _start_hosts(self, endpoint: str) -> None:
        """Start the hosts that are processes of this machine."""
        access = self._options.access
        for host in access.hosts if self._options.start_hosts else ():
            arguments = ["-P", "-m", "emulator", "host", "--connect", endpoint, "--run", access.run]
            for folder in self._emulation.scenario.program.folders:
                arguments += ["--path", str(folder)]
            self._launcher.start(
                host_user(host), arguments, access.credentials(host_user(host)), {STARTED_BY_VNET: "1"}
            )

    def _start_recorder(self, endpoint: str, sinks: Sinks) -> None:
        arguments = ["-P", "-m", "emulator", "record", "--connect", endpoint, "--run", self._options.access.run]
        arguments += ["--out", str(sinks.save), *sinks.arguments]
        credentials = self._options.access.credentials(OBSERVER)
        self._launcher.start(RECORDER, arguments, credentials, {}, own_session=True)

    def _recorder_listens(self) -> bool:
        return self._options.record is None or self.attachment.is_watched("period")

    # The run: grants and batches out, yields and frames in.

    def begin(self, processes: Sequence[Sequence[str]], time_ns: Callable[[], int]) -> None:
        """Take messages of the pacing from now on, from these processes; `time_ns` gives the emulated time."""
        self.time_ns = time_ns
        self.supervisor.begin(processes)
        self._expected = wire.Frames if self._realtime else wire.Yield

    def send(self, process_id: str, message: wire.Grant | wire.Batch, mail: Mail | None = None) -> None:
        """Give a process a window, with its mail, or a batch."""
        if isinstance(message, wire.Grant):
            self._granted[process_id] = message.time_ns
            self._windows[process_id] = message
            message = message if mail is None else mail.within(message)
        self.say(process_id, message)

    def say(self, node: str, message: wire.EmulatorMessage) -> None:
        """Say something to a node, having put the messages of units in it on their keys."""
        way = self.gateways or self.fleet or self.attachment
        if isinstance(message, wire.Grant | wire.Batch) and message.messages:
            message, contents = wire.split_grant(message)
            for unit, content in contents:
                way.send_content(unit, wire.encode(content))
        way.send(node, message)

    async def receive(self, timeout_s: float = math.inf) -> Heard | None:
        """Wait for the next message; None if something else has come up. In lockstep no yield for long stalls."""
        if not self._heard and timeout_s > 0:
            if self._realtime:
                await self.changes.wait(timeout_s)
            else:
                await self._await_yields()
        if self._bug is not None:
            raise self._bug
        return self._heard.popleft() if self._heard else None

    async def _await_yields(self) -> None:
        """Wait until all owed yields are there, or something else has come up. Raises Stalled."""
        timeout_s = self._emulation.scenario.run.stall_timeout_s
        patience_s = math.inf if self._waits_for_user() else timeout_s
        if await self.changes.wait(patience_s) or await self._has_progressed():
            return
        if self._granted:  # yields that their host kept for the sake of another process have come since
            self._stall(sorted(self._granted), timeout_s)

    def _waits_for_user(self) -> bool:
        """Return whether a process that owes a yield may be in a debugger: its user takes what time it takes."""
        debug = self._options.debug
        return debug is not None and self.members.process_of(debug.node) in self._granted

    def _take_yield(self, process_id: str, message: wire.Yield) -> None:
        """Take a yield, once the messages of the backbone have come to which it refers."""
        if process_id not in self._granted:
            raise ProtocolError(f"yield {message.seq} of {process_id}: none is owed")
        window = self._windows[process_id]  # the barrier would refuse it only when all others have yielded
        if message.seq != window.seq:
            raise ProtocolError(f"yield {message.seq} of {process_id}: expected {window.seq}")
        check_yield(self.members.nodes_with(process_id), message, window.time_ns, window.end_ns, window.quiet_ns)
        self._incomplete.pop(process_id, None)
        if refs := refs_of(message):
            self._check_refs(process_id, refs)
            if self._sent.missing(refs):
                self._incomplete[process_id] = message
                return
            message = wire.join_yield(message, self._sent)
        del self._granted[process_id]
        self._heard.append(Heard(process_id, message))
        if not self._granted:
            self.changes.set()

    def _take_frames(self, process_id: str, message: wire.Frames, arrived_ns: int) -> None:
        """Take frames and acknowledgements, with those messages of the backbone that are here."""
        if refs := message.traffic.messages:
            self._check_refs(process_id, refs)
            here, missing = self._sent.split(refs)
            if self._now() < self._emulation.duration_ns:  # later ones are sent to nobody
                self.late.update(missing)
            message = replace(message, traffic=replace(message.traffic, messages=here))
        if message.final:
            self._so_far.pop(process_id, None)
        self._heard.append(Heard(process_id, message, arrived_ns))
        self.changes.set()

    def _take_sent(self, message: SentMessage) -> None:
        """Take what a unit has put on the backbone: it is sent when its process refers to it, or now if it has."""
        self._sent.add(message)
        process_id, ref = self.members.process_of(message.node), MessageRef(message.node, message.number)
        if process_id in self._incomplete and process_id in self._granted:
            self._take_yield(process_id, self._incomplete[process_id])
        elif ref in self.late:
            self.late.discard(ref)
            (sent,), _ = self._sent.split([ref])
            self._heard.append(Heard(process_id, sent, self._arrived_ns))
            self.changes.set()

    def _check_refs(self, process_id: str, refs: Sequence[MessageRef]) -> None:
        """Raise ProtocolError if a process refers to what others have sent."""
        check_ownership(self.members.nodes_with(process_id), wire.Traffic(messages=refs))

    def ended(self, among: Collection[str] | None = None) -> dict[str, dict[str, Any]]:
        """Return the deaths of processes, of all or `among` these, that have not been returned yet."""
        deaths = self.supervisor.take_deaths(among)
        for process_id in deaths:
            self._granted.pop(process_id, None)
        return deaths

    def returned(self) -> list[str]:
        """Return the processes that were started and have become ready since the last call."""
        return self.supervisor.take_returned()

    # Stalls.

    async def _has_progressed(self) -> bool:
        """Ask the processes that do not yield for their stacks; returns whether one is at a later instant."""
        asked = sorted(self._granted)
        self._stacks.clear()
        for process_id in asked:
            self.say(process_id, wire.StackRequest())
            self._agents.request_stack(process_id)
        for _ in range(STACKS_LOOKS):  # on a busy machine an answer takes its time
            await asyncio.sleep(STACKS_WAIT_S)
            if all(process_id in self._stacks for process_id in asked):
                break
        progressed = False
        for process_id, dump in self._stacks.items():
            if dump.time_ns is not None and self._granted.get(process_id, dump.time_ns) < dump.time_ns:
                self._granted[process_id] = dump.time_ns
                progressed = True
        return progressed

    def _stall(self, process_ids: Sequence[str], timeout_s: float) -> None:
        """Give up, and write down where the processes are that do not yield."""
        for process_id in process_ids:
            dump = self._stacks.get(process_id)
            refused = self._reasons.get(process_id)
            self._emulation.folder.event(
                self._now(),
                EventKind.stalled,
                process_id,
                error=f"{self._lacking(process_id)} within {timeout_s:g} s of wall clock; "
                f"{self.members.describe(process_id)}",
                where=(dump.text if dump else "") or self._agents.log_tail(process_id),
                **({} if refused is None else {"refused": refused}),
            )
        raise Stalled

    def _lacking(self, process_id: str) -> str:
        """Return what has not come of a process."""
        if process_id not in self._incomplete:
            return "no yield"
        missing = self._sent.missing(refs_of(self._incomplete[process_id]))
        messages = f"{counted(len(missing), 'message')} of {missing[0].node} on the backbone"
        return f"yield {self._incomplete[process_id].seq} without {messages}, to which it refers,"

    # Faults and trips.

    async def act(self, actions: ProcessActions) -> None:
        """Do to the processes what the faults and the trips of an instant do. Raises Stalled."""
        process_of = self.members.process_of
        for process_id, killed in {process_of(node): killed for node, killed in actions.stop.items()}.items():
            has_left = self._emulation.presence.is_outside(process_id)
            reason = "killed by a fault" if killed else "it has left" if has_left else "restarted by a fault"
            await self.supervisor.end(process_id, killed, reason, actions.time_ns)
            if not killed and not self._realtime:
                await self._await_final(process_id, actions.time_ns)
        begun = list(dict.fromkeys(map(process_of, actions.start)))
        for process_id in begun:  # what earlier processes of these names have put on the backbone
            self._sent.drop(self.members.nodes_with(process_id))
        self.late = {ref for ref in self.late if process_of(ref.node) not in begun}
        self.supervisor.begin_again(begun)
        if not self._realtime:
            await self._await_returned(begun)
        self.supervisor.pause({process_of(node) for node in actions.paused})
        for fault in actions.restarts:
            await self._restart(fault)

    async def _await_returned(self, process_ids: Sequence[str]) -> None:
        """Wait until processes that have been started are ready: they may be granted the instant that comes."""
        timeout_s = self._emulation.scenario.run.join_timeout_s
        deadline = time.monotonic() + timeout_s
        while late := self.supervisor.returning_nodes(process_ids):
            if not await self.changes.wait(deadline - time.monotonic()):
                self._give_up(late[0], f"has not come back within {timeout_s:g} s")
        self.supervisor.take_returned()

    def _give_up(self, process_id: str, error: str) -> None:
        self._emulation.folder.event(self._now(), EventKind.stalled, process_id, error=error)
        raise Stalled

    async def _restart(self, fault: Infrastructure) -> None:
        """Announce a restart of the emulator or its router, restart, and wait until all have answered."""
        if self.gateways is not None and not isinstance(fault, EmulatorRestart):
            self.gateways.restart_endpoints(fault.down_s)
            return
        patience_s = fault.down_s + self._emulation.scenario.run.join_timeout_s
        for node in self._connected_nodes():
            self.say(node, wire.Await(patience_s))
        # In real time a paused process cannot answer: it has time until it goes on.
        answering = [ProcessState.RUNNING] if self._realtime else [ProcessState.RUNNING, ProcessState.PAUSED]
        process_ids = sorted({self.members.process_of(node) for node in self._connected_nodes()})
        process_ids = [process_id for process_id in process_ids if self.supervisor.state(process_id) in answering]
        await asyncio.sleep(AWAIT_WARNING_S)
        self.supervisor.reconnecting = True
        if isinstance(fault, EmulatorRestart):
            cancelled = await to_its_end(asyncio.to_thread(self.attachment.close))
            try:
                await asyncio.sleep(0.0 if cancelled else fault.down_s)
            except asyncio.CancelledError:  # as the run is interrupted, all are told of its end
                cancelled = True
            cancelled |= await to_its_end(asyncio.to_thread(self.attachment.open, again=True))
            if cancelled:
                self._tell_restarted(fault)  # until now all were silent by plan
                raise asyncio.CancelledError
        else:
            self._launcher.kill(ROUTER)
            await asyncio.sleep(fault.down_s)
            assert self._options.router is not None
            await asyncio.to_thread(self._options.router.start, self._launcher)
        await self._all_answer(process_ids, patience_s)
        self.supervisor.reconnecting = False
        self._tell_restarted(fault)

    def _tell_restarted(self, fault: Infrastructure) -> None:
        self._emulation.folder.event(self._now(), KINDS[f"{fault.kind}ed"], None, down_s=fault.down_s)

    def _connected_nodes(self) -> list[str]:
        """The nodes that are up and whose processes are there.

        The emulation may be ahead: a node that is up there again need not have been started yet.
        """
        gone = self.supervisor.processes_in(ProcessState.AWAY, ProcessState.RETURNING)
        up = [node for node in self._emulation.world.node_ids if self._emulation.up[node]]
        return [node for node in up if self.members.process_of(node) not in gone]

    async def _all_answer(self, process_ids: Sequence[str], patience_s: float) -> None:
        """Wait until each process has answered: only then do messages pass in both directions again."""
        dead = ProcessState.DEAD
        self._stacks.clear()
        deadline = time.monotonic() + patience_s
        while silent := [
            id_ for id_ in process_ids if id_ not in self._stacks and self.supervisor.state(id_) is not dead
        ]:
            if time.monotonic() > deadline:
                self._give_up(silent[0], f"has not found the emulator again within {patience_s:g} s")
            for process_id in silent:
                self.say(process_id, wire.StackRequest())
            await asyncio.sleep(ANSWER_POLL_S)
        self._stacks.clear()

    # The end of processes, by a fault or with the run.

    def _take_final(self, process_id: str, message: wire.Final) -> None:
        """Take what is unhandled in a process before its programs are ended, and its last message (lockstep)."""
        if self._expected is None:  # it means nothing before the run
            return
        check_ownership(self.members.nodes_with(process_id), message.traffic)
        if message.provisional:
            self._so_far[process_id] = message.traffic
            self.say(process_id, wire.End(message.nonce, "taken"))
        elif not self._realtime:
            self._so_far.pop(process_id, None)
            self._finals[process_id] = message.traffic
            self.changes.set()

    async def _await_final(self, process_id: str, time_ns: int) -> None:
        """Wait for the last message of a process that a fault ended at `time_ns`."""
        await self._all_final([process_id], time.monotonic() + FINAL_WAIT_S)
        so_far = self._so_far.pop(process_id, None)
        if (traffic := self._finals.pop(process_id, so_far)) is not None:
            self._emulation.take_final(time_ns, [traffic], by_fault=True)

    async def _all_final(self, process_ids: Collection[str], deadline_s: float) -> None:
        """Wait until these processes have sent their last message, or have gone without: it is optional."""
        while missing := [process_id for process_id in process_ids if process_id not in self._finals]:
            if self.connected.isdisjoint(missing):
                deadline_s = min(deadline_s, time.monotonic() + DEATH_GRACE_S)
            if not await self.changes.wait(deadline_s - time.monotonic()):
                return

    def tell_to_end(self) -> None:
        """Tell all that the run is over."""
        self.supervisor.pause(())
        for node in self.members.joined:
            self.say(node, wire.End(None, "the run is over", time_ns=self._emulation.ended_ns))
        self.supervisor.all_told_to_end()

    async def last_traffic(self, deadline_s: float) -> list[wire.Traffic]:
        """Return what processes have told as they were ended, or had unhandled if they have gone without a word.

        In lockstep last messages are awaited until `deadline_s` on the monotonic clock; in real time it is frames.
        """
        if not self._realtime:
            there = self.supervisor.processes_in(ProcessState.RUNNING, ProcessState.PAUSED)
            await self._all_final(there, deadline_s)
        return [*self._finals.values(), *self._so_far.values()]

    async def finish_real_time(self, realtime: RealTime, deadline_s: float) -> None:
        """Wait for the last acknowledgements and late messages, and decide what nobody has acknowledged."""
        away = ProcessState.AWAY
        await take_what_comes(realtime, self, 0.0)
        while not realtime.awaited <= set(self.supervisor.processes_in(away)) and time.monotonic() < deadline_s:
            await take_what_comes(realtime, self, deadline_s - time.monotonic())
        deadline_s = min(deadline_s, time.monotonic() + LATE_WAIT_S)
        while self.late and time.monotonic() < deadline_s:
            await take_what_comes(realtime, self, deadline_s - time.monotonic())
        realtime.gaps += len(self.late)
        self._emulation.take_final(self._emulation.duration_ns, await self.last_traffic(deadline_s))
        realtime.finish()
        await self.supervisor.all_ended()

    async def all_disconnected(self, deadline_s: float) -> None:
        """Wait for those that others have started: whoever closes at once may take the last messages along."""
        while self.connected and await self.changes.wait(deadline_s - time.monotonic()):
            pass

    def last_deaths(self, ends: dict[str, Exit]) -> dict[str, dict[str, Any]]:
        """Return the details of the deaths since all were told to end, by node; `ends` have just been seen."""
        deaths = self.supervisor.take_last_deaths(ends)
        return {node: details for id_, details in deaths.items() for node in self.members.nodes_with(id_)}


async def to_its_end(work: Coroutine[Any, Any, None]) -> bool:
    """Await something to its end, whatever cancels the present task meanwhile; return whether anything has."""
    task, cancelled = asyncio.ensure_future(work), False
    while not task.done():
        try:
            await asyncio.shield(task)
        except asyncio.CancelledError:
            cancelled = True
    task.result()
    return cancelled
