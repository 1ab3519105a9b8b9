"""Everything that a process has been granted for its nodes, until it is in their mailboxes.

A grant brings packets and fixes (`Mail`), results of sends and messages of the backbone (`News`), and busy ratios.
In lockstep a `Window` keeps what lies ahead; `MailDelivery` puts what is due into the mailboxes, with the times
that the nodes' clocks show.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from operator import attrgetter
from typing import Any, NamedTuple

from msgspec.structs import replace

from vnet.node import Fix, Node
from vnet.radio import INBOX_LIMIT, Mailbox, Packet
from vnet.runtime.own_asyncio import present_node
from vnet.runtime.ready_queue import OrderedQueue
from vnet.runtime.virtual_time import SkewedLoop
from vnet.transport import wire
from vnet.transport.wire import BusyRatios, ClockError, WireMessage, WireSendResult


class NodeClocks:
    """The clocks of the nodes of a process; `now_ns` gives the emulated time in nanoseconds."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._errors: dict[str, ClockError] = {}
        self._past: dict[str, list[ClockError]] = {}

    def apply(self, errors: Iterable[ClockError], loop: SkewedLoop) -> None:
        """Take new errors of clocks, which the timers of tasks on `loop` follow from now on."""
        for error in errors:
            self._past.setdefault(error.node, []).append(error)
            self._errors.pop(error.node, None)
            if error.is_wrong:
                self._errors[error.node] = error
        loop.clock_error_of = self._error_of_task if self._errors else lambda: None
        loop.clock_errors_of = lambda node: self._past.get(node, ())

    def _error_of_task(self) -> ClockError | None:
        node = present_node()
        return None if node is None else self._errors.get(node.id)

    def now_of(self, node: str) -> int:
        """Return what the clock of `node` shows now, in nanoseconds."""
        error = self._errors.get(node)
        return self._now_ns() if error is None else max(error.shown_ns(self._now_ns()), 0)

    def has_been_wrong(self, node: str) -> bool:
        """Return whether the clock of `node` has ever been given an error."""
        return node in self._past

    def shown_ns(self, node: str, time_ns: int) -> int:
        """Return what the clock of `node` showed at `time_ns`, as it went then."""
        for error in reversed(self._past.get(node, ())):
            if error.since_ns <= time_ns:
                return max(error.shown_ns(time_ns), 0)
        return time_ns


class Mail(NamedTuple):
    """Packets of each node, oldest first, and fixes with their nodes."""

    packets: dict[str, list[Packet]]
    fixes: Sequence[tuple[str, Fix]]

    @classmethod
    def of(cls, packets: Iterable[wire.WirePacket], fixes: Iterable[wire.WireFix]) -> Mail:
        """Return mail from its form on the wire."""
        by_node: dict[str, list[Packet]] = {}
        for packet in packets:
            by_node.setdefault(packet.node, []).append(packet.packet())
        return cls(by_node, [(fix.node, fix.fix()) for fix in fixes])

    def within(self, grant: wire.Grant) -> wire.Grant:
        """Return a grant that holds this mail, in its form on the wire."""
        packets = [wire.WirePacket.of(node, packet) for node, some in self.packets.items() for packet in some]
        return replace(grant, packets=packets, fixes=[wire.WireFix.of(*each) for each in self.fixes])


NewsItem = WireSendResult | WireMessage


class News:
    """News whose instants have not come yet, in the order of time."""

    def __init__(self) -> None:
        self._waiting: list[NewsItem] = []

    def add(self, *some_news: Sequence[NewsItem]) -> None:
        """Add news."""
        if any(some_news):
            new = [item for some in some_news for item in some]
            self._waiting = sorted([*self._waiting, *new], key=lambda item: item.time_ns)

    def drop(self, node: str) -> None:
        """Drop what comes for a node whose process is gone."""
        self._waiting = [item for item in self._waiting if item.node != node]

    def first_ns(self, paused: Collection[str], otherwise_ns: int) -> int:
        """Return the instant of the first item for a node that is not paused, or `otherwise_ns` if earlier."""
        if not self._waiting:
            return otherwise_ns
        times_ns = (item.time_ns for item in self._waiting if item.node not in paused)
        return min(next(times_ns, otherwise_ns), otherwise_ns)

    def take(self, time_ns: int, paused: Collection[str] = ()) -> list[NewsItem]:
        """Remove and return the news of all instants up to `time_ns`; those of paused nodes wait."""
        if not self._waiting:
            return []
        due: list[NewsItem] = []
        waiting: list[NewsItem] = []
        for item in self._waiting:
            is_due = item.time_ns <= time_ns and item.node not in paused
            (due if is_due else waiting).append(item)
        self._waiting = waiting
        return due


