"""The queues of callbacks that are ready to run, which take the place of the event loop's own.

`ReadyQueue` puts aside what belongs to programs that are paused. `OrderedQueue` also puts the rounds of callbacks
together: what happens at one instant comes in the order that a chooser decides (see below).

How an event loop of asyncio works, as far as it matters here: a round begins with what callbacks of the last round
have registered, in that order; behind it come the events that the selector has found and the timers that are due;
then all of these run. So an event that is shown a round later than it might have been is one that came a little
later, and an order of events is one that a machine can show. What one callback registers keeps its order.
"""

from __future__ import annotations

import asyncio
import random
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol
from weakref import WeakKeyDictionary

from vnet.errors import printable
from vnet.runtime.asyncio_internals import NumberedTimer
from vnet.runtime.running_node import RunningNode
from vnet.transport.wire import Deviation, Order

if TYPE_CHECKING:
    from vnet.node import Node


def node_of(handle: asyncio.Handle) -> Node | None:
    """Return the node whose callback this is."""
    return getattr(handle, "node", None)


LONGEST_NAME = 100
"""Characters of a task's or a job's name."""
STARTED = "start"
"""The source of what no callback has registered."""
NOBODY = None, STARTED, object()
"""Node, source and callback of what is registered while nobody runs."""


class ReadyQueue(deque[asyncio.Handle]):
    """The loop's queue of callbacks that are ready, but for those of programs that are paused.

    `on_taken` is called with each callback that is about to run.
    """

    on_taken: Callable[[asyncio.Handle], None] | None = None

    def __init__(self, ready: Iterable[asyncio.Handle]) -> None:
        super().__init__(ready)
        self._holds: Callable[[asyncio.Handle], bool] = lambda handle: False
        self._held: list[asyncio.Handle] = []
        self.running: asyncio.Handle | None = None
        """The callback that runs; None while the loop waits."""
        self.has_run = False
        """True if a callback has run since this was set to False."""

    def append(self, handle: asyncio.Handle) -> None:
        """Add a callback behind the others, unless it is held."""
        if self._holds(handle):
            self._held.append(handle)
        else:
            super().append(handle)

    def popleft(self) -> asyncio.Handle:
        """Remove and return the next callback, which is about to run."""
        self.running = handle = super().popleft()
        self.has_run = True
        if self.on_taken is not None:
            self.on_taken(handle)
        return handle

    @property
    def all(self) -> list[asyncio.Handle]:
        """The callbacks that wait, with those that are held."""
        return [*self, *self._held]

    def release(self, holds: Callable[[asyncio.Handle], bool]) -> list[NumberedTimer]:
        """Hold what `holds` says, and release the rest in the order in which it came; returns its timers."""
        waiting, held = list(self), self._held
        self.clear()
        self._holds, self._held = holds, []
        for handle in waiting:
            self.append(handle)
        timers = []
        for handle in held:
            if isinstance(handle, NumberedTimer) and not holds(handle):
                timers.append(handle)
            else:
                self.append(handle)
        return timers


@dataclass(slots=True, eq=False)
class _Event:
    """Something that is due: `show` makes it happen. Of one `group` only the oldest is an option.

    `job` is that of the result that it is, which must be there first. An arrival that is not `awaited` wakes
    nobody. A timer that is `cancelled` when it is due is no event any more.
    """

    label: str
    source: str
    group: object
    show: Callable[[], None]
    job: Future[Any] | None = None
    awaited: Callable[[], bool] = lambda: True
    cancelled: Callable[[], bool] = lambda: False


