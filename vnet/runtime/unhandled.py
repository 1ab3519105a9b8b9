"""Exceptions of programs that nobody handles: in tasks nobody awaits, callbacks, dropped executor jobs, threads.

An exception that somebody retrieves, however late, is none. asyncio tells of the others when it discards the task
or future; so the instant is remembered when it fails. What reference counting discards is told at once, which is
the same in every process and every run. What the garbage collector finds, and what is still held, is told when the
program ends: nothing here depends on when the collector runs.
"""

from __future__ import annotations

import asyncio
import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from vnet.errors import sendable
from vnet.node import Node
from vnet.runtime import asyncio_internals, outside_loop
from vnet.runtime.error_text import error_line, line_of, own_line, traceback_text
from vnet.runtime.outside_loop import ExecutorJob, ProcessEndedError, collector
from vnet.runtime.own_asyncio import NOBODY, current_node, present_node
from vnet.runtime.ready_queue import node_of
from vnet.runtime.virtual_time import SkewedLoop
from vnet.transport.wire import Unhandled

MOST_HELD = 1000
"""Exceptions that a process keeps until its end; of a flood, the first ones."""
FIRST_CLEANING = 1000
"""Failures that are remembered before those that have been retrieved are forgotten."""
_NOT_ITS_OWN = (KeyboardInterrupt, ProcessEndedError)
"""Exceptions that vnet has raised: the death of their vehicle has been told."""
_SHIELDED = "exception in shielded future"
"""End of asyncio's message, from Python 3.14 on, about a future whose caller was cancelled: that is legal."""


@dataclass(frozen=True)
class _Failure:
    """A task or future that failed: when, and whose it is."""

    future: Callable[[], asyncio.Future[Any] | None]
    time_ns: int | None
    owner: Node | None
    place: str