class MeasuredBusyRatios:
    """Busy ratios of `nodes` over the latest time, each from its instant on; `clock` gives emulated nanoseconds."""

    def __init__(self, nodes: Sequence[str], clock: Callable[[], int]) -> None:
        self._index = {node: index for index, node in enumerate(nodes)}
        self._clock = clock
        self._measured: deque[BusyRatios] = deque()

    def add(self, measured: Sequence[BusyRatios]) -> None:
        """Add measurements, which replace those that begin at the same instant or later."""
        while self._measured and measured and self._measured[-1].from_ns >= measured[0].from_ns:
            self._measured.pop()
        self._measured.extend(measured)
        self._drop_past()

    def _drop_past(self) -> None:
        while len(self._measured) > 1 and self._measured[1].from_ns <= self._clock():
            self._measured.popleft()

    def of(self, node: str) -> float | None:
        """Return the busy ratio that a node knows now; None if no medium is shared."""
        self._drop_past()
        return self._measured[0].ratios[self._index[node]] if self._measured else None


_received_ns = attrgetter("received_ns")


class Window:
    """The window of a process, with its packets, each at its arrival, and the steps that were made in it.

    The emulator grants a process a window of time, in which it passes from instant to instant by itself
    (docs/virtual-time.md). Packets stay until their node looks for them, also beyond the window.
    """

    def __init__(self) -> None:
        self.end_ns = 0
        """The end of the window, which is not in it."""
        self._packets: dict[str, list[Packet]] = {}
        self._steps: list[wire.Step] = []
        self._instants = 0

    def open(self, end_ns: int, packets: dict[str, list[Packet]]) -> None:
        """Begin the next window; the steps of the last one have been taken.

        Its packets, oldest first for each node, go behind those that wait. Of these a mailbox would keep the last.
        """
        self.end_ns = end_ns
        if not self._packets:
            self._packets = packets
            return
        for node, new in packets.items():
            if waiting := self._packets.get(node):
                if len(waiting) > 2 * INBOX_LIMIT:
                    del waiting[:-INBOX_LIMIT]
                waiting += new
            else:
                self._packets[node] = new

    def drop(self, node: str) -> None:
        """Drop the packets of a node whose process is gone."""
        self._packets.pop(node, None)

    def end_instant(self, time_ns: int, traffic: wire.Traffic) -> None:
        """Note that the process has nothing left to do at an instant, and what was enqueued at it."""
        self._instants += 1
        if traffic:
            self._steps.append(wire.Step(time_ns, traffic))

    def with_packets(self, time_ns: int) -> list[str]:
        """Return the nodes at which packets have arrived by then that are yet to be taken."""
        return [node for node, some in self._packets.items() if some[0].received_ns <= time_ns]

    def first_packet_ns(self, awaits: Callable[[str], bool]) -> int:
        """Return the arrival of the first packet at a node that `awaits` one, or the window's end."""
        first_ns = self.end_ns
        for node, some in self._packets.items():
            if some[0].received_ns < first_ns and awaits(node):  # few are asked: this runs at every instant
                first_ns = some[0].received_ns
        return first_ns

    def take_packets(self, node: str, time_ns: int) -> list[Packet]:
        """Remove and return the packets that have arrived at a node by then, oldest first."""
        some = self._packets.get(node, [])
        if not some or some[-1].received_ns <= time_ns:
            return self._packets.pop(node, some)
        due = bisect_right(some, time_ns, key=_received_ns)
        if due:
            self._packets[node] = some[due:]
        return some[:due]

    def take_final(self, last: wire.Traffic) -> wire.Traffic:
        """Return the exceptions and notes that have not been taken, and those of the `last` traffic."""
        steps, _ = self.take_steps()
        parts = [*(step.traffic for step in steps), last]
        unhandled = [each for part in parts for each in part.unhandled]
        return wire.Traffic(unhandled=unhandled, notes=[note for part in parts for note in part.notes])

    def take_steps(self) -> tuple[list[wire.Step], int]:
        """Return the steps since the last call, and the number of instants at which the process ran."""
        taken = self._steps, self._instants
        self._steps, self._instants = [], 0
        return taken


