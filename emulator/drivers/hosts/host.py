"""The process of `vnet host`: the agents of one host, and one connection to the emulator for all of them.

One thread does everything in the order in which it comes: messages from both sides, and ends of processes. Zenoh's
threads and signal handlers only append to its queue.
"""

from __future__ import annotations

import os
import queue
import secrets
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import zenoh

from emulator.drivers.agent_keys import AgentKeys, Hear
from emulator.drivers.hosts import messages
from emulator.drivers.hosts.messages import Call, Calls, HostHello, HostWelcome, encode
from emulator.drivers.launch import Launcher, Zygote, can_fork
from emulator.drivers.signals import signals_handled
from emulator.drivers.usage import CpuWatch, MemoryWatch, first_over
from emulator.records.code_digest import vnet_digest
from vnet.errors import TransportError, VnetError, WireError, counted
from vnet.transport import keys, wire
from vnet.transport.access import LEASE_MS, Access
from vnet.transport.credentials import Credentials
from vnet.transport.scheduling import PROMPT_SLICE_NS, set_time_slice
from vnet.transport.session import open_client, open_router, router_endpoint

# What a host's agents say is bundled, and put on the way to the emulator. In lockstep the emulator waits for all
# that it has granted, so the yields of a host can wait for each other; everything else must not wait.

FULL_BYTES = 8 * 2**20
"""Bytes of agents' messages after which a bundle goes at once, so that none comes near the largest message."""


class Relay:
    """Items for the emulator in the order in which they came, and the processes that owe a yield."""

    def __init__(self) -> None:
        self._items: list[Call] = []
        self._size_bytes = 0
        self.is_urgent = False
        """True if what there is goes at once: the emulator waits for more than yields."""
        self.awaited: set[str] = set()
        """The processes that owe a yield."""

    def take(self, node: str, payload: bytes) -> None:
        """Take a message of an agent, which is on the `tx` of `node`; yields are on that of their process."""
        self._items.append(("message", node, payload))
        self._size_bytes += len(payload)
        if wire.is_yield(payload):
            self.awaited.discard(node)
        else:
            self.is_urgent = True

    def take_unit(self, unit: str, payload: bytes) -> None:
        """Take a message of a unit on its key of the backbone: it waits for the yield that refers to it."""
        self._items.append(("backbone", unit, payload))
        self._size_bytes += len(payload)

    def add(self, item: Call) -> None:
        """Take news of the host itself, which goes at once."""
        self._items.append(item)
        self.is_urgent = True

    def take_bundle(self) -> list[Call]:
        """Return what is to go now: nothing while all that there is are yields, and one is owed."""
        is_due = self.is_urgent or not self.awaited or self._size_bytes >= FULL_BYTES
        if not is_due:
            return []
        bundle, self._items, self._size_bytes, self.is_urgent = self._items, [], 0, False
        return bundle


LISTEN = "tcp/127.0.0.1:0"
"""Agents are on the same host."""


class Down:
    """The router of a host's agents. What they say is heard on Zenoh's threads."""

    def __init__(self, access: Access, realtime: bool, hear: Hear) -> None:
        self.access = access
        self._realtime = realtime
        self._hear = hear
        self._emulator_token: zenoh.LivelinessToken | None = None

    def open(self, stack: ExitStack) -> None:
        """Listen until `stack` is closed. Raises TransportError."""
        access, session = self.access, stack.enter_context(open_router(LISTEN, self.access))
        self._session = session
        self.endpoint = router_endpoint(session)
        nodes = [node for nodes in access.processes for node in nodes]
        self.agents = AgentKeys(session, access.run, nodes, access.units, self._realtime, self._hear, stack)
        self.show_emulator(True)
        stack.callback(self.show_emulator, False)

    def show_emulator(self, there: bool) -> None:
        """Let agents see that the emulator is there, or that it is gone."""
        if there and self._emulator_token is None:
            token_key = keys.emulator_alive(self.access.run)
            self._emulator_token = self._session.liveliness().declare_token(token_key)
        elif not there and self._emulator_token is not None:
            self._emulator_token.undeclare()  # type: ignore[no-untyped-call]
            self._emulator_token = None