class UnhandledExceptions:
    """The exceptions of one loop's programs that nobody has handled.

    `now_ns` gives the emulated time to be told for a node, and None while its program is ended; `fallback` is the
    node that answers for code on nobody's behalf; `on_line` is called with a node and what its log is to have.
    """

    def __init__(
        self,
        now_ns: Callable[[Node | None], int | None],
        fallback: str,
        on_line: Callable[[str, str], None],
    ) -> None:
        self._on_line = on_line
        self._loop: SkewedLoop | None = None
        self._now_ns = now_ns
        self._fallback = fallback
        self._most = FIRST_CLEANING
        self._failures: dict[int, _Failure] = {}  # by the id of the future, which is gone when asyncio tells of it
        self._ready: list[Unhandled] = []
        self._lock = threading.RLock()  # of `_ready`: threads of programs and `__del__` come at any time
        self._held: list[tuple[_Failure, BaseException]] = []  # nothing is formatted while the collector runs
        self._jobs: list[tuple[_Failure, ExecutorJob]] = []
        """Jobs that a program has given to an executor itself, and that have failed."""
        self._silenced: weakref.WeakSet[Node] = weakref.WeakSet()

    def attach(self, loop: SkewedLoop) -> None:
        """Have the loop of the programs tell of what fails, until `close`."""
        self._loop = loop
        loop.on_failed, loop.on_unhandled, loop.owner_of = self._failed, self._unhandled, self._owner_of
        asyncio_internals.tell_of_failed_gatherings()
        outside_loop.attach()

    def watch(self, task: asyncio.Task[Any], owner: Node | None) -> None:
        """Remember when a task fails, and have all other exceptions of its node."""

        def done(task: asyncio.Future[Any]) -> None:
            if asyncio_internals.is_unretrieved(task):
                self._note(task, owner, "in a task")

        task.add_done_callback(done, context=NOBODY)
        if owner is not None:
            outside_loop.watch(owner, self._failed_outside)

    def add(self, owner: Node, error: BaseException, place: str) -> None:
        """Take an exception that has just been caught outside asyncio."""
        if not isinstance(error, KeyboardInterrupt):
            self._tell(_Failure(_nothing, self._now_ns(owner), owner, place), error)

    @property
    def has_any(self) -> bool:
        """True if `take` would return any."""
        return bool(self._ready)

    def take(self) -> list[Unhandled]:
        """Return the exceptions that are told by now, in the order of their instants."""
        if not self._ready:
            return []
        with self._lock:
            ready, self._ready = self._ready, []
        return sorted(ready, key=lambda each: (each.time_ns is None, each.time_ns))

    def so_far(self) -> list[Unhandled]:
        """Return what `settle` and `take` would, and leave it all: programs may still handle some of it."""
        futures = [(failure, failure.future()) for failure in list(self._failures.values())]
        unretrieved = [(each, f) for each, f in futures if f is not None and asyncio_internals.is_unretrieved(f)]
        failed = [(failure, asyncio_internals.error_of(future)) for failure, future in unretrieved]
        with self._lock:
            ready, jobs = list(self._ready), list(self._jobs)
        failed += [*self._held, *((failure, job.error) for failure, job in jobs if not job.is_awaited)]
        heard = [(failure, error) for failure, error in failed if failure.owner not in self._silenced]
        own = [(failure, error) for failure, error in heard if not isinstance(error, _NOT_ITS_OWN)]
        return [*ready, *(self._of(failure, error) for failure, error in own if error is not None)]

    def settle(self, owner: Node | None = None) -> None:
        """Tell of everything that nobody has retrieved by now, of all nodes or of one whose program has ended."""
        for key, failure in list(self._failures.items()):
            future = failure.future()
            if owner in (None, failure.owner) and future is not None and asyncio_internals.is_unretrieved(future):
                self._failures.pop(key, None)
                self._held.append((failure, asyncio_internals.disclaim(future)))
        with self._lock:
            jobs, self._jobs = self._jobs, []
        held = [*self._held, *((failure, job.error) for failure, job in jobs if not job.is_awaited)]
        self._held = []
        for failure, error in held:
            if owner not in (None, failure.owner):
                self._held.append((failure, error))
                continue
            self._ready_unless_silenced(failure, error)

    def silence(self, owner: Node) -> None:
        """Tell nothing more of this node: its process is gone."""
        self._silenced.add(owner)
        self._held = [(failure, error) for failure, error in self._held if failure.owner is not owner]
        with self._lock:
            self._jobs = [each for each in self._jobs if each[0].owner is not owner]

    def close(self) -> None:
        """Watch nothing any more."""
        if self._loop is not None:
            self._loop.on_failed, self._loop.on_unhandled = lambda future: None, lambda context: True
            self._loop.owner_of = lambda context: None
            self._loop = None
            outside_loop.detach()

    def _failed_outside(self, owner: Node, error: BaseException, place: str, job: ExecutorJob | None) -> bool:
        """Take what has left a thread, a job or `__del__`; what comes after `close` is not taken.

        Whether somebody asks for the end of a job is known when the program ends.
        """
        if self._loop is None:
            return False
        failure = _Failure(_nothing, self._now_ns(owner), owner, place)
        if job is None:
            self._ready_unless_silenced(failure, error)
        else:
            with self._lock:
                self._jobs = [each for each in self._jobs if not each[1].is_awaited][:MOST_HELD]
                self._jobs.append((failure, job))
        return True

    # What asyncio tells.

    def _failed(self, future: asyncio.Future[Any]) -> None:
        """A future, which is no task, was given an exception."""
        context = getattr(future, "job_context", None)
        owner = present_node() if context is None else context.get(current_node)
        place = "in a future" if context is None else "in an executor job"
        for each in asyncio_internals.gathered(future):
            failure = self._failures.get(id(each))
            if failure is not None and asyncio_internals.error_of(each) is asyncio_internals.error_of(future):
                place = failure.place
        self._note(future, owner, place)

    def _note(self, future: asyncio.Future[Any], owner: Node | None, place: str) -> None:
        if len(self._failures) >= self._most and not collector.runs:
            self._forget_retrieved()
        self._failures[id(future)] = _Failure(weakref.ref(future), self._now_ns(owner), owner, place)

    def _forget_retrieved(self) -> None:
        futures = {key: failure.future() for key, failure in list(self._failures.items())}
        for key, future in futures.items():
            if future is None or not asyncio_internals.is_unretrieved(future):
                self._failures.pop(key, None)  # a collection in another thread may have told of it
        self._most = 2 * len(self._failures) + FIRST_CLEANING

    def _unhandled(self, context: dict[str, Any]) -> bool:
        """Asyncio's exception handler was called; returns whether asyncio is to log it."""
        error = context.get("exception")
        if error is None or str(context.get("message")).endswith(_SHIELDED):
            return True
        failure = self._failure_of(context, error)
        if not collector.runs:
            self._ready_unless_silenced(failure, error)
        elif len(self._held) < MOST_HELD and failure.owner not in self._silenced:
            self._held.append((failure, error))
        return False

    def _owner_of(self, context: dict[str, Any]) -> Node | None:
        """Return the node that has left what asyncio's exception handler gets."""
        if (handle := context.get("handle")) is not None:
            return node_of(handle)
        future = context.get("future", context.get("task"))
        for each in () if future is None else (future, *asyncio_internals.gathered(future)):
            if (failure := self._failures.get(id(each))) is not None:
                return failure.owner
        return present_node()

    def _failure_of(self, context: dict[str, Any], error: BaseException) -> _Failure:
        future = context.get("future")
        if future is None:
            handle = context.get("handle")
            owner = present_node() if handle is None else node_of(handle)
            return _Failure(_nothing, self._now_ns(owner), owner, "in a callback")
        for each in (future, *asyncio_internals.gathered(future)):
            failure = self._failures.get(id(each))
            if failure is not None and (each is future or asyncio_internals.error_of(each) is error):
                if each is future:
                    self._failures.pop(id(each), None)  # `_forget_retrieved` may have, in another thread
                return failure
        owner = present_node()
        return _Failure(_nothing, self._now_ns(owner), owner, "in a future")

    def _ready_unless_silenced(self, failure: _Failure, error: BaseException) -> None:
        if not isinstance(error, _NOT_ITS_OWN):
            self._tell(failure, error)

    def _tell(self, failure: _Failure, error: BaseException) -> None:
        if failure.owner not in self._silenced:
            unhandled = self._of(failure, error)
            with self._lock:
                self._ready.append(unhandled)
            self._on_line(unhandled.node, f"{unhandled.node} exception {unhandled.place}\n{unhandled.details}")

    def _of(self, failure: _Failure, error: BaseException) -> Unhandled:
        node = self._fallback if failure.owner is None else failure.owner.id
        line = own_line(error)
        place = f"{failure.place} ({line})" if line else failure.place
        details = sendable(traceback_text(error, error.__traceback__))
        return Unhandled(node, failure.time_ns, error_line(error), place, details)


def line_of_task(task: asyncio.Task[Any]) -> str:
    """Return file and line of the innermost frame in which a suspended task waits that is the program's own."""
    return line_of((frame, frame.f_lineno) for frame in asyncio_internals.suspended_in(task))


def _nothing() -> None:
    """Stand in for the reference to a future that nobody asks for."""
