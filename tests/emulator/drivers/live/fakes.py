"""Surroundings of the parts of a live run, without processes and without Zenoh: it notes what it is told to do."""

import asyncio
import contextlib
import signal
from collections.abc import Callable, Coroutine, Iterable, Sequence
from functools import wraps
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from emulator.drivers import realtime
from emulator.drivers.attachment import LiveOptions
from emulator.drivers.emulation import Emulation
from emulator.drivers.launch import Exit
from emulator.drivers.live import fleet, processes
from emulator.drivers.live.processes import LiveProcesses
from emulator.drivers.live.supervisor import Supervisor
from tests.support.multi_loop_driver import emulation_of, scenario_of
from vnet.runtime.virtual_time import VirtualTimeLoop
from vnet.transport import wire
from vnet.transport.access import Access
from vnet.units import NS_PER_S

IDS = ["v01", "v02", "v03", "v04"]
ALONE = [[node] for node in IDS]


AsyncTest = Callable[..., Coroutine[Any, Any, None]]


def in_virtual_time(test: AsyncTest) -> Callable[..., None]:
    """Run a test on a loop that skips all waiting; the drivers take their clock from it."""

    @wraps(test)
    def run(**fixtures: Any) -> None:
        loop = VirtualTimeLoop(skip_to)
        clock = SimpleNamespace(monotonic_ns=lambda: loop.now_ns, monotonic=lambda: loop.now_ns / NS_PER_S)
        with pytest.MonkeyPatch.context() as patch, contextlib.closing(loop):
            for module in (fleet, processes, realtime):
                patch.setattr(module, "time", clock)
            loop.run_until_complete(test(**fixtures))

    return run


def on_a_loop(test: AsyncTest) -> Callable[..., None]:
    """Run a test on a loop of asyncio's."""

    @wraps(test)
    def run(**fixtures: Any) -> None:
        asyncio.run(test(**fixtures))

    return run


def skip_to(next_timer_ns: int | None) -> int:
    assert next_timer_ns is not None, "it waits for nothing that will come"
    return next_timer_ns


class FakeLauncher:
    """A launcher whose processes have only a name and a number."""

    def __init__(self) -> None:
        self.pids: dict[str, int] = {}
        self.done: list[tuple[str, ...]] = []
        self._next_pid = 100

    def start_agents(self, endpoint: str, access: Access, groups: Sequence[Sequence[str]], nice: int = 0) -> None:
        for nodes in groups:
            self._next_pid += 1
            self.pids[nodes[0]] = self._next_pid
            self.done.append(("start", *nodes))

    def start(self, name: str, *_: Any, **__: Any) -> None:
        self.done.append(("start", name))

    def signal(self, name: str, number: signal.Signals) -> None:
        self.done.append((number.name, name))

    def kill(self, name: str) -> None:
        self.pids.pop(name, None)
        self.done.append(("kill", name))

    def detach(self, name: str) -> Callable[[float], None]:
        self.pids.pop(name, None)
        return lambda patience_s: self.done.append(("wait for", name))

    def takes_end(self, name: str, how: Exit) -> bool:
        return False

    def request_stack(self, name: str) -> None:
        self.done.append(("stack", name))

    def log_tail(self, name: str) -> str:
        return f"the log of {name}"

    def dies(self, supervisor: Supervisor, name: str, status: int = -11) -> None:
        """A process ends by itself, and the news of it comes."""
        self.pids.pop(name, None)
        supervisor.child_ended(name, Exit(status, "its last line"))

    def ends_as_told(self, supervisor: Supervisor, name: str) -> None:
        """A process has ended because it was told to, and the news of it comes."""
        self.pids.pop(name, None)
        supervisor.child_ended(name, Exit(0, ""), told_to_end=True)


class FakeAttachment:
    """An attachment that keeps what is sent."""

    endpoint = "tcp/here:1"

    def __init__(self, node_ids: Iterable[str] = IDS) -> None:
        self.node_ids = list(node_ids)
        self.sent: list[tuple[str, wire.EmulatorMessage]] = []
        self.done: list[str] = []
        self.on_send: Callable[[str, wire.EmulatorMessage], None] = lambda node, message: None

    def knows(self, node: str) -> bool:
        return node in self.node_ids

    def send(self, node: str, message: wire.EmulatorMessage) -> None:
        self.sent.append((node, message))
        self.on_send(node, message)

    def send_content(self, unit: str, payload: bytes) -> None:
        self.done.append(f"content of {unit}")

    def is_watched(self, stream: str) -> bool:
        return False

    def open(self, again: bool = False) -> None:
        self.done.append("open")

    def close(self) -> None:
        self.done.append("close")


def hello(node: str, process_id: str | None = None, nonce: bytes = b"1", **more: Any) -> wire.Hello:
    """A hello, ready unless it says otherwise."""
    return wire.Hello(
        node, process_id or node, nonce, 7, "host", **{"ready": True, "version": wire.VERSION, **more}
    )


class Stage:
    """The parts that the others need, around an emulation of four vehicles. Make it on a running loop."""

    def __init__(
        self,
        processes: Sequence[Sequence[str]] = ALONE,
        faults: Sequence[dict[str, Any]] = (),
        launch: bool = True,
        later: Sequence[str] = (),
        pacing: str = "lockstep",
        **sections: Any,
    ) -> None:
        run = {"pacing": pacing, **sections.pop("run", {})}
        scenario = scenario_of(list(faults), "agents.beacon:main", run=run, **sections)
        self.emulation: Emulation = emulation_of(scenario)
        self.processes = [list(nodes) for nodes in processes]
        for node in later:
            self.emulation.up[node] = False
        self.launcher = FakeLauncher()
        self.options = LiveOptions(Access.create("fake", self.processes), launch=launch)
        self.queries: list[tuple[str, Any]] = []
        self.live = LiveProcesses(
            self.emulation,
            self.options,
            self.launcher,  # type: ignore[arg-type]
            lambda verb, query: self.queries.append((verb, query)),
            lambda *_: FakeAttachment(),  # type: ignore[arg-type]
        )
        self.attachment: FakeAttachment = self.live.attachment  # type: ignore[assignment]
        self.attachment.done.clear()
        self.members, self.supervisor, self.changes = self.live.members, self.live.supervisor, self.live.changes

    @property
    def folder(self) -> Path:
        return self.emulation.folder.path

    def join(self, nonce: bytes = b"1", begin: bool = True) -> None:
        """Every process starts and joins, but for those that come later."""
        for nodes in self.processes:
            if nodes[0] not in self.members.later:
                if self.options.launch:
                    self.supervisor.launch([nodes])
                self.hello(nodes[0], nonce)
        self.launcher.done.clear()
        self.members.closed = True
        if begin:
            self.supervisor.begin(self.members.processes())

    def hello(self, process_id: str, nonce: bytes) -> None:
        """The nodes of a process say that they are ready."""
        for node in next(nodes for nodes in self.processes if nodes[0] == process_id):
            assert self.members.hello(node, hello(node, process_id, nonce)) is None

    def events(self, *kinds: str) -> list[tuple[str, str | None]]:
        """The events of these kinds, and of which node."""
        return [(event.kind, event.node) for event in self.emulation.folder.events if event.kind in kinds]


def joined(processes: Sequence[Sequence[str]] = ALONE, **stage: Any) -> Stage:
    """A stage whose processes have joined, and whose run has begun."""
    made = Stage(processes, **stage)
    made.join()
    return made
