"""The process of `vnet host`: the agents of one host, and one connection to the emulator for all of them.

One thread does everything in the order in which it comes: messages from both sides, and ends of processes. Zenoh's
threads and signal handlers only append to its queue.
"""

from __future__ import annotations

import os
import queue
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

from emulator.drivers.cpu_watch import CpuWatch
from emulator.drivers.hosts import messages
from emulator.drivers.hosts.down import Down
from emulator.drivers.hosts.messages import HostHello, HostWelcome, Item, Order
from emulator.drivers.hosts.relay import Relay
from emulator.drivers.hosts.up import Up
from emulator.drivers.launch import Launcher
from emulator.drivers.memory import MemoryWatch, first_over
from emulator.drivers.signals import signals_handled
from emulator.drivers.zygote import Zygote
from emulator.records.code_digest import vnet_digest
from vnet.errors import TransportError, VnetError, WireError
from vnet.transport.access import Access
from vnet.transport.credentials import Credentials
from vnet.transport.scheduling import PROMPT_SLICE_NS, set_time_slice

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
        on_state(f"host {name}: {len(welcome.processes)} agent processes of run {run}")
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="vnet-host-")))
        (folder / "logs").mkdir()
        zygote = Zygote(welcome.modules) if welcome.start == "fork" and sys.platform == "linux" else None
        launcher = Launcher(folder / "logs", folders, zygote, join_timeout_s)
        launcher.disks = folder / "disks"
        stack.callback(launcher.stop, SHUT_DOWN_S)
        down = Down(
            Access.create(run, welcome.processes, units=welcome.units),
            welcome.realtime,
            lambda node, payload: events.put(("tx", node, payload)),
            lambda node, alive: events.put(("alive", node, alive)),
            lambda unit, payload: events.put(("backbone", unit, payload)),
        )
        stack.enter_context(signals_handled(lambda *_: events.put(("children", "", None)), signal.SIGCHLD))
        try:
            launcher.prepare()
            down.open(stack)
            while not launcher.is_prepared():
                time.sleep(READY_POLL_S)
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
        self._takes: dict[type, Callable[[Any], None]] = {
            messages.ToNode: self._to_node,
            messages.ToUnit: self._to_unit,
            messages.Start: self._start,
            messages.Kill: self._kill,
            messages.Detach: self._detach,
            messages.Signal: self._signal,
            messages.Look: self._look,
            messages.Patience: self._be_patient,
            messages.HandIn: self._hand_in,
            messages.Leave: self._leave,
        }

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
            case "tx":
                self._relay.take(node, value)
            case "backbone":
                self._relay.take_unit(node, value)
            case "alive":
                self._relay.add(messages.Token(node, value))
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
        if not isinstance(message, messages.Orders) or message.nonce != self._up.nonce:
            return
        grants = sum(isinstance(order, messages.ToNode) and order.awaited for order in message.orders)
        self.grants, self.barriers = self.grants + grants, self.barriers + bool(grants)
        for order in message.orders:
            self._carry_out(order)
        if not self._relay.awaited:
            self._relay.hurry()

    def _carry_out(self, order: Order) -> None:
        self._takes[type(order)](order)

    def _to_node(self, order: messages.ToNode) -> None:
        if not order.awaited:
            self._relay.hurry()
        elif order.node in self._launcher.pids:
            self._relay.granted(order.node)
        self._down.put(order.node, order.payload)

    def _to_unit(self, order: messages.ToUnit) -> None:
        self._down.put_unit(order.node, order.payload)

    def _start(self, order: messages.Start) -> None:
        groups = [self._nodes_of[process_id] for process_id in order.process_ids]
        for process_id, serial in zip(order.process_ids, order.serials, strict=True):
            self._serials[process_id] = serial
            if process_id in self._leaving:
                self._leaving.pop(process_id).join()
        failure = ""
        try:
            self._launcher.start_agents(self._down.endpoint, self._down.access, groups, order.nice)
        except VnetError as error:
            failure = str(error)
        self._cpu.look(self._launcher.pids)
        for process_id in order.process_ids:
            if process_id not in self._launcher.pids:
                self._relay.add(messages.Ended(process_id, self._serials[process_id], 1, failure))

    def _kill(self, order: messages.Kill) -> None:
        self._cpu.look(self._launcher.pids)
        self._launcher.kill(order.process_id)
        self._relay.ended(order.process_id)

    def _detach(self, order: messages.Detach) -> None:
        self._cpu.look(self._launcher.pids)
        wait = self._launcher.detach(order.process_id)
        self._relay.ended(order.process_id)
        thread = threading.Thread(target=wait, args=[order.patience_s], name=f"end of {order.process_id}")
        thread.start()
        self._leaving[order.process_id] = thread

    def _signal(self, order: messages.Signal) -> None:
        number = signal.Signals(order.number)
        if number not in CHILD_SIGNALS:
            return
        self._launcher.signal(order.process_id, number)
        if number is signal.SIGUSR1:  # its faulthandler writes to its log
            self._relay.hurry()
            self._tails_due.append((time.monotonic() + STACKS_WRITTEN_S, order.process_id))

    def _look(self, order: messages.Look) -> None:
        self._cpu.look(self._launcher.pids)
        self._memory.look(order.time_ns, self._launcher.pids)
        if over := first_over(order.memory_limit_mb, self._launcher.pids):
            self._relay.add(messages.MemoryExceeded(*over))
            self._relay.hurry()

    def _be_patient(self, order: messages.Patience) -> None:
        self._patience_until = time.monotonic() + order.within_s

    def _hand_in(self, order: messages.HandIn) -> None:
        """End all agents and put what they leave; each part is a bundle of its own."""
        self._up.put([*self._relay.take_bundle(), messages.HandingIn()])
        for thread in self._leaving.values():
            thread.join()
        for process_id, how in self._launcher.stop(order.patience_s).items():
            serial = self._serials[process_id]
            self._up.put([messages.Ended(process_id, serial, how.status, how.log_tail, how.overdue_s)])
        for item in self._left_behind():
            self._up.put([item])

    def _left_behind(self) -> Iterator[Item]:
        from emulator.drivers.hosts.retrieval import hand_in  # slow to import: agents should be started first

        yield from hand_in(self._folder, list(self._nodes_of.values()), self._welcome.files_max_mb)
        yield messages.Figures(dict(self._cpu.cpu_ns), list(self._memory.series()))
        yield messages.HandedIn()

    def _leave(self, order: messages.Leave) -> None:
        self._is_over = True

    def _children_ended(self) -> None:
        for process_id, how in self._launcher.ended().items():
            self._relay.ended(process_id)
            serial = self._serials[process_id]
            self._relay.add(messages.Ended(process_id, serial, how.status, how.log_tail))

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
            self._relay.add(messages.LogTail(process_id, self._launcher.log_tail(process_id)))

    def _given_up_at(self, lost_at: float) -> float:
        """Return when to give up an emulator that is gone: once the agents, which wait as long, have ended."""
        return max(lost_at + self._welcome.orphan_timeout_s, self._patience_until) + SHUT_DOWN_S

    def _check_emulator(self) -> None:
        if self._lost_at is not None and time.monotonic() >= self._given_up_at(self._lost_at):
            gone_s = time.monotonic() - self._lost_at
            raise TransportError(f"host {self._name}: the emulator has been gone for {gone_s:.3g} s; ending")
