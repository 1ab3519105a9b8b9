"""A run in real time, without any transport: the engine on the monotonic clock.

Traffic is taken when it comes, and what is due goes out in batches; `run_in_real_time` is the loop that moves both.
"""

from __future__ import annotations

import asyncio
import importlib
import time
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

from emulator.drivers.emulation import Emulation, ProcessActions
from emulator.drivers.processes import Processes, ProtocolError, check_ownership
from emulator.radio.engine import Delivery
from emulator.records.events import EventKind
from vnet.runtime.arrivals import NewsItem
from vnet.transport import wire
from vnet.transport.wire import SentMessage, WireMessage
from vnet.units import NS_PER_S

KEPT_NS = 10 * NS_PER_S
"""Nanoseconds for which messages of the backbone are kept for processes that have not seen them."""
LEAST_WAIT_S = 1e-9
"""Seconds for which messages are awaited in each round, so that they can come at all."""
WORST_PROCESSES = 8
"""Number of processes, those with the most late deliveries, that an event names."""
WORST_SECONDS = 20
"""Number of seconds, those with the most late deliveries, that an event names."""


class _Sent(NamedTuple):
    """Contents of a batch that are dealt with if its process has missed it."""

    time_ns: int
    deliveries: list[Delivery]
    news: list[NewsItem]
    lost: list[tuple[int, int]]


_NOTHING_SENT = _Sent(0, [], [], [])