@dataclass(slots=True, eq=False)
class _NodeRounds:
    """The events and callbacks of one node that are due or ready, and who decides what is next."""

    chooser: EventChooser
    events: list[_Event] = field(default_factory=list)
    jobs: list[_Event] = field(default_factory=list)
    ready: deque[tuple[asyncio.Handle, str]] = field(default_factory=deque)
    time_ns: int = -1
    decisions: int = 0
    awaited: _Event | None = None
    """The result that comes next and is not there yet."""
    takes_results: bool = False
    """FIFO: nothing else was left, so all results come before anything runs."""
    names: WeakKeyDictionary[asyncio.Task[Any], str] = field(default_factory=WeakKeyDictionary)
    """The names of tasks that have set timers: their coroutines', with a number if others had the same."""
    named: Counter[str] = field(default_factory=Counter)

    @property
    def sleeps(self) -> bool:
        """True if nothing of the node runs at this instant: it finds what has arrived when it wakes."""
        return not self.ready and not any(event.awaited() for event in [*self.events, *self.jobs])

    def options(self) -> list[_Event | None]:
        """Return what may be next, FIFO's choice first; None is to go on."""
        events = _oldest_of_groups(self.events)
        go_on: list[_Event | None] = [None] if self.ready else []
        if events or (self.ready and not self.takes_results):
            return [*events, *go_on, *self.jobs]
        return [*self.jobs, *go_on]

    def described(self, event: _Event | None) -> Option:
        """Return an event, or going on, as the chooser sees it."""
        return Option(GO_ON, self.ready[0][1]) if event is None else Option(event.label, event.source)


class OrderedQueue(ReadyQueue):
    """See the module's text. `chooser_of` gives the chooser of a node; `now_ns` the time of the loop.

    `on_deviation` is told of each choice that is not FIFO's.
    """

    def __init__(
        self,
        ready: Iterable[asyncio.Handle],
        chooser_of: Callable[[Node], EventChooser],
        now_ns: Callable[[], int],
        on_deviation: Callable[[Node, Deviation], None],
    ) -> None:
        super().__init__(())
        self._chooser_of = chooser_of
        self._now_ns = now_ns
        self._on_deviation = on_deviation
        self._nodes: dict[Node, _NodeRounds] = {}
        self._running: tuple[Node | None, str, object] = NOBODY
        self._sources: dict[int, str] = {}
        self.steps: Counter[str] = Counter()
        """Decisions of each node so far."""
        self.decides = True
        """False: as FIFO from now on, because the programs are ended."""
        for handle in ready:
            self.append(handle)

    # What the loop, and nodes through it, put in.

    def append(self, handle: asyncio.Handle) -> None:
        """Take a callback that is ready, or a timer that is due."""
        node = node_of(handle)
        if node is None or self._holds(handle):
            super().append(handle)
        elif isinstance(handle, NumberedTimer):
            # Whether a cancelled timer ever comes here depends on the other timers of the loop.
            if not handle.cancelled():
                source, group = handle.setter
                show = partial(self._ready, node, handle, source)
                event = _Event(f"timer of {source}", source, group, show, cancelled=handle.cancelled)
                self._rounds(node).events.append(event)
        else:
            running, source, _ = self._running
            self._ready(node, handle, source if running is node else STARTED)

    def _ready(self, node: Node, handle: asyncio.Handle, source: str) -> None:
        self._rounds(node).ready.append((handle, source))

    def add_event(
        self, node: Node, label: str, source: str, show: Callable[[], None], awaited: Callable[[], bool]
    ) -> None:
        """Something arrives at `node` at this instant: events of one label come in this order."""
        self._rounds(node).events.append(_Event(label, source, label, show, awaited=awaited))

    def add_job(self, node: Node, name: str, job: Future[Any], show: Callable[[], None]) -> None:
        """`node` has submitted a job to an executor, whose result `show` sets."""
        label = f"result of {printable(name, LONGEST_NAME)}"
        self._rounds(node).jobs.append(_Event(label, label, job, show, job))

    @property
    def all(self) -> list[asyncio.Handle]:
        """See `ReadyQueue`; those that a node has yet to run are among them."""
        return [*super().all, *(handle for rounds in self._nodes.values() for handle, _ in rounds.ready)]

    def setter(self, node: Node | None, task: asyncio.Task[Any] | None) -> tuple[str, object]:
        """Return the name of what sets a timer, and the task or the callback that does.

        The timers of either keep their order: what it sets later is due later on a machine, if only by nanoseconds.
        """
        running, source, callback = self._running
        if node is None or running is not node:
            return STARTED, callback
        if task is None:
            return source, callback
        rounds = self._rounds(node)
        if task not in rounds.names:
            name = getattr(task.get_coro(), "__qualname__", "a task").rsplit("<locals>.", 1)[-1]
            name = "main" if name == "Host._main" else name
            name = printable(name, LONGEST_NAME)
            rounds.named[name] += 1
            rounds.names[task] = name if rounds.named[name] == 1 else f"{name}#{rounds.named[name]}"
        return rounds.names[task], rounds.names[task]

    def _rounds(self, node: Node) -> _NodeRounds:
        if node not in self._nodes:
            self._nodes[node] = _NodeRounds(self._chooser_of(node))
        return self._nodes[node]

    # What the loop takes out.

    def popleft(self) -> asyncio.Handle:
        """Remove and return the next callback, which is about to run."""
        handle = super().popleft()
        self._running = node_of(handle), self._sources.pop(id(handle), STARTED), object()
        return handle

    def compose(self) -> bool:
        """Put the next round together; returns whether there is anything in it. Nobody runs then."""
        for node, rounds in list(self._nodes.items()):
            self._compose(node, rounds)
        self._running = NOBODY
        return len(self) > 0

    @property
    def has_jobs(self) -> bool:
        """True if there are jobs whose results have not come."""
        return any(rounds.jobs for rounds in self._nodes.values())

    def flatten(self) -> None:
        """Put all that is ready into the queue itself, in order, where others look for it."""
        for rounds in self._nodes.values():
            self._run(rounds)

    def _compose(self, node: Node, rounds: _NodeRounds) -> None:
        if rounds.time_ns != (time_ns := self._now_ns()):
            rounds.time_ns, rounds.decisions = time_ns, 0
        rounds.events = [event for event in rounds.events if not event.cancelled()]
        if rounds.sleeps:
            for arrival in rounds.events:
                arrival.show()
            rounds.events.clear()
            return
        while (event := rounds.awaited or self._next(node, rounds)) is not None:
            if event.job is not None and not event.job.done():
                rounds.awaited = event
                return
            rounds.awaited = None
            (rounds.events if event.job is None else rounds.jobs).remove(event)
            self._running = node, event.source, event
            event.show()
        self._run(rounds)

    def _run(self, rounds: _NodeRounds) -> None:
        while rounds.ready:
            handle, source = rounds.ready.popleft()
            self._sources[id(handle)] = source
            super().append(handle)

    def _next(self, node: Node, rounds: _NodeRounds) -> _Event | None:
        """Return the event that comes next, or None if the node goes on, or has nothing to do."""
        if not (options := rounds.options()):
            return None
        number = 0
        if len(options) > 1 and self.decides:
            number = self._decide(node, rounds, options)
        event = options[number]
        rounds.takes_results = number == 0 and event is not None and event.job is not None
        return event

    def _decide(self, node: Node, rounds: _NodeRounds, options: list[_Event | None]) -> int:
        described = _distinct([rounds.described(event) for event in options])
        decision = rounds.decisions
        rounds.decisions += 1
        self.steps[node.id] += 1
        number = rounds.chooser.choose(rounds.time_ns, decision, described)
        if number != 0:
            chosen, first = described[number].label, described[0].label
            self._on_deviation(node, Deviation(node.id, node.incarnation, rounds.time_ns, decision, chosen, first))
        return number


