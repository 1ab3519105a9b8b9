"""Hosting: running the programs of one process's nodes on one event loop.

A `Host` builds the nodes from their welcomes, starts their programs, collects what they send and feeds them
what arrives. It knows no transport: agents put its traffic on Zenoh, `vnet simulate` hands it to the engine.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import os
import shutil
import sys
import threading
import weakref
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import Context
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import count
from pathlib import Path
from tempfile import mkdtemp
from threading import get_ident
from typing import TYPE_CHECKING, Any, NoReturn

from msgspec.structs import replace

from vnet.errors import DeadlockError, sendable
from vnet.node import Action, Fix, Node
from vnet.radio import Mailbox, Packet, RadioAbilities, SentFrame, Waits
from vnet.reports import NoteDetail, Report
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap, map_from_wire
from vnet.runtime import asyncio_internals, outside_loop
from vnet.runtime.arrivals import Mail, MailDelivery, MeasuredBusyRatios, News, NodeClocks, Window
from vnet.runtime.error_text import error_line, line_of_caller, of_program, own_line, traceback_text
from vnet.runtime.outside_loop import ProcessEndedError
from vnet.runtime.own_asyncio import Task, current_node, present_node
from vnet.runtime.programs import Program, Programs, context_of
from vnet.runtime.ready_queue import EventChooser, chooser_of, node_of
from vnet.runtime.replay_probes import call_log, scattered_heap
from vnet.runtime.unhandled import UnhandledExceptions, line_of_task
from vnet.runtime.virtual_time import LoopAbandonedError, SkewedLoop, SpinError, VirtualTimeLoop
from vnet.transport import wire
from vnet.transport.wire import Deviation, Order, SentMessage, arrived_in_full
from vnet.units import NS_PER_S, Grid

if TYPE_CHECKING:
    from vnet.runtime.debugger import NodeDebugger


COLLECTION_NS = NS_PER_S
"""Emulated time between two collections of garbage, at the nearest multiple of the period of fixes."""


class Host:
    """The nodes of one process and their programs; see the module's text.

    `clock` gives emulated nanoseconds. `on_traffic`, if given, is called when there is new traffic: real time puts
    it at once, lockstep may have a quiet instant granted. `on_line` is called with a node and a line of its log.
    `disks` has the nodes' folders, by default temporary ones. `debugger` stops in the program of one of them.
    """

    def __init__(
        self,
        welcomes: Sequence[wire.Welcome],
        clock: Callable[[], int],
        on_traffic: Callable[[], None] = lambda: None,
        on_line: Callable[[str, str], None] = lambda node, line: None,
        disks: Disks | None = None,
        debugger: NodeDebugger | None = None,
    ) -> None:
        self._debugger = debugger
        self._disks = disks or Disks()
        self._call_log, self._heap = call_log(), scattered_heap()
        self._clock = clock
        self._on_traffic = on_traffic
        self._on_line = on_line
        self._outbox = Outbox()
        self._lines = NodeLines(on_line)
        self._log_handler = NodeLogHandler(self._log)
        self._window = Window()
        self._map: tuple[object, LaneMap | RoadMap] | None = None
        self._mains: dict[str, asyncio.Task[None]] = {}
        """Held here: of a program in a deadlock nothing else refers to them, and they would be collected."""
        self._tasks: weakref.WeakKeyDictionary[asyncio.Task[Any], Node | None] = weakref.WeakKeyDictionary()
        self._thread: int | None = None  # of the loop, in lockstep
        self._waits = {"radio": Waits(), "gnss": Waits(), "backbone": Waits()}
        self.nodes = {welcome.node: self._node(welcome) for welcome in welcomes}
        self._active = {welcome.node: welcome.runs for welcome in welcomes}
        self._clocks = NodeClocks(clock)
        self._orders = {welcome.node: welcome.order for welcome in welcomes}
        self.mail = MailDelivery(self.nodes, self._clocks)
        self.busy = MeasuredBusyRatios([*self.nodes], clock)
        self.news = News()
        self._paused: set[str] = set()
        self._late: list[tuple[str, Callable[[int], None]]] = []
        """Sends of finalizers of paused programs, to be called with the time at which the pause is over: in a
        process of its own the collector runs then."""
        self._killed: dict[Node, list[asyncio.Task[Any]]] = {}
        self._discards = False
        """True while what is left of a program is closed."""
        self._stopped_ns: dict[Node, int] = {}
        self._closing = False
        self._left: list[asyncio.Task[Any]] = []
        self._fallback = next(iter(self.nodes))
        self._unhandled = UnhandledExceptions(self._raised_ns, self._fallback, on_line)
        self._lock = threading.Lock()
        self._calls: list[tuple[Node, str, str]] = []
        """Calls by which programs have ended their process, with the line of each."""

    def _node(self, welcome: wire.Welcome) -> Node:
        node = Node(
            welcome.node,
            self,
            lane_map=self._map_of(welcome.lane_map),
            seed=welcome.seed,
            options=welcome.options,
            period_ns=welcome.period_ns,
            max_payload=welcome.max_payload,
            incarnation=welcome.incarnation,
            control_ns=welcome.control_ns,
            abilities=RadioAbilities(
                welcome.max_power_dbm, welcome.rates_mbps, welcome.acknowledges, welcome.periods_ms
            ),
            disk=partial(self._disks.of, welcome.node),
            unit=welcome.unit,
        )
        inboxes: dict[str, Mailbox[Any]] = {"radio": node.radio.inbox, "gnss": node.gnss.inbox}
        if node.backbone is not None:
            inboxes["backbone"] = node.backbone.inbox
        for name, inbox in inboxes.items():
            inbox.guard = partial(self._check_thread, node.id, f"{name}.drain() or receive()")
            inbox.waits = self._waits[name]
        node.radio.inbox.refill = partial(self._refill, node)
        return node

    def _map_of(self, data: object) -> LaneMap | RoadMap:
        """Return a map. Nodes that are given the same one share it: its arrays cannot be written to."""
        if self._map is None or self._map[0] is not data:
            self._map = data, map_from_wire(data)
        return self._map[1]

    def _refill(self, node: Node) -> None:
        """Deliver the packets that have arrived at a node whose program looks for them (lockstep)."""
        if self._thread != get_ident() or not self._runs(node) or node.id in self._paused:
            return
        if packets := self._window.take_packets(node.id, self._clock()):
            self.mail.deliver_packets(node.id, packets)

    def _check_thread(self, node: str, call: str) -> None:
        if self._thread is not None and self._thread != get_ident():
            raise RuntimeError(
                f"{node}: node.{call} in another thread than the event loop's: in lockstep nothing says at which "
                "emulated time it acts; give the thread what it needs, return what it has found from "
                'asyncio.to_thread(), and call it in the task; or run.pacing = "realtime"'
            )

    # What nodes ask of their link.

    def now_ns(self, node: str) -> int:
        """Emulated time in nanoseconds, by the clock of `node`."""
        self._check_thread(node, "now_ns")
        return self._clocks.now_of(node)

    def send_frame(self, frame: SentFrame) -> None:
        """Take a frame for the radio; a node that has ended is silent."""
        self._check_thread(frame.node, "radio.broadcast() or send()")
        self._enqueue(frame.node, "frames", frame)

    def send_message(self, node: str, to: str | None, payload: bytes) -> None:
        """Take a message for the backbone; a node that has ended is silent."""
        self._check_thread(node, "backbone.broadcast() or send()")
        self._enqueue(node, "messages", SentMessage(node, next(self._outbox.numbers), to, payload))

    def busy_ratio(self, node: str) -> float | None:
        """Return the channel busy ratio that a node knows now."""
        self._check_thread(node, "radio.busy_ratio")
        return self.busy.of(node)

    def send_report(self, report: Report) -> None:
        """Take a report."""
        self._check_thread(report.node, "report()")
        self._enqueue(report.node, "reports", report)

    def send_note(self, node: str, kind: str, level: str, text: str, details: dict[str, NoteDetail]) -> None:
        """Take a line of a log or an event of a program; the line is written at once."""
        self._check_thread(node, "log() or event()")
        self._note(node, kind, level, text, details)

    def _log(self, node: Node, level: str, text: str) -> None:
        """Take a line that a program has given to `logging`, in any thread; one that has ended is silent."""
        if self.nodes.get(node.id) is node:
            self._note(node.id, "log", level, text, {})

    def _note(
        self,
        node: str,
        kind: str,
        level: str,
        text: str,
        details: dict[str, NoteDetail],
        time_ns: int | None = None,
    ) -> None:
        if node in self._paused:
            self._late.append((node, partial(self._note, node, kind, level, text, details)))
            return
        time_ns, text = self._clock() if time_ns is None else time_ns, sendable(text)
        note = wire.Note(node, time_ns, kind, level, text[:LONGEST_NOTE], details)  # type: ignore[arg-type]
        self._outbox.notes.append(note)
        self._lines.add(node, time_ns, kind, level, text, details)
        self._on_traffic()

    def send_action(self, action: Action) -> None:
        """Take what a program asks its vehicle to do."""
        self._check_thread(action.node, "drive()")
        self._enqueue(action.node, "actions", action)

    def _enqueue(self, node: str, queue: str, item: object, time_ns: int | None = None) -> None:
        if node in self._paused:
            self._late.append((node, partial(self._enqueue, node, queue, item)))
        elif self._active[node]:
            if time_ns is not None and isinstance(item, Report):
                item = replace(item, time_ns=self._clocks.shown_ns(node, time_ns))
            getattr(self._outbox, queue).append(item)
            if self._call_log is not None:
                self._call_log.add(node, self._clock() if time_ns is None else time_ns, item)
            self._on_traffic()

    # What the transport asks of the host.

    def order_events(self, loop: VirtualTimeLoop) -> None:
        """Have events of one instant come in the order that the welcomes ask for; before the first grant."""
        order = next((order for order in self._orders.values() if order is not None), None)
        if order is not None:
            grid = Grid(order.slack_ns, order.phase_ns)
            self.mail.ordered = loop.order(self._chooser_of, self._deviated, grid)

    def start(self, loop: SkewedLoop, programs: Programs) -> None:
        """Schedule every node's program on `loop`."""
        self._loop = loop
        self._unhandled.attach(loop)
        logging.getLogger().addHandler(self._log_handler)
        self._programs = programs
        if self._debugger is not None:
            self._debugger.attach(self._is_debugged, self._clock)
        loop.on_task = self._new_task
        if isinstance(loop, VirtualTimeLoop):
            self._thread = get_ident()
            period_ns = next(iter(self.nodes.values())).period_ns
            loop.collect_every(max(1, round(COLLECTION_NS / period_ns)) * period_ns)
        for node in self.nodes.values():
            if self._active[node.id]:
                self._start(node)

    def _start(self, node: Node) -> None:
        main, context = self._main(node, self._programs[node.id]), self._context_of(node)
        self._mains[node.id] = self._loop.create_task(main, name=f"{node.id} main", context=context)

    def _context_of(self, node: Node) -> Context:
        context = context_of(self._programs[node.id])
        context.run(current_node.set, node)
        if (decimal := sys.modules.get("decimal")) is not None:  # one object in all copies of a context
            context.run(lambda: decimal.setcontext(decimal.getcontext().copy()))
        return context

    def _chooser_of(self, node: Node) -> EventChooser:
        order = self._orders[node.id]
        return chooser_of(Order("tape") if order is None else order)

    def _is_debugged(self) -> bool:
        """Return whether code runs on behalf of the node that is debugged, and its program goes on."""
        node, debugger = present_node(), self._debugger
        if node is None or debugger is None or self._closing:
            return False
        return debugger.stops_in(node.id) and self._runs(node)

    def _raised_ns(self, node: Node | None) -> int | None:
        """Emulated time of an exception of `node`: while its process ends (simulated), when that began."""
        if node in self._stopped_ns:
            return self._stopped_ns[node]
        return None if self._closing else self._clock()

    def stop(self, node: str, killed: bool, time_ns: int) -> None:
        """A node's process is gone (simulated): its program is cancelled, unheard; if killed it goes no further."""
        gone = self.nodes[node]
        goes_on = self._runs(gone)
        self._refill(gone)
        gone.disconnect(self._clocks.shown_ns(node, time_ns))
        self._active[node] = False
        self._late = [entry for entry in self._late if entry[0] != node]
        self._window.drop(node)
        self.news.drop(node)
        if killed:
            self._unhandled.silence(gone)
            self._killed[gone] = asyncio_internals.abandon_pending(self._tasks_of(gone))
            self._hold()
            self._disks.release(node)
        else:
            self._stopped_ns[gone] = time_ns
            self._tell_deadlocks([gone] if goes_on else [])
            for task in self._tasks_of(gone):
                task.cancel()

    def _settle_stopped(self) -> None:
        """End processes that have been ended in order: they have done what they could without waiting."""
        if not self._stopped_ns:
            return
        for gone in self._stopped_ns:
            self._unhandled.settle(gone)
            self._unhandled.silence(gone)
            for task in asyncio_internals.abandon_pending(self._tasks_of(gone)):
                self._context_of(gone).run(self._discard, task)
            self._killed[gone] = asyncio_internals.abandon_pending(self._tasks_of(gone))
            self._disks.release(gone.id)
        self._stopped_ns.clear()
        self._hold()

    def restart(self, welcome: wire.Welcome) -> None:
        """Run a node's program again, as another incarnation (simulated)."""
        node = self.nodes[welcome.node] = self._node(welcome)
        self._window.drop(node.id)
        self._orders[welcome.node] = welcome.order
        self._active[node.id] = True
        self._start(node)

    def pause(self, nodes: Iterable[str]) -> None:
        """Pause these nodes from now on, and no others: their callbacks wait (simulated)."""
        paused = set(nodes)
        for node in paused:
            self._refill(self.nodes[node])
        self._paused = paused
        self._hold()

    def _hold(self) -> None:
        assert isinstance(self._loop, VirtualTimeLoop)
        self._loop.hold(self._is_paused)

    def _is_paused(self, handle: asyncio.Handle) -> bool:
        owner = node_of(handle)
        return owner is not None and (owner.id in self._paused or owner in self._killed)

    def apply_clock_error(self, clocks: Iterable[wire.ClockError], loop: SkewedLoop) -> None:
        """Take new clocks of nodes."""
        self._clocks.apply(clocks, loop)

    def _deviated(self, node: Node, deviation: Deviation) -> None:
        if self._runs(node):
            self._outbox.deviations.append(deviation)

    @property
    def must_ask(self) -> bool:
        """True if nodes have enqueued what cannot be told before its instant has been granted (lockstep)."""
        return self._outbox.must_ask or self._unhandled.has_any

    def take_traffic(self) -> wire.Traffic:
        """Return everything that the nodes have enqueued since the last call."""
        return self._outbox.take(self._unhandled.take())

    def unhandled_so_far(self) -> wire.Traffic | None:
        """Return the exceptions that nobody has handled by now, if there are any, and leave them."""
        unhandled = self._unhandled.so_far()
        return wire.Traffic(unhandled=unhandled) if unhandled else None

    def take_final(self) -> wire.Traffic:
        """Return what the emulator has not been told when the process ends: exceptions and notes."""
        self._take_process_ends()
        return self._window.take_final(self.take_traffic())

    # Windows (lockstep).

    def open_window(self, grant: wire.Grant, mail: Mail | None = None) -> int:
        """Take a grant; returns its first instant, with everything delivered that is due at it.

        `mail` is what comes with the grant, if it is not in it (simulated).
        """
        if self._heap is not None:
            self._heap.scatter()
        late, self._late = self._late, []
        for _, say in late:
            say(grant.time_ns)
        packets, fixes = mail or Mail.of(grant.packets, grant.fixes)
        self._window.open(grant.end_ns, packets)
        if grant.busy:
            self.busy.add(grant.busy)
        if grant.results or grant.messages:
            self.news.add(grant.results, arrived_in_full(grant.messages))
        self._deliver_due(grant.time_ns, fixes)
        return grant.time_ns

    def next_instant(self, next_timer_ns: int | None) -> int | None:
        """End an instant at which nothing is left to do; returns the window's next, with its packets delivered.

        Returns None if there is none before the end of the window. Packets that nobody awaits make no instant.
        """
        if self._calls:
            self._take_process_ends()
        self._settle_stopped()
        (window := self._window).end_instant(self._clock(), self.take_traffic())
        next_ns = window.end_ns if next_timer_ns is None else next_timer_ns
        next_ns = self.news.first_ns(self._paused, next_ns)
        if self._waits["radio"].count:
            next_ns = min(next_ns, window.first_packet_ns(self._awaits_packet))
        if next_ns >= window.end_ns:
            return None
        self._deliver_due(next_ns)
        return next_ns

    def _may_take(self, node: str) -> bool:
        return self._active[node] and node not in self._paused

    def _awaits_packet(self, node: str) -> bool:
        return self._may_take(node) and self.nodes[node].radio.inbox.waiting

    def _deliver_due(self, time_ns: int, fixes: Sequence[tuple[str, Fix]] = ()) -> None:
        self.mail.deliver(Mail(self._take_packets(time_ns), fixes), time_ns)
        if arrived := self.news.take(time_ns, self._paused):
            self.mail.deliver_news([each for each in arrived if self._active[each.node]], time_ns)

    def _take_packets(self, time_ns: int) -> dict[str, list[Packet]]:
        """Return the packets that are due now at nodes that await some; other nodes take theirs as they look."""
        if self.mail.ordered is not None:
            nodes = [node for node in self._window.with_packets(time_ns) if self._may_take(node)]
        elif self._waits["radio"].count:
            nodes = [node for node in self._window.with_packets(time_ns) if self._awaits_packet(node)]
        else:
            return {}
        return {node: self._window.take_packets(node, time_ns) for node in nodes}

    def make_yield(self, nonce: bytes, seq: int, next_timer_ns: int | None) -> wire.Yield:
        """Return the yield of the process when `next_instant` has found no further one in its window."""
        nodes = self.nodes.values()
        radio = [node.id for node in nodes if node.radio.inbox.waiting] if self._waits["radio"].count else []
        gnss = [node.id for node in nodes if node.gnss.inbox.waiting] if self._waits["gnss"].count else []
        return wire.Yield(nonce, seq, next_timer_ns, radio, gnss, *self._window.take_steps())

    def end(self, node: str, kind: str, error: str = "", details: str = "", place: str = "") -> None:
        """Record that a node's program is over, and cancel what it left running."""
        if not self._active[node]:
            return
        self._refill(self.nodes[node])
        self._active[node] = False
        self.nodes[node].radio.forget_results()
        ending = wire.Ending(node, kind, error, details, place, self._clock())  # type: ignore[arg-type]
        self._outbox.endings.append(ending)
        self._on_line(node, f"{node} {kind}\n{details}".rstrip())
        for task in self._tasks_of(self.nodes[node]):
            if task is not asyncio.current_task(self._loop):
                task.cancel()
        self._on_traffic()

    def process_ended(self, node: Node | None, call: str) -> None:
        """Have the vehicle die that has ended its process by `call`, from any thread (simulated).

        What it has enqueued before stays; nothing of it goes further.
        """
        with self._lock:
            self._calls.append((self.nodes[self._fallback] if node is None else node, call, line_of_caller()))
        if get_ident() == self._thread:
            self._take_process_ends()

    def _take_process_ends(self) -> None:
        while self._calls:
            with self._lock:
                node, call, place = self._calls.pop(0)
            if self._runs(node) and not self._closing:
                self.end(node.id, "died", call, place=place)
                for task in self._tasks_of(node):
                    task.cancel()
            elif node.id in self.nodes:
                self._unhandled.add(node, ProcessEndedError(call), f"as it ended ({place})")

    def _tasks_of(self, node: Node) -> list[asyncio.Task[Any]]:
        return [task for task, owner in list(self._tasks.items()) if owner is node and not task.done()]

    def run(self, loop: VirtualTimeLoop, only_programs_raise: Callable[[], bool] = lambda: False) -> NoReturn:
        """Run the programs until an exchange raises; a busy loop, or an exit, ends its node and no other.

        `only_programs_raise` tells whether a KeyboardInterrupt can only be the programs' own.
        """
        while True:
            try:
                loop.run_forever()
            except SpinError as spin:
                self._end_spinning(loop, spin)
            except (SystemExit, KeyboardInterrupt) as leave:
                if isinstance(leave, KeyboardInterrupt) and not only_programs_raise():
                    raise
                self._end_exited(leave)

    def _end_spinning(self, loop: VirtualTimeLoop, spin: SpinError) -> None:
        """After a SpinError: end the nodes whose callbacks or timers were still coming, and say where they stand.

        What spins on although it was cancelled loses its callbacks.
        """
        ready, timer = asyncio_internals.ready_queue(loop), asyncio_internals.next_timer(loop)
        owners = dict.fromkeys(node_of(handle) for handle in ready or ([] if timer is None else [timer]))
        spinning = [owner for owner in owners if owner is not None] or list(self.nodes.values())
        if not any(self._runs(node) for node in spinning):
            kept = [handle for handle in ready if node_of(handle) not in spinning]
            ready.clear()
            ready.extend(kept)
        for node in spinning:
            if self._runs(node):
                self.end(node.id, "spun", str(spin), self.stacks(node.id))

    def _end_exited(self, leave: SystemExit | KeyboardInterrupt) -> None:
        """After an exception that left the loop: the task or callback that raised it has ended its node's program.

        Raises `leave` if no program has raised it.
        """
        for task, owner in list(self._tasks.items()):
            if owner is not None and task.done() and asyncio_internals.error_of(task) is leave:
                asyncio_internals.disclaim(task)
                self._exited(owner, leave)
                return
        handle = asyncio_internals.handle_that_raised(leave)
        owner = None if handle is None else node_of(handle)
        if owner is None:
            raise leave
        self._exited(owner, leave)

    def _exited(self, node: Node, error: BaseException) -> None:
        if isinstance(error, SystemExit) and not error.code:
            self._over(node, "finished")
        elif self._runs(node) and not self._closing:
            details = sendable(traceback_text(error, of_program(error.__traceback__)))
            self._over(node, "crashed", error_line(error), details, own_line(error))
        else:
            self._unhandled.add(node, error, "in main")

    def _runs(self, node: Node) -> bool:
        """Return whether its program goes on, and is not what is left of an earlier incarnation."""
        return self.nodes[node.id] is node and self._active[node.id]

    def stacks(self, node: str) -> str:
        """Stacks of the tasks of a node, as text."""
        return asyncio_internals.stacks_of(self._tasks_of(self.nodes[node]))

    def _cancel_all(self) -> list[asyncio.Task[Any]]:
        live = [(task, owner) for task, owner in self._tasks.items() if not task.done()]
        tasks = [task for task, owner in live if owner is not None and owner not in self._killed]
        for task in tasks:
            task.cancel()
        return tasks

    def _tell_deadlocks(self, nodes: Iterable[Node]) -> None:
        """Tell of those of the nodes, whose programs go on, that nothing could wake however long the run lasted."""
        assert isinstance(self._loop, VirtualTimeLoop)
        woken = {node_of(handle) for handle in self._loop.pending()}
        for node in nodes:
            if node in woken or _awaits_emulator(node) or outside_loop.has_threads(node):
                continue
            if tasks := self._tasks_of(node):
                places = ", ".join(sorted({line_of_task(task) for task in tasks}))
                why = " (a thread called into the loop, and was refused)" if self._loop.has_refused else ""
                error = DeadlockError(f"nothing is left to wake the program{why}; if it is over, let it return")
                error.add_note(self.stacks(node.id))
                self._unhandled.add(node, error, f"in {'a task' if len(tasks) == 1 else 'all tasks'} ({places})")

    def forget_interrupt(self) -> None:
        """Take note of the interrupt that has ended a task, of which asyncio would print a traceback otherwise."""
        for task in list(self._tasks):
            if task.done() and not task.cancelled():
                task.exception()

    def close(self, loop: VirtualTimeLoop, time_ns: int | None = None) -> None:
        """Cancel all programs and let their `finally` blocks run, as far as they do not wait (lockstep).

        They run at `time_ns`, the end; None: when their process last had anything to do.
        `take_traffic` then returns the exceptions that nobody has handled, and programs in a deadlock.
        """
        self._closing = True
        if self._paused:
            self.pause(())  # whoever is paused ends as the others do
        if self._mains:  # else the run has ended before the first grant
            self._tell_deadlocks([node for node in self.nodes.values() if self._runs(node)])
        if time_ns is not None:
            loop.end_at(time_ns)
        tasks = self._cancel_all()
        with contextlib.suppress(LoopAbandonedError, SpinError):
            while True:
                try:
                    loop.finish(asyncio_internals.all_done(tasks))
                    break
                except SystemExit as leave:
                    self._end_exited(leave)
        self._left = asyncio_internals.abandon_pending(tasks)
        del tasks  # it would keep their exceptions from being discarded
        self._settle()
        self._thread = None  # what is left of programs is silent, and any thread's collector may find it

    def discard_abandoned(self, show: Callable[[str], None] = lambda node: None) -> None:
        """Discard what is left of programs that were killed or wait at the end, after the loop has been closed.

        `show` is told whose code runs: one that catches all that ends it may run on and on.
        """
        if self._killed:
            gc.collect()  # what others have left may still act
            with nothing_changed():
                for node, tasks in self._killed.items():
                    show(node.id)
                    for task in tasks:
                        self._discard(task)
                show("")
                self._killed.clear()
                gc.collect()  # what else it has left, which Python would discard at any time
        for task in self._left:
            if (owner := self._tasks[task]) is not None:
                show(owner.id)
            self._discard(task)
        show("")

    def _discard(self, task: asyncio.Task[Any]) -> None:
        self._discards = True
        try:
            asyncio_internals.close_abandoned(task)
        finally:
            self._discards = False

    async def cancel(self) -> None:
        """Cancel all programs and wait a second at most for their `finally` blocks (real time)."""
        self._closing = True
        if tasks := self._cancel_all():
            await asyncio.wait(tasks, timeout=1.0)
        del tasks  # it would keep their exceptions from being discarded
        self._settle()

    def _settle(self) -> None:
        self._settle_stopped()
        self._unhandled.settle()
        self._unhandled.close()
        if self._debugger is not None:
            self._debugger.detach()
        logging.getLogger().removeHandler(self._log_handler)

    async def _main(self, node: Node, program: Program) -> None:
        try:
            if self._debugger is not None:
                self._debugger.begin(node.id, program)
            await program(node)
        except (KeyboardInterrupt, ProcessEndedError):
            raise
        except (asyncio.CancelledError, GeneratorExit) as error:  # of what the program awaits, unless vnet ends it
            if self._discards or self._closing or not self._runs(node):
                raise
            self._exited(node, error)
        except BaseException as error:
            if self._discards:  # it is told to end, whatever it makes of that
                raise
            if self._debugger is not None and isinstance(error, Exception):
                self._debugger.crashed(node.id, error)
            self._exited(node, error)
        else:
            self._over(node, "finished")

    def _over(self, node: Node, kind: str, error: str = "", details: str = "", place: str = "") -> None:
        if self.nodes[node.id] is node:  # and not what is left of an earlier incarnation
            self.end(node.id, kind, error, details, place)

    def _new_task(self, task: Task) -> None:
        self._tasks[task] = task.node
        self._unhandled.watch(task, task.node)