class RealTime:
    """A run on the wall clock: traffic is taken when it comes, and what is due goes out in batches.

    Each batch is remembered until its process acknowledges it; what it missed is lost in `transport`, but for the
    results of frames to single vehicles, which programs await, and messages of the backbone: they go out again.
    Processes come and go with faults: do what `take_actions` says, and tell `returned` when one is there again.
    """

    def __init__(self, emulation: Emulation, processes: Sequence[Sequence[str]]) -> None:
        importlib.import_module("numpy.ma")  # pyarrow would, at its first array of numpy's, within the run
        self._emulation = emulation
        self._nodes = {nodes[0]: tuple(nodes) for nodes in processes}
        self._process_of = {node: nodes[0] for nodes in processes for node in nodes}
        self._batch_seq = dict.fromkeys(self._nodes, 0)
        self._frames_seq = dict.fromkeys(self._nodes, 0)
        self._unacknowledged: dict[str, dict[int, _Sent]] = {process_id: {} for process_id in self._nodes}
        self._lateness: dict[tuple[str, int], Sequence[int]] = {}  # by process and incarnation
        self._corrections: defaultdict[tuple[str, int], list[int]] = defaultdict(lambda: [0] * wire.LATENESS_BINS)
        """Corrections of that, for what restarts have held back."""
        self._holds: list[tuple[int, int]] = []
        """Spans in which a planned restart has held everything back."""
        self._held_since_ns: int | None = None
        self._cut_off: set[str] = set()
        """Processes whose next message shows what a restart has lost; those paused in it get nothing until then."""
        self._late_in: Counter[int] = Counter()  # how many deliveries were late, by the second that reported them
        self._present = {
            process_id for process_id, nodes in self._nodes.items() if any(emulation.up[node] for node in nodes)
        }
        self._awaited = set(self._present)
        self._paused: set[str] = set()
        self._was_paused: set[str] = set()
        self._actions: list[ProcessActions] = []
        self._packets: dict[str, list[Delivery]] = {}
        self._fixes: dict[str, list[wire.WireFix]] = {}
        self._news = emulation.news
        self._shown: dict[tuple[str, int], tuple[int, WireMessage]] = {}
        """Messages of the backbone that went out within `KEPT_NS`, and when, by unit and number."""
        self._clocks: dict[str, list[wire.ClockError]] = {process_id: [] for process_id in self._nodes}
        self._lost: dict[str, list[tuple[int, int]]] = {process_id: [] for process_id in self._nodes}
        """First and last of the ranges of frames that have not come, and of which their process is to know."""
        self._affected: set[str] = set()
        self._next_period = 0
        self._origin_ns = time.monotonic_ns()
        self._collected_ns = self._taken_ns = 0
        self._told_late: list[wire.Ending] = []
        """Ends of programs that were told after the run, such as those that a restart of the emulator held back."""
        self.gaps = 0

    @property
    def now_ns(self) -> int:
        """Emulated time: the time since the start, which is negative before."""
        return time.monotonic_ns() - self._origin_ns

    def taken_ns(self, monotonic_ns: int) -> int:
        """Return the emulated time at which to take what has come at an instant of the monotonic clock.

        That is the instant, if nothing later has gone out or been taken.
        """
        self._taken_ns = max(monotonic_ns - self._origin_ns, self._collected_ns, self._taken_ns)
        return self._taken_ns

    @property
    def wait_s(self) -> float:
        """Seconds until `due` must be called next, or until the end."""
        duration_ns = self._emulation.duration_ns
        return (min(self.next_time_ns() or duration_ns, duration_ns) - self.now_ns) / NS_PER_S

    @property
    def is_over(self) -> bool:
        """True from the end of the run on."""
        return self.now_ns >= self._emulation.duration_ns

    def start(self, origin_ns: int) -> dict[str, wire.Batch]:
        """The batches that start every process that is there; time 0 is `origin_ns` on the monotonic clock."""
        self._origin_ns = origin_ns
        return {
            process_id: self._batch(process_id, origin_ns=origin_ns)
            for process_id in self._nodes
            if process_id in self._present
        }

    def next_time_ns(self) -> int | None:
        """Time at which `due` must be called next: the next arrival, fix or fault."""
        candidates = [
            self._emulation.engine.next_time(),
            self._news.next_ns(),
            self._emulation.fix_time_ns(self._next_period),
            self._emulation.next_change_ns(),
            self._emulation.next_control_ns(),
        ]
        due = [time_ns for time_ns in candidates if time_ns is not None]
        return min(due) if due else None

    def receive(self, now_ns: int, process_id: str, message: wire.Frames) -> None:
        """Take a process's traffic and acknowledgements. Raises ProtocolError if it speaks for others."""
        check_ownership(self._nodes[process_id], message.traffic)
        expected = self._frames_seq[process_id]
        is_back = process_id in self._cut_off and process_id not in self._paused
        if is_back:
            self._cut_off.discard(process_id)
        if message.seq != expected and not is_back and not self._all_held([now_ns]):  # else a restart has lost them
            self.gaps += 1
        if message.seq > expected:
            self._lost[process_id].append((expected, message.seq - 1))
        self._frames_seq[process_id] = message.seq + 1
        process = process_id, self._emulation.incarnation[process_id]
        for seq, arrived_ns in message.late:
            sent = self._unacknowledged[process_id].get(seq, _NOTHING_SENT)
            self._delay(sent.deliveries, min(arrived_ns, now_ns))
            self._correct(process, sent.deliveries, arrived_ns)
        self._acknowledge(process_id, message)
        if message.lateness is not None:
            corrected = zip(message.lateness.counts, self._corrections[process], strict=True)
            counts = [max(count + correction, 0) for count, correction in corrected]
            self._late_in[now_ns // NS_PER_S] += _late(counts) - _late(self._lateness.get(process, ()))
            self._lateness[process] = counts
        if message.final:
            self._awaited.discard(process_id)
        if now_ns < self._emulation.duration_ns and self._emulation.ended_ns is None:
            self._change_by(now_ns)
            if message.traffic.endings and now_ns > self._collected_ns:
                self._collect(now_ns - 1)  # what came before the end has arrived
            self._emulation.take(now_ns, [message.traffic])
        else:
            self._told_late += message.traffic.endings
            if self._emulation.ended_ns is None:  # else the run was interrupted
                self._emulation.take_final(self._emulation.duration_ns, [message.traffic])

    def take_answer(self, process_id: str, answer: wire.StackDump) -> None:
        """Take the answer of a process after a restart, which has lost what is missing before its `seq`."""
        if not self.is_held:
            return
        self._cut_off.discard(process_id)
        expected = self._frames_seq[process_id]
        if answer.seq is None:
            self._cut_off.add(process_id)
        elif answer.seq > expected:
            self._lost[process_id].append((expected, answer.seq - 1))
            self._frames_seq[process_id] = answer.seq

    def take_messages(self, now_ns: int, messages: Sequence[SentMessage]) -> None:
        """Take messages of the backbone that have come later than the frames that refer to them."""
        if now_ns < self._emulation.duration_ns:
            self._change_by(now_ns)
            self._emulation.take(now_ns, [wire.Traffic(messages=messages)])

    @property
    def awaited(self) -> frozenset[str]:
        """The processes that have not sent their last message, and are neither dead nor taken by a fault."""
        return frozenset(self._awaited)

    def _acknowledge(self, process_id: str, message: wire.Frames) -> None:
        waiting = self._unacknowledged[process_id]
        if message.unseen:
            own = self._nodes[process_id]
            unseen = [(ref.node, ref.number) for ref in message.unseen if ref.node in own]
            shown = [self._shown[key] for key in unseen if key in self._shown]
            self.gaps += not self._all_held(time_ns for time_ns, _ in shown)
            self._news.repeat(each for _, each in shown)
        for first, last in message.missed:
            all_missed = [waiting.pop(seq) for seq in list(waiting) if first <= seq <= last]
            self.gaps += not self._all_held(missed.time_ns for missed in all_missed)
            for missed in all_missed:
                self._lose(missed.deliveries)
                self._news.repeat(missed.news)
                self._lost[process_id] += missed.lost
        for seq in [seq for seq in waiting if seq < message.received_seq]:
            del waiting[seq]

    def _delay(self, deliveries: Sequence[Delivery], arrived_ns: int) -> None:
        """Correct the arrivals of those deliveries of a batch that came over 20 ms late."""
        for delivery in deliveries:
            if arrived_ns - delivery.packet.received_ns >= wire.LATENESS_LIMIT_NS:
                self._emulation.engine.delay(delivery, arrived_ns)

    def _correct(self, process: tuple[str, int], deliveries: Sequence[Delivery], arrived_ns: int) -> None:
        """Count only the part of the lateness of a batch that no restart has caused."""
        for delivery in deliveries:
            late_ns = arrived_ns - delivery.packet.received_ns
            if held_ns := self._held_ns(delivery.packet.received_ns, arrived_ns):
                self._corrections[process][wire.lateness_bin(late_ns)] -= 1
                self._corrections[process][wire.lateness_bin(late_ns - held_ns)] += 1

    def _lose(self, deliveries: Sequence[Delivery]) -> None:
        for delivery in deliveries:
            self._emulation.engine.lose(delivery)

    def due(self, now_ns: int) -> dict[str, wire.Batch]:
        """Return what has become due by `now_ns`, by process."""
        self._change_by(now_ns)
        self._collect(now_ns)
        ready = self._present - self._paused - (self._cut_off & self._was_paused)
        informed = {self._process_of[node] for node, _ in self._news.firsts()}
        return {
            process_id: self._batch(process_id)
            for process_id in self._nodes
            if process_id in ready
            and (
                process_id in self._packets
                or process_id in self._fixes
                or process_id in informed
                or self._clocks[process_id]
                or self._lost[process_id]
            )
        }

    def take_actions(self) -> list[ProcessActions]:
        """Return what is to be done to processes by now."""
        actions, self._actions = self._actions, []
        return actions

    @property
    def is_held(self) -> bool:
        """True while a planned restart holds everything back."""
        return self._held_since_ns is not None

    def hold(self, now_ns: int, paused: Collection[str] = ()) -> None:
        """Take note that a planned restart holds everything back from now on; `paused` nodes find it over later."""
        self._held_since_ns = now_ns if self._held_since_ns is None else self._held_since_ns
        self._cut_off |= {self._process_of[node] for node in paused} & self._present

    def release(self, now_ns: int) -> None:
        """Take note that everything has gone out that a restart has held back."""
        assert self._held_since_ns is not None
        self._holds.append((self._held_since_ns, now_ns))
        self._held_since_ns = None

    def _held_ns(self, from_ns: int, until_ns: int) -> int:
        """Nanoseconds of a span in which restarts have held everything back."""
        holds = self._holds if self._held_since_ns is None else [*self._holds, (self._held_since_ns, until_ns)]
        return sum(max(min(until_ns, end_ns) - max(from_ns, start_ns), 0) for start_ns, end_ns in holds)

    def _all_held(self, sent_ns: Iterable[int]) -> bool:
        """Return whether all that was sent at these times, and something was, went out while a restart held it."""
        times_ns = list(sent_ns)
        return bool(times_ns) and all(self._held_ns(time_ns, time_ns + 1) for time_ns in times_ns)

    def _change_by(self, now_ns: int) -> None:
        """Begin and end the faults that are due: messages that have waited must meet those of their time."""
        if self._emulation.ended_ns is not None:  # the run was interrupted before
            return
        self._emulation.drive_to(now_ns)
        while (change_ns := self._emulation.next_change_ns()) is not None and change_ns <= now_ns:
            self._collect(change_ns - 1)
            self._act(change_ns)

    def _act(self, time_ns: int) -> None:
        actions = self._emulation.act(time_ns, starts_at_once=False)
        self._actions.append(actions)
        for process_id in {self._process_of[node] for node in actions.stop}:
            self._present.discard(process_id)
            self._awaited.discard(process_id)
            self._unacknowledged[process_id].clear()
            self._packets.pop(process_id, None)
            self._fixes.pop(process_id, None)
            self._news.take(self._nodes[process_id])
        paused = {self._process_of[node] for node in actions.paused}
        self._was_paused |= self._paused - paused
        self._paused = paused
        for clock in actions.clocks:
            if clock.is_wrong or clock.node in self._affected:
                self._clocks[self._process_of[clock.node]].append(clock)
                self._affected.add(clock.node)

    def returned(self, now_ns: int, process_id: str) -> wire.Batch:
        """Take a process that was started again and is ready; returns the batch that starts it."""
        self._taken_ns = max(self._taken_ns, now_ns)
        self._emulation.come_back(self._nodes[process_id], now_ns)
        self._batch_seq[process_id] = self._frames_seq[process_id] = 0
        self._cut_off.discard(process_id)
        self._lost[process_id] = []
        self._unacknowledged[process_id].clear()
        self._present.add(process_id)
        self._awaited.add(process_id)
        return self._batch(process_id, origin_ns=self._origin_ns, start_ns=now_ns)

    def give_up_starts(self, now_ns: int) -> None:
        """Take programs for dead that have not come up again in time, and have their processes ended."""
        if given_up := self._emulation.give_up_starts(now_ns, self._held_ns):
            stop = dict.fromkeys(given_up, True)
            self._actions.append(ProcessActions(now_ns, stop, [], set(self._paused), [], []))

    def _collect(self, time_ns: int) -> None:
        """Take what arrives, and the fixes that are due, by then."""
        self._collected_ns = time_ns
        node_ids = self._emulation.world.node_ids
        for delivery in self._emulation.advance(time_ns):
            process_id = self._process_of[node_ids[delivery.receiver]]
            if process_id in self._present:
                self._packets.setdefault(process_id, []).append(delivery)
        self._news.show(time_ns)
        while (due_ns := self._emulation.fix_time_ns(self._next_period)) is not None and due_ns <= time_ns:
            for number, node in enumerate(node_ids):
                fix = self._emulation.gnss.fix(self._next_period, number) if self._emulation.up[node] else None
                if fix is not None and self._process_of[node] in self._present:
                    self._fixes.setdefault(self._process_of[node], []).append(wire.WireFix.of(node, fix))
            self._next_period += 1

    def _batch(self, process_id: str, origin_ns: int | None = None, start_ns: int = 0) -> wire.Batch:
        seq = self._batch_seq[process_id]
        self._batch_seq[process_id] = seq + 1
        deliveries, fixes = self._packets.pop(process_id, []), self._fixes.pop(process_id, [])
        node_ids = self._emulation.world.node_ids
        packets = [wire.WirePacket.of(node_ids[delivery.receiver], delivery.packet) for delivery in deliveries]
        clocks, self._clocks[process_id] = self._clocks[process_id], []
        lost, self._lost[process_id] = self._lost[process_id], []
        held = process_id in self._was_paused
        self._was_paused.discard(process_id)
        busy = self._emulation.busy.of(tuple(self._nodes[process_id]), self._collected_ns, self._collected_ns + 1)
        results, messages = self._news.take(self._nodes[process_id])
        for message in messages:
            self._shown[message.node, message.number] = self._collected_ns, message
        while self._shown and (first := next(iter(self._shown.items())))[1][0] < self._collected_ns - KEPT_NS:
            del self._shown[first[0]]
        self._unacknowledged[process_id][seq] = _Sent(self._collected_ns, deliveries, [*results, *messages], lost)
        return wire.Batch(fixes, seq, packets, origin_ns, start_ns, held, clocks, busy, results, messages, lost)

    def died(self, now_ns: int, process_id: str, **details: Any) -> None:
        """A process has ended: its nodes are down from now on."""
        self._taken_ns = max(self._taken_ns, now_ns)
        for node in self._nodes[process_id]:
            self._emulation.died(now_ns, node, **details)
        self._unacknowledged[process_id].clear()
        self._present.discard(process_id)
        self._awaited.discard(process_id)

    def finish(self) -> None:
        """End of the run: what nobody acknowledged is lost in transport; say how late deliveries were."""
        if self._emulation.ended_ns is None:
            self._emulation.give_up_starts(self._emulation.duration_ns, self._held_ns)
        self._emulation.finish(self._emulation.duration_ns)
        end_ns = self._emulation.ended_ns
        assert end_ns is not None
        for ending in self._told_late:
            if ending.time_ns is not None and ending.time_ns < end_ns:
                self._emulation.take_end(end_ns, ending)
        for waiting in self._unacknowledged.values():
            for sent in waiting.values():
                self._lose(sent.deliveries)
        if self.gaps:
            self._emulation.folder.event(end_ns, EventKind.transport_gap, count=self.gaps)
        counts = [sum(column) for column in zip(*self._lateness.values(), strict=True)]
        if sum(counts):
            figures = lateness_figures(counts)
            worst = sorted(self._lateness, key=lambda process: -_late(self._lateness[process]))[:WORST_PROCESSES]
            figures["worst"] = {
                f"{process_id}.{start}": _late(self._lateness[process_id, start]) for process_id, start in worst
            }
            worst_s = self._late_in.most_common(WORST_SECONDS)
            figures["worst_s"] = {str(second): count for second, count in worst_s if count > 0}
            self._emulation.folder.event(end_ns, EventKind.late_deliveries, None, **figures)


def _late(counts: Sequence[int]) -> int:
    """Number of deliveries of a lateness histogram over the limit."""
    return sum(counts[wire.lateness_bin(wire.LATENESS_LIMIT_NS) :])


def lateness_figures(counts: Sequence[int]) -> dict[str, Any]:
    """Figures of a lateness histogram: deliveries, how many over the limit, percentiles in ms."""
    total = sum(counts)
    cumulative = list(accumulate(counts))

    def percentile_ms(share: float) -> float:
        """Interpolated within its bin."""
        index = next(i for i, c in enumerate(cumulative) if c >= share * total)
        below = cumulative[index] - counts[index]
        inside = (share * total - below) / counts[index]
        low_ms, high_ms = wire.lateness_edge_ms(index - 1), wire.lateness_edge_ms(index)
        return low_ms + inside * (high_ms - low_ms)

    return {
        "total": total,
        "count": _late(counts),
        "p50_ms": percentile_ms(0.5),
        "p99_ms": percentile_ms(0.99),
        "max_ms": percentile_ms(1.0),
    }


async def run_in_real_time(realtime: RealTime, processes: Processes) -> None:
    """Start all processes at one instant, send what is due and take what comes, until the end."""
    _send(processes, realtime.start(time.monotonic_ns() + wire.HEAD_START_NS))
    await asyncio.sleep(wire.HEAD_START_NS / NS_PER_S)
    while not realtime.is_over:
        catches_up = realtime.is_held
        now_ns = realtime.now_ns
        batches = realtime.due(now_ns)
        for actions in realtime.take_actions():
            if actions.restarts:
                realtime.hold(now_ns, actions.paused)
                catches_up = False
            await processes.act(actions)
        _send(processes, batches)
        if catches_up:  # what came during a restart goes out in the round after it
            realtime.release(realtime.now_ns)
        for process_id in processes.returned():
            processes.send(process_id, realtime.returned(realtime.now_ns, process_id))
        realtime.give_up_starts(realtime.now_ns)  # those not among them, however late they have been taken
        wait_s = LEAST_WAIT_S if realtime.is_held else max(realtime.wait_s, LEAST_WAIT_S)
        await take_what_comes(realtime, processes, wait_s)


def _send(processes: Processes, batches: Mapping[str, wire.Batch]) -> None:
    for process_id, batch in batches.items():
        processes.send(process_id, batch)


async def take_what_comes(realtime: RealTime, processes: Processes, timeout_s: float) -> None:
    """Wait for something to come, at most so long, and take all that has."""
    heard = await processes.receive(timeout_s)
    while heard is not None:
        now_ns = realtime.taken_ns(heard.arrived_ns)
        try:
            if isinstance(heard.message, SentMessage):
                realtime.take_messages(now_ns, [heard.message])
            elif isinstance(heard.message, wire.StackDump):
                realtime.take_answer(heard.process_id, heard.message)
            else:
                assert isinstance(heard.message, wire.Frames)
                realtime.receive(now_ns, heard.process_id, heard.message)
        except ProtocolError as error:
            processes.refuse(heard.process_id, error)
        heard = await processes.receive(0.0)
    for process_id, details in processes.ended().items():
        realtime.died(realtime.now_ns, process_id, **details)