class Up:
    """The keys of a host. The callbacks run on Zenoh's threads."""

    def __init__(
        self,
        endpoint: str,
        run: str,
        host: str,
        credentials: Credentials | None,
        on_rx: Callable[[bytes], None],
        on_emulator: Callable[[bool], None],
        stack: ExitStack,
    ) -> None:
        """Connect until `stack` is closed. Raises TransportError."""
        self.nonce = secrets.token_bytes(16)
        session = stack.enter_context(open_client(endpoint, credentials, LEASE_MS))
        self._tx = stack.enter_context(
            session.declare_publisher(
                keys.host_tx(run, host), congestion_control=zenoh.CongestionControl.BLOCK, express=True
            )
        )
        rx = keys.host_rx(run, host)
        stack.enter_context(session.declare_subscriber(rx, lambda sample: on_rx(sample.payload.to_bytes())))
        stack.enter_context(session.liveliness().declare_token(keys.host_alive(run, host)))
        stack.enter_context(
            session.liveliness().declare_subscriber(
                keys.emulator_alive(run),
                lambda sample: on_emulator(sample.kind == zenoh.SampleKind.PUT),
                history=True,
            )
        )

    def say_hello(self, hello: HostHello) -> None:
        """Put a hello."""
        self._tx.put(encode(hello))

    def put(self, items: Sequence[Call]) -> None:
        """Put a bundle."""
        self._tx.put(encode(Calls(self.nonce, items)))


HELLO_PERIOD_S = 0.5
READY_POLL_S = 0.005
"""Seconds between two looks whether agents can be started."""
STACKS_WRITTEN_S = 0.3
"""Seconds that a process has for writing its stacks to its log."""
SHUT_DOWN_S = 1.0
"""Seconds for which agents may end by themselves when the host ends without having been told to."""
CHILD_SIGNALS = {signal.SIGSTOP, signal.SIGCONT, signal.SIGUSR1}
"""The signals that the emulator sends to agents."""

Event = tuple[str, str, Any]
"""Entry of the queue that threads fill: its kind, a node's id or "", and a payload or a state."""


def run_host(
    endpoint: str,
    run: str,
    name: str,
    credentials: Credentials | None,
    folders: Sequence[Path],
    join_timeout_s: float,
    on_state: Callable[[str], None],
) -> None:
    """Be the host `name` of `run` at `endpoint` to the end of the run; agents look for programs in `folders` too.

    Raises TransportError (cannot join, refused, the emulator is gone) and VnetError (agents cannot be started).
    """
    with ExitStack() as stack:
        set_time_slice(PROMPT_SLICE_NS)  # Zenoh's threads have it too
        events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        up = Up(
            endpoint,
            run,
            name,
            credentials,
            lambda payload: events.put(("rx", "", payload)),
            lambda there: events.put(("emulator", "", there)),
            stack,
        )
        join = _Join(up, name, events, join_timeout_s)
        welcome = join.until_welcome()
        agents = counted(len(welcome.processes), "agent process", "agent processes")
        on_state(f"host {name}: {agents} of run {run}")
        try:
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="vnet-host-")))
            (folder / "logs").mkdir()
            zygote = Zygote(welcome.modules) if welcome.start == "fork" and can_fork() else None
            launcher = Launcher(folder / "logs", folders, zygote, join_timeout_s)
            launcher.disks = folder / "disks"
            stack.callback(launcher.stop, SHUT_DOWN_S)
            down = Down(
                Access.create(run, welcome.processes, units=welcome.units),
                welcome.realtime,
                lambda *event: events.put(event),
            )
            stack.enter_context(signals_handled(lambda *_: events.put(("children", "", None)), signal.SIGCHLD))
            launcher.prepare()
            down.open(stack)
            while not launcher.is_prepared():
                time.sleep(READY_POLL_S)
        except OSError as error:
            where = f"{os.fsdecode(error.filename)}: " if isinstance(error.filename, str | bytes) else ""
            join.say(failure=f"{where}{error.strerror or str(error) or type(error).__name__}")
            raise
        except VnetError as error:
            join.say(failure=str(error))
            raise
        join.say(ready=True)
        process = HostProcess(name, welcome, up, down, launcher, folder, events)
        process.work()
        on_state(f"host {name}: {process.grants:,} grants in {process.barriers:,} bundles")