@dataclass
class Outbox:
    """Traffic in the order in which it was made, by kind."""

    frames: list[SentFrame] = field(default_factory=list)
    reports: list[Report] = field(default_factory=list)
    endings: list[wire.Ending] = field(default_factory=list)
    notes: list[wire.Note] = field(default_factory=list)
    deviations: list[Deviation] = field(default_factory=list)
    actions: list[Action] = field(default_factory=list)
    messages: list[SentMessage] = field(default_factory=list)
    numbers: Iterator[int] = field(default_factory=count)
    """Numbers of messages of the backbone, of which no two are equal."""

    @property
    def must_ask(self) -> bool:
        """True if there is more than frames: what is reported and logged stays whatever becomes of the process."""
        told = self.reports or self.endings or self.notes or self.deviations or self.actions or self.messages
        return bool(told)

    def take(self, unhandled: Sequence[wire.Unhandled]) -> wire.Traffic:
        """Remove and return all of it, with exceptions that nobody handled."""
        frames, reports, endings, notes = self.frames, self.reports, self.endings, self.notes
        deviations, actions, messages = self.deviations, self.actions, self.messages
        self.frames, self.reports, self.endings, self.notes = [], [], [], []
        self.deviations, self.actions, self.messages = [], [], []
        return wire.Traffic(frames, reports, endings, unhandled, notes, deviations, actions, messages)