def _oldest_of_groups(events: list[_Event]) -> list[_Event | None]:
    """Return the events that no other of their group comes before, in order."""
    oldest: dict[object, _Event | None] = {}
    for event in events:
        oldest.setdefault(event.group, event)
    return list(oldest.values())


def _distinct(options: list[Option]) -> list[Option]:
    """Number the options that have the label of another."""
    seen: dict[str, int] = {}
    distinct = []
    for option in options:
        seen[option.label] = number = seen.get(option.label, 0) + 1
        distinct.append(option if number == 1 else Option(f"{option.label} ({number})", option.source))
    return distinct


# In which order a node is shown what happens to it at one instant: FIFO, or another that a machine can show.
#
# Packets, a fix, timers and results of executor jobs that come at the same instant come in a fixed order in virtual
# time (FIFO). On a machine each may be a little earlier or later, and the event loop may have run callbacks in
# between. At each *decision* one of these is next: one of the events that are due, or the round itself ("go on"). A
# `Chooser` makes a node's decisions; it knows nothing of other nodes, so the division of nodes into processes does
# not matter. What differs from FIFO is a *deviation*, and the deviations of a run are its *tape*.
#
# PCT: Burckhardt, Kothari, Musuvathi and Nagarakatte, "A randomized scheduler with probabilistic guarantees of
# finding bugs", ASPLOS 2010.

GO_ON = "go on"
"""The choice to run what is ready before anything else happens."""


