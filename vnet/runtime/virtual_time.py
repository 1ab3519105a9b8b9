"""The asyncio event loop whose clock the emulator grants.

An ordinary loop asks its selector to wait until something happens. Here, when no callback is ready, waiting
means *yielding*: the loop hands its next timer to `exchange`, which comes back with the new time in
nanoseconds once something is due, having put packets and fixes into the nodes' mailboxes. Between two
exchanges no time passes, however long the program computes.

Earlier loops of this kind, for one process and without an outside clock: async-solipsism, looptime, aiotools.
Loop time starts near 0: at epoch-sized values float timers and the clock's resolution no longer agree, and a
virtual loop spins for ever (cpython#116342).
"""

from __future__ import annotations

import asyncio
import gc
import os
import selectors
import sys
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from concurrent.futures import Future as Job
from contextvars import Context, copy_context
from functools import partial
from itertools import count
from threading import get_ident
from typing import TYPE_CHECKING, Any, NoReturn
from weakref import WeakKeyDictionary

from vnet.errors import VirtualTimeError
from vnet.runtime import asyncio_internals
from vnet.runtime.asyncio_internals import NodeHandle, NumberedTimer
from vnet.runtime.outside_loop import JOBS, collected_by_schedule, collector, is_nobodys
from vnet.runtime.own_asyncio import Future, Task, current_node, present_node
from vnet.runtime.ready_queue import CpuMeter, EventChooser, OrderedQueue, ReadyQueue
from vnet.transport.wire import ClockError, Deviation
from vnet.units import ANY_TIME, NS_PER_S, Grid

if TYPE_CHECKING:
    from vnet.node import Node

OLD_A_YOUNG = 10
"""Collections of young garbage for one of all: a full one looks at everything, and empties Python's free lists."""
MOST_GENERATORS = 10_000
"""Async generators whose nodes are remembered before those that are gone are forgotten."""
MOST_AT_ONCE = 100
"""Rounds of an instant in which a node may set timers for it, before they are a nanosecond later."""
LEAST_S = 1 / NS_PER_S
"""Shortest time in which anything waits: what is less goes lost when it is added to a time."""
LATEST_S = 1e9
"""Timers after this, more than thirty years, are for never."""

Exchange = Callable[[int | None], int]
"""Yield: takes the next timer (ns, or None), blocks for the grant, returns the granted time (ns)."""


class SpinError(VirtualTimeError):
    """A program that does not let time advance (busy loop)."""


class LoopAbandonedError(VirtualTimeError):
    """A loop that was told to end, but whose tasks still wait for something."""


def _submitting(executor: Executor | None) -> Context:
    """Return the context in which a job is submitted: the default executor's threads are nobody's."""
    context = Context() if executor is None else copy_context()
    context.run(is_nobodys.set, executor is None)
    return context


MOST_THREADS = 32
"""Threads for the jobs of a program: as many as asyncio has on a machine with many cores."""