class Disks:
    """The folders of nodes: `root/NODE`, or folders that end with this process where `root` is None.

    What lies below `root` is there again after a restart.
    """

    def __init__(self, root: Path | None = None) -> None:
        self._root = None if root is None else root.absolute()

    def of(self, node: str) -> Path:
        """Return the folder of `node`, which exists then. Raises OSError where the disk refuses."""
        if self._root is None:
            self._root = Path(mkdtemp(prefix="vnet-disks-"))
            weakref.finalize(self, shutil.rmtree, self._root, ignore_errors=True)
        folder = self._root / node
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def release(self, node: str) -> None:
        """Release what a program that was ended holds open on its disk, unflushed and unlocked, as a system does.

        What it has left in buffers goes nowhere, and an open transaction of SQLite is rolled back.
        """
        if self._root is None or not (self._root / node).is_dir():
            return
        below = f"{os.path.realpath(self._root / node)}/"
        for database in _open_databases():
            with contextlib.suppress(Exception):  # of a thread of the program, or closed
                cursor, texts = database.cursor(), database.text_factory
                cursor.row_factory, database.text_factory = None, str
                try:
                    files = cursor.execute("PRAGMA database_list").fetchall()
                finally:
                    database.text_factory = texts
                if any(file.startswith(below) for _, _, file in files):
                    database.close()
        nowhere = os.open(os.devnull, os.O_RDWR)
        for descriptor in Path("/proc/self/fd").iterdir():
            with contextlib.suppress(OSError):  # that of the list is closed
                if str(descriptor.readlink()).startswith(below):
                    os.dup2(nowhere, int(descriptor.name), inheritable=False)
        os.close(nowhere)
        for logger in [logging.getLogger(), *logging.Logger.manager.loggerDict.values()]:
            for handler in list(getattr(logger, "handlers", ())):  # else the next incarnation would log to nowhere
                if os.path.realpath(getattr(handler, "baseFilename", "/")).startswith(below):
                    logger.removeHandler(handler)  # type: ignore[union-attr]


