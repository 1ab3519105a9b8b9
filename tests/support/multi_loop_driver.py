"""Runs without Zenoh, for tests: simulated, and with a loop and a host for each process, as live ones have.

`run_apart` does what `LiveRun` and an agent do in lockstep, with a thread in place of each process: all messages
pass through the wire's encoding, a kill leaves a loop where it stands, and an end runs what is left.
"""

import asyncio
import atexit
import math
import queue
import threading
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from msgspec.structs import replace

from agents.host import RunAhead
from emulator.drivers.emulation import Emulation, ProcessActions
from emulator.drivers.join import split_into_processes
from emulator.drivers.lockstep import Lockstep, run_in_lockstep
from emulator.drivers.processes import Heard, Processes
from emulator.drivers.simulate import simulate
from emulator.records.run_folder import RunFolder
from emulator.scenario.scenario import Scenario
from emulator.world.world import build_world
from vnet.runtime.arrivals import Mail
from vnet.runtime.host import Disks, Host
from vnet.runtime.programs import load_programs
from vnet.runtime.virtual_time import VirtualTimeLoop
from vnet.transport import wire
from vnet.transport.wire import Contents, SentMessage, WireMessage

_folders = TemporaryDirectory(prefix="vnet-apart-")
atexit.register(_folders.cleanup)
_numbers = count()


class Killed(BaseException):
    """Kill a process: nothing more of it runs."""


class Over(Exception):
    """The emulator has said that the run is over, at this time."""


def scenario_of(faults: Sequence[dict[str, Any]], program: str, /, vehicles: int = 4, **sections: Any) -> Scenario:
    """A small scenario: some seconds at 5 Hz, all in range."""
    data: dict[str, Any] = {
        "run": {"duration_s": 3.0, "settle_s": 0.5},
        "network": {"vehicles": vehicles},
        "world": {"gnss": {"rate_hz": 5}},
        "radio": {"loss": 0.1, "range_m": 1e6},
        "program": {"entry": program},
        "fault": list(faults),
    }
    for name, section in sections.items():
        data[name] = section if isinstance(section, list) else {**data.get(name, {}), **section}
    return Scenario.model_validate(data)


def fault(kind: str, at_s: float, duration_s: float, *nodes: str, **more: Any) -> dict[str, Any]:
    """A fault of these nodes, or of all."""
    who = {"nodes": {"ids": list(nodes)}} if nodes else {}
    return {"kind": kind, "at_s": at_s, "duration_s": duration_s, **who, **more}


def emulation_of(scenario: Scenario) -> Emulation:
    """The state of a run of `scenario`, in a new folder."""
    folder = RunFolder.create(Path(_folders.name) / str(next(_numbers)), scenario)
    return Emulation(scenario, build_world(scenario), folder)


def run_together(scenario: Scenario) -> Emulation:
    """Simulate."""
    emulation = emulation_of(scenario)
    simulate(emulation)
    return emulation


def run_forked(scenario: Scenario) -> Emulation:
    """Simulate in three processes."""
    emulation = emulation_of(scenario)
    simulate(emulation, processes=3)
    return emulation


def run_apart(scenario: Scenario) -> Emulation:
    """Run each process on a loop of its own."""
    emulation = emulation_of(scenario)
    groups = {
        nodes[0]: nodes for nodes in split_into_processes(emulation.world.node_ids, scenario.run.nodes_per_process)
    }
    lockstep = Lockstep(emulation, list(groups.values()))
    lockstep.ahead = () if emulation.orders.explores else set(groups)
    apart = _Apart(emulation, groups)
    try:
        asyncio.run(run_in_lockstep(lockstep, apart))
    finally:
        over = Over(emulation.ended_ns)
        finals = [traffic for process in apart.processes.values() for traffic in process.end(over)]
        emulation.take_final(emulation.duration_ns, finals)
    return emulation


def run_other_ways(scenario: Scenario) -> Iterator[Emulation]:
    """Run what `run_together` simulates on loops of its processes, in three processes, and without windows."""
    yield run_apart(scenario)
    yield run_forked(scenario)
    yield run_together(scenario.model_copy(update={"run": scenario.run.model_copy(update={"windows": False})}))