class SkewedLoop(asyncio.SelectorEventLoop):
    """A loop that shows some tasks another time: `clock_error_of` gives the clock of the task that asks, or None.

    Timers are kept in the loop's own time.
    """

    clock_error_of: Callable[[], ClockError | None] = staticmethod(lambda: None)
    clock_errors_of: Callable[[str], Sequence[ClockError]] = staticmethod(lambda node: ())
    """Called with a node; returns all errors that its clock has had, each until the next."""
    on_failed: Callable[[asyncio.Future[Any]], None] = staticmethod(lambda future: None)
    """Called when a future, which is no task, is given an exception."""
    on_unhandled: Callable[[dict[str, Any]], bool] = staticmethod(lambda context: True)
    """Called with what asyncio's own exception handler gets; returns whether to log it."""
    owner_of: Callable[[dict[str, Any]], Node | None] = staticmethod(lambda context: present_node())
    """Called with the same; returns the node that has left the exception unhandled."""
    on_task: Callable[[Task], None] = staticmethod(lambda task: None)
    """Called with each new task."""

    def check_owner(self, node: Node | None) -> None:
        """Check whose a new task or callback is."""

    def __init__(self, selector: selectors.BaseSelector | None = None) -> None:
        self._handlers: WeakKeyDictionary[Node, Callable[[Any, dict[str, Any]], object] | None] = (
            WeakKeyDictionary()
        )
        self._factories: WeakKeyDictionary[Node, Any] = WeakKeyDictionary()
        self._executors: WeakKeyDictionary[Node, Executor] = WeakKeyDictionary()
        super().__init__(selector)
        super().set_task_factory(self._new_task)

    @property
    def now_ns(self) -> int:
        """The loop's own time in nanoseconds of the run."""
        raise NotImplementedError

    def time(self) -> float:
        """Seconds, as asyncio counts, on the clock of the task that asks."""
        clock_error = self.clock_error_of()
        if clock_error is None:
            return self.own_time()
        now_ns = self.now_ns
        return self.own_time() + (clock_error.shown_ns(now_ns) - now_ns) / NS_PER_S

    def steady_ns(self, node: str, since_ns: int) -> int:
        """Return what a clock of `node` shows that was right at `since_ns`: it drifts, and nobody sets it."""
        now_ns, errors = self.now_ns, self.clock_errors_of(node)
        shown_ns, ends_ns = now_ns, [*(error.since_ns for error in errors[1:]), now_ns]
        for error, end_ns in zip(errors, ends_ns, strict=False):
            shown_ns += round(error.rate * max(end_ns - max(error.since_ns, since_ns), 0))
        return shown_ns

    def own_time(self) -> float:
        """Seconds on the loop's own clock."""
        return super().time()

    def stop(self) -> None:
        """Stop the loop; programs may not. Raises RuntimeError for them."""
        self._check_not_a_program("stop", "return from main to end the program")
        super().stop()

    async def shutdown_default_executor(self, *timeout: Any, **options: Any) -> None:
        """Shut the threads of jobs down; programs may not. Raises RuntimeError for them."""
        self._check_not_a_program("shutdown_default_executor", "use an executor of your own to shut one down")
        await super().shutdown_default_executor(*timeout, **options)

    async def shutdown_asyncgens(self) -> None:
        """Close all async generators; programs may not. Raises RuntimeError for them."""
        self._check_not_a_program("shutdown_asyncgens", "close your own generators by aclose()")
        await super().shutdown_asyncgens()

    def _check_not_a_program(self, call: str, instead: str) -> None:
        if present_node() is not None:
            raise RuntimeError(f"loop.{call}(): the loop is not the program's own; {instead}")

    def create_future(self) -> asyncio.Future[Any]:
        """Make a future that tells the loop when it fails."""
        return Future(loop=self)

    def set_task_factory(self, factory: Any) -> None:
        """Have tasks made by `factory`: those of the program that asks, and of nobody else."""
        node = present_node()
        if node is None:
            super().set_task_factory(factory)
        else:
            self._factories[node] = factory

    def get_task_factory(self) -> Any:
        """Return what makes tasks for the program that asks, None if it has set nothing."""
        node = present_node()
        return super().get_task_factory() if node is None else self._factories.get(node)

    def _new_task(
        self,
        loop: asyncio.AbstractEventLoop,
        coroutine: Any,
        context: Context | None = None,
        **options: Any,  # from Python 3.13.3 on: the name, and whatever else a task takes
    ) -> asyncio.Task[Any]:
        factory = self._factories.get(node) if self._factories and (node := present_node()) is not None else None
        if factory is None:
            return Task(coroutine, loop=loop, context=context, **options)
        if factory is getattr(asyncio, "eager_task_factory", None):
            return Task(coroutine, loop=loop, context=context, eager_start=True, **options)
        if context is not None:
            options["context"] = context
        return factory(loop, coroutine, **options)  # type: ignore[no-any-return]

    def set_default_executor(self, executor: Any) -> None:
        """Have jobs that name no executor done by this one: those of the program that asks, and of nobody else."""
        node = present_node()
        if node is None:
            super().set_default_executor(executor)
        elif not isinstance(executor, ThreadPoolExecutor):
            raise TypeError("executor must be ThreadPoolExecutor instance")
        else:
            self._executors[node] = executor

    def _executor_of(self, executor: Executor | None) -> Executor | None:
        """Return the executor of a job; None for that of the loop."""
        node = present_node() if executor is None and self._executors else None
        return executor if node is None else self._executors.get(node)

    def set_exception_handler(self, handler: Callable[[Any, dict[str, Any]], object] | None) -> None:
        """Set the handler of what the node leaves unhandled on whose behalf this is called; others keep theirs."""
        if (node := present_node()) is None:
            super().set_exception_handler(handler)
        elif handler is not None and not callable(handler):
            raise TypeError(f"A callable object or None is expected, got {handler!r}")
        else:
            self._handlers[node] = handler

    def get_exception_handler(self) -> Callable[[Any, dict[str, Any]], object] | None:
        """Return the handler of the node on whose behalf this is called."""
        node = present_node()
        return super().get_exception_handler() if node is None else self._handlers.get(node)

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        """Call the handler of the node that has left an exception unhandled, in a context of its own."""
        node = self.owner_of(context) if self._handlers else None
        handler = None if node is None else self._handlers.get(node)
        if handler is None:
            super().call_exception_handler(context)
            return
        own = Context()
        own.run(current_node.set, node)
        before = super().get_exception_handler()
        super().set_exception_handler(handler)
        try:
            own.run(super().call_exception_handler, context)
        finally:
            super().set_exception_handler(before)

    def default_exception_handler(self, context: dict[str, Any]) -> None:
        """Log what nobody has handled, as asyncio does, and tell of it."""
        if self.on_unhandled(context):
            super().default_exception_handler(context)

    def run_in_executor(  # type: ignore[override]
        self, executor: Executor | None, func: Callable[..., Any], *args: Any
    ) -> asyncio.Future[Any]:
        """Run a job as asyncio does; the future knows on whose behalf."""
        executor = self._executor_of(executor)
        outer = _submitting(executor).run(super().run_in_executor, executor, func, *args)
        if isinstance(outer, Future):
            outer.job_context = copy_context()
        return outer

    def call_at(  # type: ignore[override]
        self, when: float, callback: Callable[..., object], *args: Any, context: Context | None = None
    ) -> asyncio.TimerHandle:
        """Call at `when` on the clock of the task that asks."""
        return super().call_at(self._own_when(when), callback, *args, context=context)

    def _own_when(self, when: float) -> float:
        """Time on the loop's own clock at which the clock of the task that asks shows `when`."""
        clock_error = self.clock_error_of()
        return when if clock_error is None else self.own_time() + (when - self.time()) / (1 + clock_error.rate)