class _Join:
    """The hellos of a host, until it is welcome."""

    def __init__(self, up: Up, name: str, events: queue.SimpleQueue[Event], timeout_s: float) -> None:
        self._up = up
        self._name = name
        self._events = events
        self._timeout_s = timeout_s
        self._digest = vnet_digest()

    def say(self, ready: bool = False, failure: str | None = None) -> None:
        """Say hello."""
        self._up.say_hello(
            HostHello(
                host=self._name,
                nonce=self._up.nonce,
                pid=os.getpid(),
                machine=socket.gethostname(),
                digest=self._digest,
                ready=ready,
                failure=failure,
            )
        )

    def until_welcome(self) -> HostWelcome:
        """Repeat hello until the emulator answers. Raises TransportError on refusal and after the timeout."""
        deadline = time.monotonic() + self._timeout_s
        while time.monotonic() < deadline:
            self.say()
            next_hello = time.monotonic() + HELLO_PERIOD_S
            while (wait_s := next_hello - time.monotonic()) > 0:
                try:
                    kind, _, payload = self._events.get(timeout=wait_s)
                except queue.Empty:
                    break
                if kind == "rx" and (welcome := self._answer(payload)) is not None:
                    return welcome
        raise TransportError(
            f"host {self._name}: no welcome within {self._timeout_s:g} s: is the emulator running, with this host?"
        )

    def _answer(self, payload: bytes) -> HostWelcome | None:
        message = messages.decode_to_host(payload)
        if message.nonce != self._up.nonce:
            return None
        if isinstance(message, messages.HostRefusal):
            raise TransportError(f"host {self._name}: refused: {message.reason}")
        return message if isinstance(message, HostWelcome) else None


