"""Vehicles whose programs speak Zenoh: their gateways, in the place of agents, and the commands that vnet starts.

`Gateways` says to the run what an agent would say (it joins, sends frames, acknowledges batches) and does to the
vehicles' commands what faults do. All gateways are in this process, so that a sample makes no further hop.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import shutil
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Coroutine, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, Literal, cast

import msgspec
import zenoh

from emulator.drivers.emulation import Emulation
from emulator.drivers.launch import COMMAND, Exit, Launcher
from emulator.drivers.live.gateway import (
    Gateway,
    Giver,
    check_trust,
    is_peer,
    read_users,
    session_environment,
    session_name,
)
from emulator.drivers.live.supervisor import SHUT_DOWN_S, ChangeSignal
from emulator.records.events import EventKind
from emulator.scenario.program import PYTHON
from vnet.errors import ProgramError, VnetError, counted, first_names, shown
from vnet.gateway import FAILURE, filled_in
from vnet.gateway.frames import CrossingReply, CrossingTokens, Fragments, Message, TooLargeError
from vnet.gateway.ros2 import Ros2
from vnet.radio import SentFrame
from vnet.reports import Reporter
from vnet.runtime.die_with_parent import STARTED_BY_VNET
from vnet.runtime.host import Outbox
from vnet.transport import wire
from vnet.transport.access import Access
from vnet.transport.session import RUNTIME_VARIABLE
from vnet.units import NS_PER_S

ENDPOINTS = "endpoints.json"
"""File of a run's folder with the endpoint of each vehicle."""
HIGHEST_PORT = 65_535
HOW = "ZENOH_CONFIG, VNET_ENDPOINT and {endpoint} have it, for Zenoh 1; in Python zenoh.open() finds it by itself"
BY_HAND = f"{ENDPOINTS} in the run's folder has all endpoints, for Zenoh 1"
"""Hints for those whose program does not connect: started by vnet, or by hand."""
_ESTABLISHED = "01"
"""State of a connection in proc_net(5)."""
CLOSE_S = 1.0
"""Time for which the routers of all vehicles are awaited to close, so that they open together."""
RETRY_S = 5.0
"""Time after which programs are connected again to a router that is back: Zenoh's clients wait for up to 4 s."""
SWITCH_S = 0.001
"""Time after which a thread lets another one run, Python's 5 ms else: what programs put and hear is on others."""
TOKENS_S = 0.02
"""Least time between two messages with tokens that change."""
TURNS_S = 0.1
"""Seconds over which vehicles begin, one after another, what all of them do: at one instant it would be late."""


@dataclass
class _Vehicle:
    """A vehicle whose gateway is open, or is being opened."""

    number: int
    """Tells its incarnations apart."""
    gateway: Gateway
    reporter: Reporter
    nice: int
    commands: dict[str, str] = field(default_factory=dict)
    """Its commands that have not ended, by the names of their processes, as the launcher has them."""
    fragments: Fragments | None = None
    acknowledges: bool = False
    is_ready: bool = False
    has_begun: bool = False
    """True from batch 0 on, by which the run no longer waits for its programs."""
    on_air: bool = False
    """True from time 0, or from its return, on."""
    early: dict[object, tuple[str, Any]] = field(default_factory=dict)
    """Queries of its programs and the latest sample of each key, which wait until its turn then."""
    replaced: int = 0
    """Samples that a later one of their key has replaced there."""
    outbox: Outbox = field(default_factory=Outbox)
    receipts: wire.Receipts = field(default_factory=wire.Receipts)
    unicasts: int = 0
    is_due: bool = False
    opened_s: float = -math.inf
    """The loop's time at which its router was opened again; infinite while it is closed."""
    more_tokens: bool | None = None
    """True if tokens have changed since they were sent, less than `TOKENS_S` ago; None if that is longer."""
    is_abandoned: bool = False
    """True since it was told that no session is there of programs that others have started."""

    @property
    def nonce(self) -> bytes:
        """Stands for the secret of a process, which nothing in this one needs."""
        return str(self.number).encode()