class VirtualTimeLoop(SkewedLoop):
    """An event loop in virtual time; see the module's text.

    `spin_limit` is how many rounds of callbacks one instant, or instants 1 ns apart, may take before the loop
    raises `SpinError`. `before_job` is called before a job is given to an executor: threads may look for packets.
    """

    def __init__(self, exchange: Exchange, spin_limit: int = 100_000) -> None:
        self._process = os.getpid()
        self._exchange = exchange
        self._spin_limit = spin_limit
        # Of each node the last instant at which it has set a timer for it, the last round of that, and how many.
        self._asked_at_once: WeakKeyDictionary[Node, tuple[int, int, int]] = WeakKeyDictionary()
        self._rounds = 0
        self._now_ns = 0
        self.is_ending = False
        """True once the run is over, and programs only end."""
        self._jobs: list[tuple[Job[Any], Future]] = []
        self._pools: dict[Node | None, ThreadPoolExecutor] = {}
        """The default executor of each node: a job may wait for one of its own program, and for no other's."""
        self._timers = count()
        self._meter: CpuMeter | None = None
        self._ordered: OrderedQueue | None = None
        self._timer_grid = ANY_TIME
        self._thread: int | None = None
        self.has_refused = False
        """True once another thread has been refused, which may have told nobody."""
        self._collect_every_ns: int | None = None
        self._collections_ns: dict[int, int] = {}
        """The next collection of each generation; one that is not in it is not due."""
        self._generators: dict[int, Node] = {}
        self.before_job: Callable[[], None] = lambda: None
        super().__init__(_YieldingSelector(self._wait))
        self._queue = ReadyQueue(())
        asyncio_internals.replace_ready_queue(self, self._queue)
        asyncio_internals.set_clock_resolution(self, 0.5 / NS_PER_S)  # no timer fires before its nanosecond

    @property
    def now_ns(self) -> int:
        """The granted time in nanoseconds."""
        return self._now_ns

    def close(self) -> None:
        """Close the loop, and its threads as they become idle."""
        super().close()
        for pool in self._pools.values():
            pool.shutdown(wait=False)

    def start_at(self, time_ns: int) -> None:
        """Set the clock before anything runs: a process that is started again joins late."""
        self._now_ns = time_ns

    def measure(self, meter: CpuMeter) -> None:
        """Let `meter` measure what the callbacks cost, from the next round on."""
        self._queue.on_taken = meter.begin
        self._meter = meter

    def order(
        self,
        chooser_of: Callable[[Node], EventChooser],
        on_deviation: Callable[[Node, Deviation], None],
        timer_grid: Grid = ANY_TIME,
    ) -> OrderedQueue:
        """Have `chooser_of` a node decide in which order it is shown what happens at one instant.

        Returns the queue in which events of this instant are put. `on_deviation` is told of choices that are not
        FIFO's. Timers are due at the instants of `timer_grid`; in FIFO order those of one instant fire in the order
        of their times. To be called before anything runs.
        """
        self._timer_grid = timer_grid
        ready = self._queue
        self._queue = self._ordered = OrderedQueue(ready, chooser_of, lambda: self._now_ns, on_deviation)
        self._ordered.on_taken = ready.on_taken
        asyncio_internals.replace_ready_queue(self, self._ordered)
        return self._ordered

    def hold(self, held: Callable[[asyncio.Handle], bool]) -> None:
        """Put aside, from now on, the callbacks that `held` says; the others go on. Called again, ends that.

        Timers that became due meanwhile are due when they are released: after what has come in by then, in order.
        """
        for timer in self._queue.release(held):
            asyncio_internals.push_timer(self, timer)

    def pending(self) -> list[asyncio.Handle]:
        """Return all callbacks and timers that will run sooner or later."""
        handles = [*self._queue.all, *asyncio_internals.timers(self)]
        return [handle for handle in handles if not handle.cancelled()]

    def own_time(self) -> float:
        """The granted time in seconds, as asyncio counts."""
        return self._now_ns / NS_PER_S

    def call_at(  # type: ignore[override]
        self, when: float, callback: Callable[..., object], *args: Any, context: Context | None = None
    ) -> asyncio.TimerHandle:
        """Call at `when` on the clock of the task that asks, at the nearest nanosecond.

        What is later than that clock shows is a nanosecond later at least, and so is what is asked for at one
        instant again and again: who waits for the rest of a time that rounding has cut would wait for ever.
        """
        asyncio_internals.check_not_closed(self)
        self._check_thread()
        asked, when = when, self._own_when(when)
        number = next(self._timers)
        place: int | tuple[int, int] = number
        if when < LATEST_S:
            when_ns = round(when * NS_PER_S)
            if when_ns <= self._now_ns and (asked > self.time() or self._asks_on()):
                when_ns = self._now_ns + 1
            if self._timer_grid.step_ns:
                place = when_ns, number
                when_ns = self._timer_grid.at_or_after(when_ns)
            when = when_ns / NS_PER_S
        timer = NumberedTimer(place, when, callback, args, self, context)
        timer.node = self._node_of(timer, callback)
        self.check_owner(timer.node)
        if self._ordered is not None:
            timer.setter = self._ordered.setter(present_node(), asyncio.current_task(self))
        asyncio_internals.push_timer(self, timer)
        return timer

    def _asks_on(self) -> bool:
        """Return true if a node has set timers for the present instant in many rounds of it."""
        if (node := present_node()) is None:
            return False
        asked_ns, last, rounds = self._asked_at_once.get(node, (-1, 0, 0))
        if asked_ns != self._now_ns:
            last, rounds = -1, 0
        rounds += last != self._rounds
        self._asked_at_once[node] = self._now_ns, self._rounds, rounds
        return rounds > MOST_AT_ONCE

    def call_later(  # type: ignore[override]
        self, delay: float, callback: Callable[..., object], *args: Any, context: Context | None = None
    ) -> asyncio.TimerHandle:
        """Call after `delay` seconds: a nanosecond at least, if it is any time."""
        if 0 < delay < LEAST_S:
            delay = LEAST_S
        return super().call_later(delay, callback, *args, context=context)

    # Whose a callback is: its context says so, unless it is one of the program's own making.

    @property
    def running_node(self) -> Node | None:
        """Node of the callback that runs."""
        return getattr(self._queue.running, "node", None)

    def _call_soon(self, callback: Callable[..., object], args: Any, context: Context | None) -> asyncio.Handle:
        # Each callback passes here, so what seldom matters is asked for in one comparison.
        if self._thread != get_ident():
            self._check_thread()
        handle = NodeHandle(callback, args, self, context)
        node = self if context is None else context.get(current_node, self)
        handle.node = self._node_of(handle, callback) if node is self else node
        if handle.node is None:
            self.check_owner(None)
        asyncio_internals.push_ready(self, handle)
        return handle

    def _node_of(self, handle: asyncio.Handle, callback: Callable[..., object]) -> Node | None:
        node = asyncio_internals.context_of(handle).get(current_node, self)
        if node is not self:
            return node  # type: ignore[return-value]
        task = getattr(callback, "__self__", None)
        return task.node if isinstance(task, Task) else self.running_node

    def check_owner(self, node: Node | None) -> None:
        """Check whose a new task or callback is. Raises RuntimeError for a finalizer's, which is nobody's."""
        if node is None and collector.runs:
            raise RuntimeError(
                "a finalizer (__del__) that the garbage collector calls starts a task, a callback or a timer: "
                "nothing says which vehicle's it is; close what must end by `async with` or `try … finally`"
            )

    def _check_thread(self) -> None:
        if self._thread is not None and self._thread != get_ident():
            self.has_refused = True
            raise RuntimeError(
                "a thread calls into the event loop (loop.call_soon_threadsafe(), a future's set_result(), "
                "asyncio.run_coroutine_threadsafe()): in lockstep nothing says at which emulated time it acts; "
                "return a value from asyncio.to_thread() or loop.run_in_executor(), and act on it in the task; or "
                'run.pacing = "realtime"'
            )

    def _asyncgen_firstiter_hook(self, generator: Any) -> None:
        super()._asyncgen_firstiter_hook(generator)  # type: ignore[misc]
        node = present_node()
        if node is not None:
            self._generators[id(generator)] = node
        if len(self._generators) > MOST_GENERATORS:
            living = {id(each) for each in asyncio_internals.generators(self)}
            self._generators = {key: node for key, node in self._generators.items() if key in living}

    def _asyncgen_finalizer_hook(self, generator: Any) -> None:
        context = Context()
        context.run(current_node.set, self._generators.pop(id(generator), None))
        context.run(super()._asyncgen_finalizer_hook, generator)  # type: ignore[misc]

    # The garbage collector: what it discards may act, so it runs at instants that depend on emulated time alone.

    def collect_every(self, time_ns: int) -> None:
        """Have young garbage collected at multiples of `time_ns`, and all of it at multiples of ten times that.

        It is collected before anything else of the instant, and only if anything has run since the last time.
        """
        self._collect_every_ns = time_ns

    def run_forever(self) -> None:
        """Run until the loop is stopped."""
        self._thread = get_ident()
        try:
            with collected_by_schedule():
                super().run_forever()
        finally:
            self._thread = None

    def _pass_on(self, next_timer_ns: int | None) -> None:
        """Yield until the next timer, or the next collection."""
        if self._queue.has_run and self._collect_every_ns is not None:
            self._plan_collections(self._collect_every_ns)
        self._queue.has_run = False
        wakes_ns = [*self._collections_ns.values()] + ([] if next_timer_ns is None else [next_timer_ns])
        self._now_ns = self._exchange(min(wakes_ns, default=None))
        for generation, time_ns in list(self._collections_ns.items()):
            if self._now_ns >= time_ns:
                del self._collections_ns[generation]
                if gc.collect(generation) and self._collect_every_ns is not None:
                    self._plan_collections(self._collect_every_ns)  # what was discarded may have left more

    def _plan_collections(self, every_ns: int) -> None:
        for generation, period_ns in ((1, every_ns), (2, OLD_A_YOUNG * every_ns)):
            if generation not in self._collections_ns:
                self._collections_ns[generation] = (self._now_ns // period_ns + 1) * period_ns

    def end_at(self, time_ns: int) -> None:
        """Let it be this time, before which all has happened; timers that are due at it or later never are."""
        for timer in asyncio_internals.timers(self):
            timer.cancel()
        self._now_ns = max(self._now_ns, time_ns)

    def finish(self, main: Coroutine[Any, Any, None]) -> None:
        """Run until `main` is done without ever yielding again. Raises LoopAbandonedError if it waits."""
        self.is_ending = True
        if self._ordered is not None:
            self._ordered.decides = False
        self._rounds = 0
        self.run_until_complete(main)

    def _wait(self, timeout: float | None, poll: Callable[[float | None], list[Any]]) -> list[Any]:
        """Yield, in place of the selector's sleep."""
        if os.getpid() != self._process:
            end_fork()
        self._queue.running = None
        if self._meter is not None:
            self._meter.end()
        if self._ordered is not None:
            if self._ordered.compose():
                timeout = 0
            elif self._ordered.has_jobs:
                return poll(None)
        if timeout is not None and timeout <= 0:
            self._count_round()
            return poll(0)
        if self._jobs:
            return self._wait_for_jobs(poll)
        if self.is_ending:
            raise LoopAbandonedError("a task still waits after the run has ended")
        next_timer_ns = self._next_timer_ns()
        if next_timer_ns == self._now_ns:  # a timer closer than the clock's resolution: due already
            self._count_round()
            return []
        if next_timer_ns is not None and next_timer_ns - self._now_ns <= 1:
            self._count_round()  # the least time that anything waits is no time
        else:
            self._rounds = 0
        if self._meter is not None:
            self._meter.end_instant()
        self._pass_on(next_timer_ns)
        return []

    def _count_round(self) -> None:
        self._rounds += 1
        if self._rounds > self._spin_limit:
            self._rounds = 0
            if self._ordered is not None:
                self._ordered.flatten()
            raise SpinError(f"more than {self._spin_limit} rounds of callbacks at {self._now_ns} ns")

    def _next_timer_ns(self) -> int | None:
        timer = asyncio_internals.next_timer(self)
        if timer is None or timer.when() > LATEST_S:
            return None
        return max(round(timer.when() * NS_PER_S), self._now_ns)

    # Executors: while a job is pending the loop does not yield (computing costs no virtual time), and results
    # appear in the order in which the jobs were submitted, when all are there: no race decides anything.

    def run_in_executor(  # type: ignore[override]
        self, executor: Executor | None, func: Callable[..., Any], *args: Any
    ) -> asyncio.Future[Any]:
        """As asyncio's, but deterministic; jobs that never end keep the whole emulation waiting."""
        self.before_job()
        executor = self._executor_of(executor)
        context = _submitting(executor)
        node = present_node()
        if executor is None:
            if node not in self._pools:
                self._pools[node] = ThreadPoolExecutor(MOST_THREADS, thread_name_prefix=JOBS)
            executor = self._pools[node]
        job = context.run(executor.submit, func, *args)
        outer = Future(loop=self)
        outer.job_context = copy_context()
        if self._ordered is None or node is None:
            self._jobs.append((job, outer))
        else:
            name = getattr(func, "__qualname__", "a job")
            self._ordered.add_job(node, name, job, partial(_copy_result, job, outer))
        job.add_done_callback(lambda _: asyncio_internals.wake(self))
        return outer

    def _wait_for_jobs(self, poll: Callable[[float | None], list[Any]]) -> list[Any]:
        pending = next((outer for job, outer in self._jobs if not job.done()), None)
        if pending is not None:
            if self._meter is not None and pending.job_context is not None:
                self._meter.wait_for(pending.job_context.get(current_node))
            return poll(None)  # a finished job, or a call from a job's thread, wakes the self-pipe
        jobs, self._jobs = self._jobs, []
        for job, outer in jobs:
            _copy_result(job, outer)
        return []

    # Sockets and subprocesses would wait on the real world, whose time has no place here.

    def _refuse(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise VirtualTimeError(
            "sockets, pipes and subprocesses of a loop are not available to programs in lockstep: vehicles talk by "
            "radio, or the scenario runs with run.pacing = realtime"
        )

    def add_signal_handler(self, sig: int, callback: Callable[..., object], *args: Any) -> None:  # type: ignore[override]
        """Do nothing: no signal comes to a program on virtual time, and those of the process are not its own."""

    def remove_signal_handler(self, sig: int) -> bool:
        """Return False: there is none."""
        return False

    create_connection = create_server = create_datagram_endpoint = _refuse
    create_unix_connection = create_unix_server = _refuse
    subprocess_exec = subprocess_shell = _refuse
    connect_read_pipe = connect_write_pipe = _refuse
    connect_accepted_socket = start_tls = sendfile = _refuse
    add_reader = add_writer = _refuse  # type: ignore[assignment]
    getaddrinfo = getnameinfo = _refuse
    sock_recv = sock_recv_into = sock_recvfrom = sock_recvfrom_into = _refuse
    sock_sendall = sock_sendto = sock_connect = sock_accept = sock_sendfile = _refuse


class _YieldingSelector(selectors.DefaultSelector):
    """The real selector for the loop's own self-pipe, with the waiting handed to `wait`."""

    def __init__(self, wait: Callable[[float | None, Callable[[float | None], list[Any]]], list[Any]]) -> None:
        super().__init__()
        self._wait = wait

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        try:
            task = asyncio.current_task()
        except RuntimeError:  # no loop runs in a fork
            task = None
        if task is not None:
            raise RuntimeError(f"the event loop runs already, and {task.get_name()} runs it again: await instead")
        return self._wait(timeout, super().select)


def _copy_result(job: Job[Any], outer: asyncio.Future[Any]) -> None:
    if outer.done():
        return
    if job.cancelled():
        outer.cancel()
    elif (error := job.exception()) is not None:
        if isinstance(error, StopIteration):  # no future takes it: as asyncio does from Python 3.12 on
            stopped, error = error, RuntimeError("a job raised StopIteration, which no future can hold")
            error.__cause__ = stopped
        outer.set_exception(error)
    else:
        outer.set_result(job.result())


def end_fork() -> NoReturn:
    """End a process that a program has forked and that comes back: there is one run, and it is the parent's."""
    sys.stderr.write("vnet: a process that a program forked came back to the event loop; it ends here\n")
    sys.stderr.flush()
    os._exit(70)  # nothing of the parent's is to be flushed or closed twice