def _open_databases() -> list[Any]:
    if "sqlite3" not in sys.modules:
        return []
    kind = sys.modules["sqlite3"].Connection
    # By its type: to ask a proxy what it is an instance of runs its code.
    return [each for each in gc.get_objects() if issubclass(type(each), kind)]


CHANGES = (
    *("os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate"),
    *("os.chmod", "os.chown", "os.utime", "socket.connect", "socket.bind", "socket.sendto", "sqlite3.connect"),
    *("os.kill", "os.system", "os.fork", "os.forkpty", "os.posix_spawn", "subprocess.Popen"),
)
"""Audit events of what a program does to the world, beside opening a file to write to it."""
_discarding: int | None = None
"""The thread in which what was killed is discarded."""


def is_discarding() -> bool:
    """Return whether code of the present thread is that of a killed program."""
    return _discarding == get_ident()


def _refuse_changes(event: str, arguments: tuple[Any, ...]) -> None:
    if is_discarding() and (event in CHANGES or (event == "open" and arguments[2] & (os.O_ACCMODE | os.O_CREAT))):
        raise ProcessEndedError(f"{event}: the program has been killed")


@contextlib.contextmanager
def nothing_changed() -> Iterator[None]:
    """Refuse what is done to the world meanwhile: Python runs `finally` blocks as it discards what was killed."""
    global _discarding
    _watched()
    _discarding = get_ident()
    try:
        yield
    finally:
        _discarding = None