class MailDelivery:
    """Mailboxes of `nodes`; `clocks` give the times that packets show.

    With an `ordered` queue what arrives at the present instant is an event there, and not in the mailbox at once.
    """

    def __init__(self, nodes: Mapping[str, Node], clocks: NodeClocks) -> None:
        self._nodes = nodes
        self._clocks = clocks
        self.ordered: OrderedQueue | None = None

    def deliver(self, mail: Mail, time_ns: int | None = None) -> None:
        """Deliver packets, then fixes; `time_ns` is the instant, where there is one."""
        if self.ordered is not None and time_ns is not None:
            self._add_events(self.ordered, mail, time_ns)
            return
        for node, packets in mail.packets.items():
            self.deliver_packets(node, packets)
        for node, fix in mail.fixes:
            self._nodes[node].gnss.inbox.deliver((fix,))

    def deliver_packets(self, node: str, packets: Sequence[Packet]) -> None:
        """Deliver packets, oldest first, to a node."""
        self._nodes[node].radio.inbox.deliver(self._shown(node, packets))

    def deliver_news(self, arrivals: Iterable[NewsItem], time_ns: int | None = None) -> None:
        """Deliver results of frames to single nodes, and messages of the backbone."""
        for arrival in arrivals:
            node = self._nodes[arrival.node]
            if isinstance(arrival, WireMessage):
                self._deliver_message(node, arrival, time_ns)
                continue
            show = partial(node.radio.settle, arrival.number, arrival.result())
            if self.ordered is None or time_ns is None or arrival.time_ns < time_ns:
                show()
            else:
                self.ordered.add_event(node, f"result of send {arrival.number}", "send", show, lambda: True)

    def _deliver_message(self, node: Node, arrival: WireMessage, time_ns: int | None) -> None:
        if node.backbone is None:
            return
        message, inbox = arrival.message(), node.backbone.inbox
        if self._clocks.has_been_wrong(node.id):
            message = message._replace(received_ns=self._clocks.shown_ns(node.id, message.received_ns))
        show = partial(inbox.deliver, (message,))
        if self.ordered is None or time_ns is None or arrival.time_ns < time_ns:
            show()
        else:
            label = f"message from {message.sender}"
            self.ordered.add_event(node, label, "backbone", show, partial(_is_awaited, inbox))

    def _shown(self, node: str, packets: Sequence[Packet]) -> Sequence[Packet]:
        """Return the packets of a node with the times of their arrivals as its clock showed them."""
        if not self._clocks.has_been_wrong(node):
            return packets
        return [replace(each, received_ns=self._clocks.shown_ns(node, each.received_ns)) for each in packets]

    def _add_events(self, ordered: OrderedQueue, mail: Mail, time_ns: int) -> None:
        """Deliver what has come before `time_ns`, and let the rest come in the order that is tried."""
        for name, packets in mail.packets.items():
            node = self._nodes[name]
            for packet, shown in zip(packets, self._shown(name, packets), strict=True):
                show = partial(node.radio.inbox.deliver, (shown,))
                if packet.received_ns < time_ns:
                    show()
                else:
                    awaited = partial(_is_awaited, node.radio.inbox)
                    ordered.add_event(node, f"packet from {packet.sender}", "radio", show, awaited)
        latest = dict(mail.fixes)
        for name, fix in mail.fixes:
            node = self._nodes[name]
            show_fix = partial(node.gnss.inbox.deliver, (fix,))
            if fix is latest[name] and time_ns % node.period_ns == 0:
                ordered.add_event(node, "fix", "gnss", show_fix, partial(_is_awaited, node.gnss.inbox))
            else:
                show_fix()


def _is_awaited(inbox: Mailbox[Any]) -> bool:
    return inbox.waiting