class HostProcess:
    """The course of a host from its welcome to the end of the run."""

    def __init__(
        self,
        name: str,
        welcome: HostWelcome,
        up: Up,
        down: Down,
        launcher: Launcher,
        folder: Path,
        events: queue.SimpleQueue[Event],
    ) -> None:
        self._name = name
        self._welcome = welcome
        self._nodes_of = {nodes[0]: list(nodes) for nodes in welcome.processes}
        self._up = up
        self._down = down
        self._launcher = launcher
        self._folder = folder
        self._events = events
        self._relay = Relay()
        self._cpu = CpuWatch()
        self._memory = MemoryWatch(welcome.duration_ns)
        self._serials: dict[str, int] = {}
        self._leaving: dict[str, threading.Thread] = {}
        self._tails_due: list[tuple[float, str]] = []
        self._patience_until = 0.0
        self._lost_at: float | None = None
        self._is_over = False
        self.grants = self.barriers = 0
        """Messages for which a process owed a yield, and bundles that held any."""

    def work(self) -> None:
        """Take what comes until the emulator says that the run is over. Raises TransportError if it is gone."""
        while not self._is_over:
            try:
                self._take(self._events.get(timeout=self._wait_s()))
                while True:
                    self._take(self._events.get_nowait())
            except queue.Empty:
                pass
            self._tell_tails()
            self._check_emulator()
            if bundle := self._relay.take_bundle():
                self._up.put(bundle)

    def _take(self, event: Event) -> None:
        kind, node, value = event
        match kind:
            case "rx":
                self._take_orders(value)
            case "message":
                self._relay.take(node, value)
            case "backbone":
                self._relay.take_unit(node, value)
            case "token":
                self._relay.add(("token", node, value))
            case "emulator":
                self._down.show_emulator(value)
                self._lost_at = None if value else time.monotonic()
            case "children":
                self._children_ended()

    def _take_orders(self, payload: bytes) -> None:
        try:
            message = messages.decode_to_host(payload)
        except WireError as error:
            print(f"vnet: host {self._name}: a message of the emulator is dropped: {error}", file=sys.stderr)
            return
        if not isinstance(message, Calls) or message.nonce != self._up.nonce:
            return
        grants = sum(call[0] == "to_node" and call[3] for call in message.calls)
        self.grants, self.barriers = self.grants + grants, self.barriers + bool(grants)
        for name, *arguments in message.calls:  # those of TO_HOST and no others
            getattr(self, f"_{name}")(*arguments)
        if not self._relay.awaited:
            self._relay.is_urgent = True

    def _to_node(self, node: str, payload: bytes, awaited: bool) -> None:
        if not awaited:
            self._relay.is_urgent = True
        elif node in self._launcher.pids:
            self._relay.awaited.add(node)
        self._down.agents.put(node, payload)

    def _to_unit(self, unit: str, payload: bytes) -> None:
        self._down.agents.put_unit(unit, payload)

    def _start(self, process_ids: Sequence[str], serials: Sequence[int], nice: int) -> None:
        groups = [self._nodes_of[process_id] for process_id in process_ids]
        for process_id, serial in zip(process_ids, serials, strict=True):
            self._serials[process_id] = serial
            if process_id in self._leaving:
                self._leaving.pop(process_id).join()
        failure = ""
        try:
            self._launcher.start_agents(self._down.endpoint, self._down.access, groups, nice)
        except VnetError as error:
            failure = str(error)
        self._cpu.look(self._launcher.pids)
        for process_id in process_ids:
            if process_id not in self._launcher.pids:
                self._relay.add(("ended", process_id, self._serials[process_id], 1, failure, None))

    def _kill(self, process_id: str) -> None:
        self._cpu.look(self._launcher.pids)
        self._launcher.kill(process_id)
        self._relay.awaited.discard(process_id)

    def _detach(self, process_id: str, patience_s: float) -> None:
        self._cpu.look(self._launcher.pids)
        wait = self._launcher.detach(process_id)
        self._relay.awaited.discard(process_id)
        thread = threading.Thread(target=wait, args=[patience_s], name=f"end of {process_id}")
        thread.start()
        self._leaving[process_id] = thread

    def _signal(self, process_id: str, asked: int) -> None:
        number = signal.Signals(asked)
        if number not in CHILD_SIGNALS:
            return
        self._launcher.signal(process_id, number)
        if number is signal.SIGUSR1:  # its faulthandler writes to its log
            self._relay.is_urgent = True
            self._tails_due.append((time.monotonic() + STACKS_WRITTEN_S, process_id))

    def _look(self, time_ns: int, memory_limit_mb: float | None) -> None:
        self._cpu.look(self._launcher.pids)
        self._memory.look(time_ns, self._launcher.pids)
        self._launcher.cut_logs()
        if over := first_over(memory_limit_mb, self._launcher.pids):
            self._relay.add(("memory", *over))

    def _be_patient(self, within_s: float) -> None:
        self._patience_until = time.monotonic() + within_s

    def _hand_in(self, patience_s: float) -> None:
        """End all agents and put what they leave; each part is a bundle of its own."""
        self._up.put([*self._relay.take_bundle(), ("handing_in",)])
        for thread in self._leaving.values():
            thread.join()
        for process_id, how in self._launcher.stop(patience_s).items():
            serial = self._serials[process_id]
            self._up.put([("ended", process_id, serial, how.status, how.log_tail, how.overdue_s)])
        for item in self._left_behind():
            self._up.put([item])

    def _left_behind(self) -> Iterator[Call]:
        from emulator.drivers.hosts.retrieval import hand_in  # slow to import: agents should be started first

        yield from hand_in(self._folder, list(self._nodes_of.values()), self._welcome.files_max_mb)
        yield "figures", dict(self._cpu.cpu_ns), list(self._memory.series())
        yield ("handed_in",)

    def _leave(self) -> None:
        self._is_over = True

    def _children_ended(self) -> None:
        for process_id, how in self._launcher.ended().items():
            self._relay.awaited.discard(process_id)
            serial = self._serials[process_id]
            self._relay.add(("ended", process_id, serial, how.status, how.log_tail, None))

    # Time.

    def _wait_s(self) -> float | None:
        """Seconds until there is something to do without an event; None: never."""
        due = [due for due, _ in self._tails_due]
        if self._lost_at is not None:
            due.append(self._given_up_at(self._lost_at))
        return max(min(due) - time.monotonic(), 0.0) if due else None

    def _tell_tails(self) -> None:
        now = time.monotonic()
        for due, process_id in [each for each in self._tails_due if each[0] <= now]:
            self._tails_due.remove((due, process_id))
            self._relay.add(("log_tail", process_id, self._launcher.log_tail(process_id)))

    def _given_up_at(self, lost_at: float) -> float:
        """Return when to give up an emulator that is gone: once the agents, which wait as long, have ended."""
        return max(lost_at + self._welcome.orphan_timeout_s, self._patience_until) + SHUT_DOWN_S

    def _check_emulator(self) -> None:
        if self._lost_at is not None and time.monotonic() >= self._given_up_at(self._lost_at):
            gone_s = time.monotonic() - self._lost_at
            raise TransportError(f"host {self._name}: the emulator has been gone for {gone_s:.3g} s; ending")
