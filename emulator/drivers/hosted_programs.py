"""Programs of simulated nodes on one virtual-time loop, in the emulator's process or in one forked from it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from emulator.drivers.program_output import output_kept
from emulator.records.node_files import NodeLogs
from emulator.records.run_folder import RunFolder
from vnet.node import Node
from vnet.runtime import running_node
from vnet.runtime.cpu_meter import CpuMeter
from vnet.runtime.disks import Disks
from vnet.runtime.host import Host
from vnet.runtime.mail import Mail
from vnet.runtime.process_end import caught
from vnet.runtime.programs import Programs
from vnet.runtime.virtual_time import SpinError, VirtualTimeLoop
from vnet.transport import wire

if TYPE_CHECKING:
    from vnet.runtime.debugger import NodeDebugger

NONCE = b""
"""Nonce of simulated processes, which nobody can impersonate."""


class RunOverError(Exception):
    """The barrier has granted nothing more."""


class Changes(NamedTuple):
    """Effects of faults and trips on the programs of one process at an instant.

    `stop`: nodes whose programs end, and whether they are killed; `start`: welcomes of those that are started;
    `paused`: all nodes that are paused.
    """

    time_ns: int
    stop: Mapping[str, bool]
    start: Sequence[wire.Welcome]
    paused: set[str]


class Turn(NamedTuple):
    """The next window of a process, with the changes of its programs that come before it.

    `mail` is what belongs to the grant, if it is not in it.
    """

    changes: Sequence[Changes]
    grant: wire.Grant
    mail: Mail | None = None


Swap = Callable[[wire.Yield | None], Turn]
"""Yield, and return the next turn; without a yield, the first. Raises RunOverError, KeyboardInterrupt."""


class HostedPrograms:
    """The nodes of one process, which `run` takes from the first grant to the last.

    `only_programs_raise` tells whether a KeyboardInterrupt can only be the programs' own.
    """

    def __init__(
        self,
        welcomes: Sequence[wire.Welcome],
        programs: Programs,
        folder: RunFolder,
        swap: Swap,
        debugger: NodeDebugger | None = None,
    ) -> None:
        self._programs = programs
        self._swap = swap
        self._seq = 0
        self.only_programs_raise: Callable[[], bool] = lambda: True
        self.loop = VirtualTimeLoop(self._exchange, welcomes[0].spin_limit)
        self.meter = CpuMeter(shown=running_node.running)
        if folder.is_open:  # else nobody asks what programs have cost
            self.loop.measure(self.meter)
        self._logs = NodeLogs(folder.logs)
        self._host = Host(
            welcomes,
            lambda: self.loop.now_ns,
            on_line=self._logs.write,
            disks=Disks(folder.disks),
            debugger=debugger,
        )
        self.final = wire.Traffic()
        """Exceptions and notes of programs as they were ended."""
        self.order_steps: Mapping[str, int] = {}
        """Decisions of each node, where orders of events are tried."""

    def _owns(self, node: Node) -> bool:
        """Return whether `node` is one of these, and not an earlier incarnation."""
        return self._host.nodes.get(node.id) is node

    def run(self) -> None:
        """From the first grant to the last. Raises KeyboardInterrupt."""
        with output_kept(self._owns, self._logs), caught(self._host.process_ended):
            asyncio.set_event_loop(self.loop)
            try:
                self._run()
            finally:
                asyncio.set_event_loop(None)
                self.loop.close()
                running_node.running.show("")
                self._host.discard_abandoned()
                if (ordered := self._host.mail.ordered) is not None:
                    self.order_steps = ordered.steps

    def _run(self) -> None:
        try:
            self._host.order_events(self.loop)
            self._host.start(self.loop, self._programs)
            self.loop.start_at(self._take(self._swap(None)))
            while True:
                try:
                    self.loop.run_forever()
                except SpinError as spin:
                    self._host.end_spinning(self.loop, spin)
                except SystemExit as leave:
                    self._host.end_exited(leave)
                except KeyboardInterrupt as leave:
                    if not self.only_programs_raise():
                        raise
                    self._host.end_exited(leave)
        except RunOverError:
            self._close()
        except KeyboardInterrupt:
            self._host.forget_interrupt()
            self._close()
            raise

    def _close(self) -> None:
        self._host.close(self.loop)
        self.final = self._host.take_final()

    def _exchange(self, next_timer_ns: int | None) -> int:
        next_ns = self._host.next_instant(next_timer_ns)
        if next_ns is not None:
            return next_ns
        return self._take(self._swap(self._host.make_yield(NONCE, self._seq, next_timer_ns)))

    def _take(self, turn: Turn) -> int:
        self._seq = turn.grant.seq
        self._host.apply_clock_error(turn.grant.clocks, self.loop)
        for change in turn.changes:
            for node, killed in change.stop.items():
                self._host.stop(node, killed, change.time_ns)
            for welcome in change.start:
                self._host.restart(welcome)
            self._host.pause(change.paused)
        return self._host.open_window(turn.grant, turn.mail)