@cache
def _watched() -> None:
    """Have audit events looked at, from the first kill on: they are for ever."""
    sys.addaudithook(_refuse_changes)


LONGEST_NOTE = 4000
"""Characters of a line that are told to the emulator."""
MOST_LINES = 100_000
"""Lines of a node's log that are written by one process, so that a flood fills no disk."""


class NodeLogHandler(logging.Handler):
    """Hands records to `write`, with the node on whose behalf they are made and their level.

    Records on nobody's behalf, and asyncio's own, go the way of `logging.lastResort`, as without this handler.
    """

    is_vnets = True

    def __init__(self, write: Callable[[Node, str, str], None]) -> None:
        super().__init__()
        self._write = write

    def createLock(self) -> None:
        """Make no lock: `write` needs none, and may wait for the emulator while others log."""
        self.lock = None

    def handle(self, record: logging.LogRecord) -> Any:
        """Take a record unless a filter refuses it; from Python 3.13 on logging's own method needs a lock."""
        kept = self.filter(record)
        if kept:
            self.emit(kept if isinstance(kept, logging.LogRecord) else record)
        return kept

    def emit(self, record: logging.LogRecord) -> None:
        """Take a record."""
        node = outside_loop.awaited_node()
        if node is None or record.name == "asyncio":
            last = logging.lastResort
            alone = logging.getLogger().handlers == [self]
            if alone and last is not None and record.levelno >= last.level:
                last.handle(record)
        else:
            try:
                level = next((name for least, name in _NAMES if record.levelno >= least), "debug")
                self._write(node, level, f"{record.name}: {self.format(record)}")
            except Exception:
                self.handleError(record)