@dataclass(frozen=True, slots=True)
class Option:
    """An option of a decision: `label` names it among the others, `source` is what it belongs to."""

    label: str
    source: str


class EventChooser(Protocol):
    """Interface of what makes the decisions of one node."""

    def choose(self, time_ns: int, decision: int, options: Sequence[Option]) -> int:
        """Return the number of the option that comes next; 0 is FIFO's. `decision` counts from 0 each instant."""
        ...


class Shuffle:
    """Any option, each as likely as the others."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)

    def choose(self, time_ns: int, decision: int, options: Sequence[Option]) -> int:
        """Draw an option."""
        return int(self._random.random() * len(options))


class Pct:
    """The option whose source has the highest priority, where `depth` - 1 times the highest becomes the lowest.

    A source is a task, the radio, the receiver or a job. Priorities are drawn when a source is first seen, and the
    decisions at which one falls among the first `steps`. A bug that `depth` events in the right order show is found
    with a probability of at least 1 / (sources · steps^(depth - 1)).
    """

    def __init__(self, seed: int, depth: int, steps: int) -> None:
        self._random = random.Random(seed)
        self._priority: dict[str, float] = {}
        self._falls = {self._random.randrange(max(steps, 1)): number for number in range(1, depth)}
        self._step = 0

    def choose(self, time_ns: int, decision: int, options: Sequence[Option]) -> int:
        """Take the highest priority, after it has fallen if this is the decision for it."""
        for option in options:
            if option.source not in self._priority:
                self._priority[option.source] = self._random.random()
        fall = self._falls.get(self._step)
        self._step += 1
        if fall is not None:
            self._priority[options[self._highest(options)].source] = -float(fall)
        return self._highest(options)

    def _highest(self, options: Sequence[Option]) -> int:
        return max(range(len(options)), key=lambda number: (self._priority[options[number].source], -number))


class Taped:
    """FIFO but for the deviations of a tape, as far as they fit: an option of that label at that decision."""

    def __init__(self, tape: Sequence[Deviation]) -> None:
        self._labels = {(each.time_ns, each.decision): each.label for each in tape}

    def choose(self, time_ns: int, decision: int, options: Sequence[Option]) -> int:
        """Return what the tape says for this decision, else FIFO's choice."""
        label = self._labels.get((time_ns, decision))
        return next((number for number, option in enumerate(options) if option.label == label), 0)


def chooser_of(order: Order) -> EventChooser:
    """Return what makes the decisions of a node whose welcome has this order."""
    if order.kind == "shuffle":
        return Shuffle(order.seed)
    if order.kind == "pct":
        return Pct(order.seed, order.depth, order.steps)
    return Taped(order.tape)


class CpuMeter:
    """CPU time that the callbacks of each node take, and the instants at which each is woken.

    `clock` gives the CPU time of the loop's thread in ns; what programs compute on other threads, as in executors,
    is not in it. A callback belongs to the node in whose context it runs; one of nobody's is not counted. The
    node whose callback runs is written down in `shown`.
    """

    def __init__(self, clock: Callable[[], int] = time.thread_time_ns, shown: RunningNode | None = None) -> None:
        self._clock = clock
        self._running: str | None = None
        self._since_ns = 0
        self._awake: set[str] = set()
        self._shown = shown or RunningNode()
        self.cpu_ns: Counter[str] = Counter()
        self.wake_ups: Counter[str] = Counter()

    def begin(self, handle: asyncio.Handle) -> None:
        """A callback begins, and the one before it is over."""
        now_ns = self._clock()
        self._charge(now_ns)
        node = node_of(handle)
        if node is not None:
            self._running, self._since_ns = node.id, now_ns
            self._awake.add(node.id)
            self._shown.show(node.id)

    def end(self) -> None:
        """The loop looks for callbacks: none is running."""
        if self._running is not None:
            self._charge(self._clock())
        self._shown.show("")

    def wait_for(self, node: Node | None) -> None:
        """The loop waits for a job of this node, on another thread."""
        self._shown.show("" if node is None else node.id)

    def end_instant(self) -> None:
        """Nothing is left to do at this instant: count a wake-up of each node that has run."""
        self.wake_ups.update(self._awake)
        self._awake.clear()

    def _charge(self, now_ns: int) -> None:
        if self._running is not None:
            self.cpu_ns[self._running] += now_ns - self._since_ns
            self._running = None