class _Apart(Processes):
    """Processes that come and go with faults."""

    def __init__(self, emulation: Emulation, groups: Mapping[str, Sequence[str]]) -> None:
        self._emulation, self._groups = emulation, groups
        there = {process_id: nodes for process_id, nodes in groups.items() if emulation.up[process_id]}
        self.processes = {process_id: _Process(emulation, nodes) for process_id, nodes in there.items()}
        self._owing: deque[str] = deque()

    async def act(self, actions: ProcessActions) -> None:
        for process_id, nodes in self._groups.items():
            killed = [actions.stop[node] for node in nodes if node in actions.stop]
            if killed:
                how = Killed() if any(killed) else Over(actions.time_ns)
                traffic = self.processes.pop(process_id).end(how)
                self._emulation.take_final(actions.time_ns, traffic, by_fault=True)
            if any(node in actions.start for node in nodes):
                self.processes[process_id] = _Process(self._emulation, nodes)

    def send(self, process_id: str, message: wire.Grant | wire.Batch, mail: Mail | None = None) -> None:
        assert isinstance(message, wire.Grant) and mail is not None
        self.processes[process_id].put_grant(mail.within(message))
        self._owing.append(process_id)

    async def receive(self, timeout_s: float = math.inf) -> Heard:
        process_id = self._owing.popleft()
        return Heard(process_id, self.processes[process_id].take_yield())


class _Process:
    """One process of nodes, as a thread; see agents/host.py."""

    def __init__(self, emulation: Emulation, nodes: Sequence[str]) -> None:
        self.grants: queue.SimpleQueue[list[bytes] | Killed | Over] = queue.SimpleQueue()
        self.yields: queue.SimpleQueue[list[bytes] | BaseException] = queue.SimpleQueue()
        encoded = [wire.encode(emulation.welcome(node, b"n")) for node in nodes]
        decoded = [wire.decode_rx(welcome) for welcome in encoded]
        self._welcomes = [message for message in decoded if isinstance(message, wire.Welcome)]
        assert len(self._welcomes) == len(nodes)
        self._disks = Disks(emulation.folder.disks)
        self._seq = 0
        self._final: wire.Traffic | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def take_yield(self) -> wire.Yield:
        message = self.yields.get(timeout=60)
        if isinstance(message, BaseException):
            raise message
        units = [unit for unit, _ in self._sent]
        sent: Contents[SentMessage] = Contents()
        for unit, content in zip(units, message[1:], strict=True):
            sent.add(wire.decode_sent(content).message(unit))
        decoded = wire.decode_tx(message[0])
        assert isinstance(decoded, wire.Yield)
        return wire.join_yield(decoded, sent)

    def put_grant(self, grant: wire.Grant) -> None:
        """Have the process take a grant, with the messages of its units beside it."""
        split, contents = wire.split_grant(grant)
        self._arrived = [unit for unit, _ in contents]
        self.grants.put([wire.encode(split), *(wire.encode(content) for _, content in contents)])

    def end(self, how: Killed | Over) -> list[wire.Traffic]:
        """End it from the emulator's side, and wait until it has; returns what it said last, if it could."""
        self.grants.put(how)
        self._thread.join(60)
        assert not self._thread.is_alive()
        return [] if self._final is None else [self._final]

    def _run(self) -> None:
        try:
            self._host_programs()
        except Killed:
            pass
        except BaseException as error:
            self.yields.put(error)

    def _next_grant(self) -> int:
        item = self.grants.get()
        if isinstance(item, BaseException):
            raise item
        grant = wire.decode_rx(item[0])
        assert isinstance(grant, wire.Grant)
        arrived: Contents[WireMessage] = Contents()
        for unit, content in zip(self._arrived, item[1:], strict=True):
            arrived.add(wire.decode_arrived(content).message(unit))
        grant = replace(grant, messages=arrived.split(grant.messages)[0])
        self._seq = grant.seq
        self._host.apply_clock_error(grant.clocks, self._loop)
        return self._ahead.open_window(grant)

    def _swap(self, next_timer_ns: int | None) -> int:
        message, self._sent = wire.split_yield(self._host.make_yield(b"n", self._seq, next_timer_ns))
        self.yields.put([wire.encode(message), *(wire.encode(content) for _, content in self._sent)])
        return self._next_grant()

    def _host_programs(self) -> None:
        loop = self._loop = VirtualTimeLoop(
            lambda timer_ns: self._ahead.exchange(timer_ns), self._welcomes[0].spin_limit
        )
        self._host = Host(self._welcomes, lambda: loop.now_ns, lambda: self._ahead.tell(), disks=self._disks)
        self._ahead = RunAhead(self._host, lambda: loop.now_ns, self._swap)
        loop.before_job = self._ahead.catch_up
        asyncio.set_event_loop(loop)
        try:
            self._host.order_events(loop)
            loop.start_at(self._next_grant())
            self._host.start(loop, load_programs(self._welcomes))
            self._host.run(loop)
        except Over as over:
            self._ahead.close()
            self._host.close(loop, *over.args)
            final = wire.decode_tx(wire.encode(wire.Final(b"n", self._host.take_final())))
            assert isinstance(final, wire.Final)
            self._final = final.traffic
        finally:
            loop.close()
            self._host.discard_abandoned()