class NodeLines:
    """Lines of nodes' logs, with their emulated time, up to `MOST_LINES` of each node."""

    def __init__(self, write: Callable[[str, str], None]) -> None:
        self._write = write
        self._count: Counter[str] = Counter()

    def add(self, node: str, time_ns: int, kind: str, level: str, text: str, details: Mapping[str, object]) -> None:
        """Write a line of a program, or an event with its details, to a node's log, unless there were too many."""
        said = ", ".join(f"{key}={value}" for key, value in details.items()).replace("\n", "\\n")
        line = f"{'' if kind == 'log' else 'event '}{text} {said}".rstrip().replace("\n", "\n    ")
        self._count[node] += 1
        if self._count[node] <= MOST_LINES:
            self._write(node, f"{time_ns / NS_PER_S:.6f} {node} {level}: {line}")
        elif self._count[node] == MOST_LINES + 1:
            self._write(node, f"(further lines of {node} are left out after {MOST_LINES:,})")


_NAMES = (
    (logging.CRITICAL, "critical"),
    (logging.ERROR, "error"),
    (logging.WARNING, "warning"),
    (logging.INFO, "info"),
)


def _awaits_emulator(node: Node) -> bool:
    """Return whether a task waits for a packet, a fix, a message or the result of a send."""
    inboxes: list[Mailbox[Any]] = [node.radio.inbox, node.gnss.inbox]
    inboxes += [node.backbone.inbox] if node.backbone is not None else []
    return node.radio.is_sending or any(inbox.waiting for inbox in inboxes)