class Gateways:
    """In the place of a launcher of agents and of their keys; see the module's text.

    `hear` takes on any thread what is for the run's loop, `tell` takes on the loop what an agent would have said.
    With `starts` the commands of the scenario are started; else others start programs.
    """

    def __init__(
        self,
        emulation: Emulation,
        launcher: Launcher,
        starts: bool,
        hear: Callable[[str, str, Any], None],
        tell: Callable[[str, str, Any], None],
        time_ns: Callable[[], int],
        changes: ChangeSignal,
    ) -> None:
        scenario = emulation.scenario
        self._emulation, self._launcher, self._starts = emulation, launcher, starts
        self._program, self._settings = scenario.program, scenario.program.sessions
        self._ros2 = scenario.radio.ros2
        self._hear, self._tell, self._time_ns, self._changes = hear, tell, time_ns, changes
        self._loop = asyncio.get_running_loop()
        self._check(emulation.world.node_ids)
        self._folder = tempfile.TemporaryDirectory(prefix="vnet-")
        self._vehicles: dict[str, _Vehicle] = {}
        self._giver, self._switch_s = Giver(), sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        self._numbers = count(1)
        self._closing: dict[str, asyncio.Task[None]] = {}
        """Gateways that are being closed, whose endpoints the next of their vehicles needs."""
        self._down: dict[str, _Vehicle] = {}
        """Vehicles whose routers a fault has closed, until `_down_until_s` on the loop's clock."""
        self._down_until_s, self._restarting = 0.0, asyncio.Lock()
        self._tasks: set[asyncio.Task[None]] = set()
        self.on_state: Callable[[str], None] = lambda text: None
        """Told which endpoints wait for programs."""
        self.endpoints: dict[str, str] = {}
        """The endpoint of each vehicle, which it keeps."""
        self._scout: zenoh.Scout[Any] | None = None
        self._found: set[str] = set()
        """Sessions of programs that have answered to multicast."""

    def _now_ns(self) -> int:
        """Emulated time; 0 before the start."""
        return max(self._time_ns(), 0)

    def _check(self, node_ids: Sequence[str]) -> None:
        """Raise ProgramError for what is no command, and for vehicles without a port, before anything starts."""
        for program in (self._program, *self._program.exceptions) if self._starts else ():
            for words in program.commands if "PATH" not in program.environment else ():
                _located(words)
        if self._starts:
            check_trust(self._settings)
        if self._settings.users is not None:
            read_users(self._settings.users)
        port = int(self._settings.listen.rpartition(":")[2])
        if port and port + len(node_ids) - 1 > HIGHEST_PORT:
            raise ProgramError(
                f"program.zenoh.listen = {shown(self._settings.listen)}: {len(node_ids)} vehicles need ports up to "
                f"{port + len(node_ids) - 1}, and {HIGHEST_PORT} is the highest"
            )

    # In the place of a launcher.

    @property
    def pids(self) -> Mapping[str, int]:
        """Numbers that tell incarnations of a vehicle apart, of those that should be there."""
        return {node: vehicle.number for node, vehicle in self._vehicles.items()}

    def is_prepared(self) -> bool:
        """Gateways need no preparation."""
        return True

    @property
    def missing(self) -> Sequence[str]:
        """Nothing is awaited."""
        return ()

    def start_agents(self, endpoint: str, access: Access, groups: Sequence[Sequence[str]], nice: int = 0) -> None:
        """Open the gateways of these vehicles, and start their commands."""
        for (node,) in groups:
            rules = None if self._ros2 is None else Ros2(node, self._ros2.inside, self._ros2.domain)
            keys, incarnation = self._emulation.scenario.radio.keys, self._emulation.incarnation[node]
            gateway = Gateway(node, incarnation, keys, self._settings, self._hear, rules, self._giver)
            vehicle = self._vehicles[node] = _Vehicle(next(self._numbers), gateway, Reporter(node), nice)
            self._spawn(self._open(node, vehicle))

    def _spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._done)
        return task

    def _done(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            self._loop.call_exception_handler({"message": "a gateway has failed", "exception": error})

    async def _open(self, node: str, vehicle: _Vehicle) -> None:
        if node in self._closing:
            await self._closing[node]
        try:
            self.endpoints[node] = await _opened(vehicle.gateway, self._listen(node))
        except VnetError as error:
            self._say_hello(vehicle, failure=str(error))
            return
        if self._vehicles.get(node) is not vehicle:  # a fault was faster
            await vehicle.gateway.close()
            return
        self._tell_endpoints()
        self._say_hello(vehicle)

    def _listen(self, node: str) -> str:
        """Return where a vehicle listens: at the port that it has had, or at its place in the range of ports."""
        address, _, port = self._settings.listen.rpartition(":")
        had = self.endpoints.get(node, "").rpartition(":")[2]  # its address is one of those of 0.0.0.0
        return f"{address}:{had or (int(port) and int(port) + self._emulation.number[node])}"

    def _tell_endpoints(self) -> None:
        """Write the endpoints of all vehicles, once they listen, and tell them to whoever starts the programs."""
        if not self._vehicles.keys() <= self.endpoints.keys():
            return
        if (path := self._emulation.folder.path) is not None:
            numbered = sorted(self.endpoints, key=self._emulation.number.__getitem__)
            endpoints = {node: self.endpoints[node] for node in numbered}
            (path / ENDPOINTS).write_text(json.dumps(endpoints, indent=1) + "\n")
        awaited = [node for node, vehicle in self._vehicles.items() if not vehicle.is_ready]
        if awaited and not self._starts:
            where = [f"{node} at {self.endpoints[node]}" for node in awaited]
            self.on_state(f"waiting for programs of {first_names(where)} ({ENDPOINTS} has all)")

    def signal(self, name: str, number: signal.Signals) -> None:
        """Send a signal to the commands of a vehicle."""
        if (vehicle := self._vehicles.get(name)) is not None:
            for process in vehicle.commands:
                self._launcher.signal_group(process, number)
            if vehicle.gateway.is_paused:
                vehicle.gateway.wait_anew(self._now_ns())
            vehicle.gateway.is_paused = number == signal.SIGSTOP
            self._flush_soon(vehicle)

    def kill(self, name: str) -> None:
        """End a vehicle's commands and its gateway at once."""
        for process in self._close(name):
            self._launcher.kill(process)

    def detach(self, name: str) -> Callable[[float], None]:
        """Have a vehicle's commands end; returns what waits so many seconds for it, and kills them then."""
        return self._told_to_end(self._close(name))

    def _told_to_end(self, processes: Collection[str]) -> Callable[[float], None]:
        for process in processes:
            self._launcher.signal_group(process, signal.SIGTERM)
        waits = [self._launcher.detach(process) for process in processes]

        def wait_or_kill(patience_s: float) -> None:
            for wait in waits:
                wait(patience_s)

        return wait_or_kill

    def request_stack(self, name: str) -> None:
        """Have the commands' stacks written to their log: those that are Python may be asked, others would end."""

    def log_tail(self, name: str) -> str:
        """Return the last lines of a vehicle's log."""
        return self._launcher.log_tail(name)

    def takes_end(self, name: str, how: Exit) -> bool:
        """Take the end of a command; it is the end of its vehicle if its status says that it has failed."""
        vehicle = next((each for each in self._vehicles.values() if name in each.commands), None)
        if vehicle is None:
            return False
        node, words = vehicle.gateway.node_id, vehicle.commands.pop(name)
        crash = self._crash(vehicle, name, words) if vehicle.has_begun else None
        if crash is not None:
            others, vehicle.commands = vehicle.commands, {}
            self._spawn(self._wait_or_kill(self._told_to_end(others)))
            vehicle.outbox.endings.append(crash)
            self._flush_soon(vehicle)
        elif how.status != 0:
            self._spawn(self._end(node))
            self._tell("ended", node, how)
        elif not vehicle.commands and not vehicle.is_ready:
            self._say_hello(vehicle, failure=f"its commands have ended before they had connected: {HOW}")
        elif not vehicle.commands:
            vehicle.outbox.endings.append(wire.Ending(node, "finished", time_ns=self._now_ns()))
            self._flush_soon(vehicle)
        return True

    def _failure_path(self, vehicle: _Vehicle, process: str) -> Path:
        return Path(self._folder.name) / f"{process}.{vehicle.number}.failure"

    def _crash(self, vehicle: _Vehicle, process: str, words: str) -> wire.Ending | None:
        """Return what a command in Python that has ended has told of its failure, in the words of virtual time."""
        try:
            content = self._failure_path(vehicle, process).read_bytes()
            told = msgspec.json.decode(content, type=dict[str, str])
        except (OSError, msgspec.MsgspecError):
            return None
        error = f"ProgramError: {words} ended with {told['status']}" if told["status"] else told["error"]
        node = vehicle.gateway.node_id
        return wire.Ending(node, "crashed", error, told["details"], told["place"], self._now_ns())

    async def _end(self, node: str) -> None:
        await self._wait_or_kill(self.detach(node))

    async def _wait_or_kill(self, wait: Callable[[float], None]) -> None:
        await asyncio.to_thread(wait, SHUT_DOWN_S)

    def _close(self, node: str) -> Collection[str]:
        """Close a vehicle's gateway; return the names of the processes of its commands, which are its no more."""
        vehicle = self._vehicles.get(node)
        if vehicle is None:
            return ()
        if vehicle.early or vehicle.outbox.frames or vehicle.more_tokens:
            self._flush(vehicle, final=True)
        vehicle.on_air = False
        del self._vehicles[node]
        self._closing[node] = asyncio.ensure_future(vehicle.gateway.close())
        return vehicle.commands

    def restart_endpoints(self, down_s: float) -> None:
        """Close the routers of all vehicles, and open them again at their endpoints after so long."""
        self._spawn(self._restart_endpoints(down_s))

    async def _restart_endpoints(self, down_s: float) -> None:
        self._down_until_s = max(self._down_until_s, self._loop.time() + down_s)
        async with self._restarting:  # a router that is being opened cannot be closed
            there = {node: vehicle for node, vehicle in self._vehicles.items() if vehicle.is_ready}
            for vehicle in there.values():
                vehicle.opened_s = math.inf
                self._flush(vehicle)
            self._down |= there  # not those whose programs are starting: these do not wait for one
            await self._all_but_slow(vehicle.gateway.close() for vehicle in there.values())
        while (left_s := self._down_until_s - self._loop.time()) > 0:  # another restart may last longer
            await asyncio.sleep(left_s)
        async with self._restarting:
            down, self._down = self._down, {}
            await self._all_but_slow(self._open_again(vehicle) for vehicle in down.values())
        self._emulation.folder.event(self._now_ns(), EventKind.router_restarted, None, down_s=down_s)

    async def _all_but_slow(self, work: Iterable[Coroutine[Any, Any, None]]) -> None:
        """Do something for many vehicles at once; nobody waits for long for another one's programs."""
        if tasks := [self._spawn(each) for each in work]:
            await asyncio.wait(tasks, timeout=CLOSE_S)

    async def _open_again(self, vehicle: _Vehicle) -> None:
        node = vehicle.gateway.node_id
        if self._vehicles.get(node) is not vehicle:  # a fault has ended it meanwhile
            return
        try:
            await vehicle.gateway.close()  # which may last
            await _opened(vehicle.gateway, self._listen(node))
        except VnetError as error:
            self._tell("ended", node, Exit(1, str(error)))
        if self._vehicles.get(node) is not vehicle:  # or meanwhile
            await vehicle.gateway.close()
        vehicle.opened_s = self._loop.time()
        self._loop.call_later(RETRY_S, self._look_for_programs, vehicle)

    async def close(self) -> None:
        """Close all gateways, and wait for what was told to end."""
        waits = [asyncio.to_thread(self.detach(node), SHUT_DOWN_S) for node in list(self._vehicles)]
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*waits, *self._closing.values(), *self._tasks, return_exceptions=True)
        self._stop_scouting()
        self._giver.close()
        sys.setswitchinterval(self._switch_s)
        self._folder.cleanup()

    # In the place of an agent: what it is told.

    def send(self, node: str, message: wire.EmulatorMessage) -> None:
        """Say something to a vehicle."""
        vehicle = self._vehicles.get(node)
        if vehicle is None:
            return
        match message:
            case wire.Welcome():
                most, warn = self._emulation.scenario.radio.queue_frames, partial(self._note, vehicle, "warning")
                vehicle.fragments = Fragments(message.max_payload, message.incarnation, most, warn)
                vehicle.acknowledges = message.acknowledges
                self._start_commands(node, vehicle)
                self._look_at_sessions(vehicle)
            case wire.Batch():
                self._take_batch(vehicle, message)
            case wire.StackRequest():
                self._tell("local", node, wire.StackDump(vehicle.nonce, "", self._now_ns()))
            case wire.End(refused=False):
                self._flush(vehicle, final=True)
                self._spawn(self._end(node))

    def send_content(self, unit: str, payload: bytes) -> None:
        """Zenoh programs of roadside units have no way to the backbone."""

    def _commands_of(self, node: str) -> dict[str, list[str]]:
        """Return the words of the commands of a vehicle, by the names of their processes."""
        commands = enumerate(self._program.commands_of(node) if self._starts else (), start=1)
        words = {number: filled_in(words, node, self.endpoints[node]) for number, words in commands}
        return {node if number == 1 else f"{node}~{number}": each for number, each in words.items()}

    def _start_commands(self, node: str, vehicle: _Vehicle) -> None:
        folder, endpoint = Path(self._folder.name), self.endpoints[node]
        inherited = {name: value for name, value in os.environ.items() if name != RUNTIME_VARIABLE}
        own = self._program.of(node).environment
        inherited |= zip(own, filled_in(own.values(), node, endpoint), strict=True)
        environment = session_environment(node, endpoint, self._program, folder, inherited)
        environment |= {STARTED_BY_VNET: "1", "PYTHONUNBUFFERED": "1"}
        if self._ros2 is not None:
            environment["ROS_DOMAIN_ID"] = str(self._ros2.domain)
        try:
            for name, words in self._commands_of(node).items():
                environment[FAILURE] = environment[COMMAND] = str(self._failure_path(vehicle, name))
                found = _located(words, environment.get("PATH"))
                self._launcher.start_command(name, found, environment, vehicle.nice)
                vehicle.commands[name] = " ".join(words)
        except VnetError as error:
            self._say_hello(vehicle, failure=str(error))

    def _take_batch(self, vehicle: _Vehicle, batch: wire.Batch) -> None:
        now_ns = self._now_ns()
        vehicle.receipts.take(batch, now_ns)
        if batch.origin_ns is not None and not vehicle.has_begun:
            vehicle.has_begun = True
            delay_s = max(batch.origin_ns + batch.start_ns - time.monotonic_ns(), 0) / NS_PER_S
            turn = self._emulation.number[vehicle.gateway.node_id] / len(self._emulation.number)
            turn_s = 0.0 if batch.start_ns else TURNS_S * turn  # who comes back is alone
            self._loop.call_later(delay_s, self._go_on_air, vehicle, turn_s)
        for fix in batch.fixes:
            vehicle.gateway.show_fix(fix.fix())
        for packet in batch.packets:
            try:
                vehicle.gateway.hear(packet.sender, packet.payload, now_ns)
            except ValueError as error:  # bytes that a fault has changed
                self._note(vehicle, "debug", f"a frame of {packet.sender} is no sample: {error}")

    def _go_on_air(self, vehicle: _Vehicle, turn_s: float) -> None:
        """Begin to send what the programs put; in its turn also what they have put, and what is told regularly."""
        vehicle.on_air = True
        self._look_for_programs(vehicle)
        self._loop.call_later(turn_s, self._take_turn, vehicle)

    def _take_turn(self, vehicle: _Vehicle) -> None:
        if self._is_there(vehicle):
            self._repeat(vehicle, 1.0, self._flush)
            self._repeat(vehicle, self._settings.liveliness_s, self._renew_tokens)
            if self._ros2 is not None:
                self._repeat(vehicle, 1 / self._ros2.clock_hz, self._tell_clock)

    def _repeat(self, vehicle: _Vehicle, period_s: float, act: Callable[[_Vehicle], None]) -> None:
        """Do something now and once a period, while a vehicle is there."""
        self._repeat_at(self._loop.time(), vehicle, period_s, act)

    def _repeat_at(self, due_s: float, vehicle: _Vehicle, period_s: float, act: Callable[[_Vehicle], None]) -> None:
        if self._is_there(vehicle):
            act(vehicle)
            passed = math.ceil((self._loop.time() - due_s) / period_s)
            due_s += period_s * max(passed, 1)  # who is late leaves periods out
            self._loop.call_at(due_s, self._repeat_at, due_s, vehicle, period_s, act)

    def _tell_clock(self, vehicle: _Vehicle) -> None:
        vehicle.gateway.show_clock(min(self._now_ns(), self._emulation.duration_ns))  # it stands at the end

    def _tell_tokens(self, vehicle: _Vehicle, arrived_ns: int) -> None:
        """Send the tokens, unless they were just sent: a message for each of many would have all others, too."""
        has_told, vehicle.more_tokens = vehicle.more_tokens is not None, True
        if not has_told:
            self._flush(vehicle, arrived_ns)
            self._loop.call_later(TOKENS_S, self._tell_more_tokens, vehicle)

    def _tell_more_tokens(self, vehicle: _Vehicle) -> None:
        more, vehicle.more_tokens = vehicle.more_tokens, None
        if more and self._is_there(vehicle):
            self._tell_tokens(vehicle, time.monotonic_ns())

    def _renew_tokens(self, vehicle: _Vehicle) -> None:
        if vehicle.gateway.is_paused:
            return
        vehicle.gateway.forget_tokens(self._now_ns())
        if (tokens := vehicle.gateway.tokens()) is not None:
            self._transmit(vehicle, tokens, time.monotonic_ns())

    def _is_there(self, vehicle: _Vehicle) -> bool:
        return self._vehicles.get(vehicle.gateway.node_id) is vehicle and vehicle.on_air

    # In the place of an agent: what it says.

    def _say_hello(self, vehicle: _Vehicle, ready: bool = False, failure: str | None = None) -> None:
        node, pid, host = vehicle.gateway.node_id, os.getpid(), socket.gethostname()
        hello = wire.Hello(node, node, vehicle.nonce, pid, host, ready, failure, wire.VERSION)
        self._tell("local", node, hello)

    def take(self, what: str, item: tuple[Gateway | None, Any], arrived_ns: int) -> None:
        """Take a message of a gateway, and the instant (ns of the monotonic clock) at which it arrived."""
        gateway, told = item
        if what == "bug":
            raise told
        if what == "hello":
            self._find(told)
            return
        assert gateway is not None
        vehicle = self._vehicles.get(gateway.node_id)
        if vehicle is None or vehicle.gateway is not gateway:  # it is gone
            return
        had_sessions = bool(gateway.sessions)
        if what == "report":
            self._take_report(vehicle, told)
        elif what == "note":
            self._note(vehicle, *told)
        elif what in ("query", "message"):
            key = getattr(told, "key", told)  # each query is kept
            vehicle.replaced += vehicle.early.pop(key, None) is not None
            vehicle.early[key] = what, told
            if vehicle.on_air:
                self._flush(vehicle, arrived_ns)
        elif gateway.take(what, told) is not None and vehicle.on_air:
            self._tell_tokens(vehicle, arrived_ns)
        elif what == "session":
            self._look_at_sessions(vehicle)
            if had_sessions != bool(gateway.sessions):  # and not of a router that vnet has closed
                self._look_for_programs(vehicle)
            if any(is_peer(who) for who in gateway.sessions - self._found):
                self._seek_peers()

    def _transmit(self, vehicle: _Vehicle, message: Message, arrived_ns: int) -> None:
        """Send a message by the vehicle's radio as of its arrival at an instant (ns of the monotonic clock)."""
        self._enqueue(vehicle, message)
        self._flush(vehicle, arrived_ns)

    def _enqueue(self, vehicle: _Vehicle, message: Message) -> None:
        """Add the frames of a message: a reply's are for one vehicle, if the MAC repeats what is lost."""
        assert vehicle.fragments is not None
        node, to = vehicle.gateway.node_id, None
        if isinstance(message, CrossingTokens) and self._ros2 is not None and self._ros2.graph == "always":
            for other in self._vehicles.values():
                if other is not vehicle:
                    other.gateway.hear_tokens(node, message, self._now_ns())
            return
        if isinstance(message, CrossingReply) and vehicle.acknowledges:
            to = message.to
        try:
            for payload in vehicle.fragments.of(message):
                vehicle.outbox.frames.append(SentFrame(node, payload, to=to, number=vehicle.unicasts))
                vehicle.unicasts += to is not None
        except TooLargeError as error:
            self._note(vehicle, "error", str(error))

    def _enqueue_early(self, vehicle: _Vehicle) -> None:
        early, vehicle.early = vehicle.early, {}
        for what, told in early.values():
            if (message := vehicle.gateway.take(what, told)) is not None:
                self._enqueue(vehicle, message)
        if vehicle.replaced:
            samples, vehicle.replaced = counted(vehicle.replaced, "sample"), 0
            self._note(vehicle, "info", f"{samples} of before the start not sent: later ones of their keys are")

    def _take_report(self, vehicle: _Vehicle, content: bytes) -> None:
        try:
            values = msgspec.msgpack.decode(content, type=dict[str, Any])
            estimate, covariance = values.pop("estimate_m", None), values.pop("covariance_m2", None)
            report = vehicle.reporter.report(self._now_ns(), estimate, covariance, values)
        except (msgspec.MsgspecError, TypeError, ValueError) as error:
            self._note(vehicle, "error", f"a report is refused: {error}")
        else:
            vehicle.outbox.reports.append(report)
            self._flush_soon(vehicle)

    def _note(self, vehicle: _Vehicle, level: Literal["debug", "info", "warning", "error"], text: str) -> None:
        vehicle.outbox.notes.append(wire.Note(vehicle.gateway.node_id, self._now_ns(), "log", level, text))
        self._flush_soon(vehicle)

    def _flush_soon(self, vehicle: _Vehicle) -> None:
        if not vehicle.is_due:
            vehicle.is_due = True
            self._loop.call_soon(self._flush, vehicle)

    def _flush(self, vehicle: _Vehicle, arrived_ns: int | None = None, final: bool = False) -> None:
        """Say what the vehicle sends, and acknowledge what it has been told: now, or as of an instant."""
        vehicle.is_due = False
        if not self._is_there(vehicle):
            return
        if vehicle.more_tokens:  # before what was put after them
            vehicle.more_tokens = False
            self._enqueue(vehicle, vehicle.gateway.tokens() or CrossingTokens(()))
        self._enqueue_early(vehicle)
        if vehicle.gateway.is_paused and not final:
            return
        if vehicle.outbox.frames and not self._emulation.up[vehicle.gateway.node_id]:
            lost, vehicle.outbox.frames = counted(len(vehicle.outbox.frames), "frame"), []
            self._note(vehicle, "warning", f"{lost} not sent: the vehicle has ended")
        frames = vehicle.receipts.frames(vehicle.nonce, vehicle.outbox.take(()), final)
        self._tell("frames", vehicle.gateway.node_id, (frames, arrived_ns or time.monotonic_ns()))

    # Sessions.

    def _look_at_sessions(self, vehicle: _Vehicle) -> None:
        """Say that a vehicle is ready once its programs have connected; tell of sessions that are too many."""
        node, connected = vehicle.gateway.node_id, vehicle.gateway.sessions
        commands = len(self._program.of(node).commands) if self._starts else 0
        if not vehicle.is_ready and vehicle.fragments is not None and len(connected) >= max(commands, 1):
            vehicle.is_ready = True
            self._say_hello(vehicle, ready=True)
        most = self._settings.sessions or commands or None
        if most is not None and len(connected) > most:
            self._emulation.folder.event(
                self._now_ns(),
                EventKind.extra_session,
                node,
                count=len(connected),
                limit=most,
                which=", ".join(sorted(connected)),
            )
        self._changes.set()

    def _look_for_programs(self, vehicle: _Vehicle) -> None:
        """Tell if the last session of programs that others have started is gone, or one is back."""
        node, is_abandoned = vehicle.gateway.node_id, not vehicle.gateway.sessions
        if self._starts or not self._is_there(vehicle) or is_abandoned == vehicle.is_abandoned:
            return
        if is_abandoned and self._loop.time() < vehicle.opened_s + RETRY_S:
            return  # they may connect again
        if self._emulation.ended_ns is None:
            kind = EventKind.session_gone if is_abandoned else EventKind.session_back
            self._emulation.folder.event(self._now_ns(), kind, node)
        vehicle.is_abandoned = is_abandoned

    def _seek_peers(self) -> None:
        """Ask by multicast for peers, as those of other vehicles do: at once, and again after seconds."""
        self._stop_scouting()
        with suppress(zenoh.ZError):  # without multicast nobody is found
            self._scout = zenoh.scout(cast(Any, self._tell_hello), what="peer")

    def _tell_hello(self, hello: zenoh.Hello) -> None:
        self._hear("gateway", "hello", (None, hello))

    def _stop_scouting(self) -> None:
        if self._scout is not None:
            self._scout.stop()  # type: ignore[no-untyped-call]
            self._scout = None

    def _find(self, hello: zenoh.Hello) -> None:
        """Tell of a peer that answers to multicast, if it is the session of a program."""
        who = session_name(hello)
        for node, vehicle in self._vehicles.items():
            if who in vehicle.gateway.sessions and who not in self._found:
                self._found.add(who)
                self._emulation.folder.event(self._now_ns(), EventKind.found_session, node, which=who)

    def _silent(self, node: str) -> str:
        """Return in brackets which of several commands of a vehicle are not connected, if some are."""
        commands, pids = self._commands_of(node).items(), self._launcher.pids
        groups = _groups_connected_to(self.endpoints[node].rpartition(":")[2]) if len(commands) > 1 else ()
        silent = [shown(" ".join(words)) for name, words in commands if pids.get(name) not in groups]
        return f" ({', '.join(silent)})" if 0 < len(silent) < len(commands) else ""

    def missed(self, nodes: Sequence[str], timeout_s: float) -> str:
        """Say in one line which programs have not connected in time."""
        listening = filter(self.endpoints.__contains__, nodes)
        where = [f"{node} at {self.endpoints[node]}{self._silent(node)}" for node in listening]
        total = len(self._emulation.world.node_ids)
        if not where:
            return f"{len(nodes)} of {total} endpoints do not listen within {timeout_s:g} s: {first_names(nodes)}"
        return (
            f"programs of {len(where)} of {total} vehicles have not connected within {timeout_s:g} s: "
            f"{first_names(where)}: {HOW if self._starts else BY_HAND}"
        )


def _groups_connected_to(port: str) -> set[int]:
    """Return the process groups that are connected to a TCP port of this machine, if the system says so."""
    sockets, groups = set(), set()
    for table in map(Path, ("/proc/net/tcp", "/proc/net/tcp6")):
        lines = table.read_text().splitlines()[1:] if table.exists() else []
        for _, _, remote, state, *_, inode in (line.split()[:10] for line in lines):
            if state == _ESTABLISHED and int(remote.rpartition(":")[2], 16) == int(port):
                sockets.add(f"socket:[{inode}]")
    for descriptor in Path("/proc").glob("[0-9]*/fd/*") if sockets else ():
        with suppress(OSError):  # it has ended, or is another user's
            if str(descriptor.readlink()) in sockets:
                groups.add(os.getpgid(int(descriptor.parts[2])))
    return groups


def _located(words: Sequence[str], path: str | None = None) -> list[str]:
    """Return the words of a command, the first as found on `path`. Raises ProgramError if there is no such one."""
    found = sys.executable if words[0] in PYTHON else shutil.which(words[0], path=path)
    if found is None:
        raise ProgramError(f"program.command: {shown(words[0])} is no command")
    return [found, *words[1:]]


async def _opened(gateway: Gateway, listen: str) -> str:
    """Open a gateway; returns its endpoint. If the run ends meanwhile, its router would not let the process end."""
    opening = asyncio.ensure_future(asyncio.to_thread(gateway.open, listen))
    try:
        return await asyncio.shield(opening)
    except asyncio.CancelledError:
        await asyncio.gather(opening, return_exceptions=True)
        await gateway.close()
        raise
