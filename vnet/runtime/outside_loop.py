"""Exceptions of programs that the event loop never sees, and ends of the process that programs ask for.

Python hands exceptions in threads that a program starts, and in `__del__`, to `threading.excepthook` and
`sys.unraisablehook`, which print them. While hosts run programs, these hooks first ask for the node on whose behalf
the code runs, and give the exception to whoever watches that node. What belongs to no node is printed as before,
and so is what the garbage collector finds: when it runs depends on the process, and nothing that a run says may.

`os._exit` and `os.exec*` are the death of a vehicle. Where programs share a process with the emulator (`caught`),
the vehicle alone has died, and the program goes no further. In a process of their own (`count_as_death`) it ends,
with a status other than 0: 0 is that of a run's end.
"""

from __future__ import annotations

import _thread
import atexit
import faulthandler
import gc
import os
import posix
import sys
import threading
import weakref
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import partial, wraps
from typing import Any, NoReturn

from vnet.node import Node
from vnet.runtime import own_asyncio

Taker = Callable[[Node, BaseException, str, "ExecutorJob | None"], bool]
"""Takes an exception of a node, the place where it was raised, and the job that failed with it, if it was one.

Returns False if it is not to be taken.
"""

exit_now = os._exit
"""End this process at once: `os._exit` as it is."""
DEATH_STATUS = 71
"""Exit status of a process whose program has ended it with status 0, or has put another program in its place."""
JOBS = "vnet"
"""Prefix of the names of threads of the default executor, whose jobs are nobody's."""

_end_takers: list[Callable[[Node | None, str], None]] = []
_process = os.getpid()
_is_programs_own = False
_before_death: list[Callable[[], None]] = []
_status_late = 0
_FROZEN_AT_START = gc.get_freeze_count()
_importing: set[int] = set()
"""Threads that import a module of the user's."""


class _Collector:
    """Knows whether the garbage collector runs in the present thread; registered once for the whole process.

    What a collection discards may give way to other threads. What they raise meanwhile is not of its finding.
    """

    def __init__(self) -> None:
        self._thread: int | None = None

    def __call__(self, phase: str, info: dict[str, int]) -> None:
        self._thread = threading.get_ident() if phase == "start" else None

    @property
    def runs(self) -> bool:
        """True in the thread that collects, while it does; where what it has called waits, others may go on."""
        return self._thread == threading.get_ident()

    @runs.setter
    def runs(self, value: bool) -> None:
        if value != self.runs:  # else another thread may collect
            self._thread = threading.get_ident() if value else None


collector = _Collector()
MOST_UNCOLLECTED = 2_000_000
"""Objects that programs may make, less those that are freed, before Python collects garbage when it likes: a
program that makes so many between two instants needs the memory."""
_lock = threading.Lock()
_schedules = 0
_before_schedules: tuple[tuple[int, int, int], bool] = (gc.get_threshold(), False)
BLOCKS_A_COUNT = 20
"""Blocks from one count of many objects to the next: counting takes milliseconds."""
BLOCKS_FROZEN = 100
"""Blocks for which what others have frozen counts as frozen: in a session of tests a count takes 0.1 s."""
_blocks = 0
_objects = 0
"""Objects at the first count, or left by the last collection before a block."""
_found_frozen = 0
"""Blocks since others were last found to have frozen objects, with that one; 0 if they were found to have none."""
_takers: weakref.WeakKeyDictionary[Node, weakref.WeakMethod[Taker]] = weakref.WeakKeyDictionary()
is_nobodys: ContextVar[bool] = ContextVar("is_nobodys", default=False)
"""True where threads are started that serve all nodes of a process, whichever asks first."""
_started_by: weakref.WeakKeyDictionary[threading.Thread, Node] = weakref.WeakKeyDictionary()
_served = threading.local()
"""The node whose job a thread of an executor does, as `node`."""
_watchers = 0
_before: tuple[Any, Any] = (sys.unraisablehook, threading.excepthook)
_start_thread = threading.Thread.start
_start_new_thread = _thread.start_new_thread


@contextmanager
def collected_by_schedule() -> Iterator[None]:
    """Leave it to the loops of programs when garbage is collected, within the block.

    What is there at its beginning is not searched for garbage: it would cost more than the rest. A collector that
    is switched off by its threshold stays so.
    """
    global _schedules, _before_schedules
    with _lock:
        _schedules += 1
        if _schedules == 1:
            freezes = not _others_have_frozen()
            _before_schedules = gc.get_threshold(), freezes
            if freezes:
                _freeze()
            if gc.get_threshold()[0]:
                gc.set_threshold(MOST_UNCOLLECTED, *gc.get_threshold()[1:])
    try:
        yield
    finally:
        with _lock:
            _schedules -= 1
            if _schedules == 0:
                gc.set_threshold(*_before_schedules[0])
                if _before_schedules[1]:
                    gc.unfreeze()


def _others_have_frozen() -> bool:
    """Return True if objects are frozen before a block, which are counted only now and then once there are some."""
    global _found_frozen
    if _found_frozen % BLOCKS_FROZEN == 0:
        _found_frozen = int(is_frozen())
    else:
        _found_frozen += 1
    return _found_frozen > 0


def is_frozen() -> bool:
    """Return whether somebody has frozen objects: Python 3.12 has itself, some at its start."""
    return gc.get_freeze_count() > _FROZEN_AT_START


def _freeze() -> None:
    """Freeze what is there, less garbage once there is a quarter more than before: Python's own rule.

    Python would never find what is left of earlier runs: within blocks it is frozen, and between them, Python
    makes too few objects to look through the old ones.
    """
    global _blocks, _objects
    gc.freeze()
    _blocks += 1
    if _blocks % BLOCKS_A_COUNT:
        return
    count = gc.get_freeze_count()
    _objects = _objects or count
    if count > 1.25 * _objects and gc.isenabled() and gc.get_threshold()[0]:
        gc.unfreeze()
        gc.collect()
        gc.freeze()
        _objects = gc.get_freeze_count()


def watch(node: Node, taker: Taker) -> None:
    """Hand the exceptions of `node` to `taker`, a bound method, while both are there."""
    if node not in _takers:
        _takers[node] = weakref.WeakMethod(taker)


def attach() -> None:
    """Take the hooks of Python and of the collector; each call is followed by one of `detach`."""
    global _watchers, _before
    own_asyncio.attach()
    if collector not in gc.callbacks:
        gc.callbacks.append(collector)
    if threading.Thread.start is _start_thread:
        threading.Thread.start = _start_noted  # type: ignore[assignment, method-assign]
    if _thread.start_new_thread is _start_new_thread:
        _thread.start_new_thread = _start_new_noted
    Executor.__init_subclass__ = classmethod(_note_defined)  # type: ignore[assignment, method-assign]
    for kind in (ThreadPoolExecutor, *Executor.__subclasses__()):
        _note_pools(kind)
    if sys.unraisablehook is not _unraisable:
        _before = (sys.unraisablehook, _before[1])
        sys.unraisablehook = _unraisable
    if threading.excepthook is not _thread_failed:
        _before = (_before[0], threading.excepthook)
        threading.excepthook = _thread_failed
    _watchers += 1


def detach() -> None:
    """Give the hooks back when nobody watches any more, unless a program has put others in their place."""
    global _watchers
    own_asyncio.detach()
    _watchers -= 1
    if _watchers == 0:
        if sys.unraisablehook is _unraisable:
            sys.unraisablehook = _before[0]
        if threading.excepthook is _thread_failed:
            threading.excepthook = _before[1]


@wraps(_start_thread)
def _start_noted(thread: threading.Thread) -> None:
    owner = None if is_nobodys.get() else present_node()
    if owner is not None:
        _started_by[thread] = owner
    _start_thread(thread)


@wraps(_start_new_thread)
def _start_new_noted(function: Callable[..., object], *arguments: Any) -> int:
    owner = present_node()
    if owner is None or not callable(function):
        return _start_new_thread(function, *arguments)

    def run(*args: Any, **options: Any) -> None:
        try:
            function(*args, **options)
        except Exception as error:
            if not taken(owner, error, "in a thread"):
                raise

    return _start_new_thread(run, *arguments)


def has_threads(node: Node) -> bool:
    """Return whether a thread that `node` has started goes on."""
    return any(owner is node and thread.is_alive() for thread, owner in list(_started_by.items()))


class ExecutorJob(Future[Any]):
    """A job that a program has given to an executor itself; `is_awaited` once anybody asks for its end."""

    is_awaited = False

    @property
    def error(self) -> BaseException:
        """The exception with which it has failed; to look is not to ask."""
        error = super().exception()
        assert error is not None
        return error

    def result(self, timeout: float | None = None) -> Any:
        self.is_awaited = True
        return super().result(timeout)

    def exception(self, timeout: float | None = None) -> BaseException | None:
        self.is_awaited = True
        return super().exception(timeout)

    def add_done_callback(self, fn: Callable[[Future[Any]], object]) -> None:
        self.is_awaited = True
        super().add_done_callback(fn)


def _noted(submit: Callable[..., Future[Any]]) -> Callable[..., Future[Any]]:
    """Return an executor's `submit` that notes on whose behalf it is called, and jobs of its threads are done."""

    @wraps(submit)
    def submit_noted(
        executor: Executor, function: Callable[..., Any], /, *args: Any, **options: Any
    ) -> Future[Any]:
        owner = present_node()
        if owner is not None and isinstance(executor, ThreadPoolExecutor):
            function = partial(_on_behalf_of, owner, function)
        job = submit(executor, function, *args, **options)
        if owner is not None and type(job) is Future:
            job.__class__ = ExecutorJob
            Future.add_done_callback(job, partial(_job_done, owner))
        return job

    return submit_noted


def _note_pools(kind: type[Executor]) -> None:
    """Note the jobs of Python's own executors; that of processes is slow to import, and few programs do."""
    if kind.__module__.startswith("concurrent.futures.") and not hasattr(kind.submit, "__wrapped__"):
        kind.submit = _noted(kind.submit)  # type: ignore[method-assign]


def _note_defined(kind: type[Executor], /, **options: Any) -> None:
    super(Executor, kind).__init_subclass__(**options)
    _note_pools(kind)


def _on_behalf_of(owner: Node, job: Callable[..., Any], /, *args: Any, **options: Any) -> Any:
    _served.node = owner
    try:
        return job(*args, **options)
    finally:
        _served.node = None


def _job_done(owner: Node, job: Future[Any]) -> None:
    error = None if job.cancelled() else Future.exception(job)
    if isinstance(job, ExecutorJob) and error is not None:
        taken(owner, error, "in an executor job", job)


def present_node() -> Node | None:
    """Return the node on whose behalf the present code runs: that of its callback, context, job, or thread."""
    return awaited_node() or _started_by.get(threading.current_thread())


def awaited_node() -> Node | None:
    """Return the node on whose behalf the present code runs, unless in a thread for which no time waits."""
    served: Node | None = getattr(_served, "node", None)
    return own_asyncio.present_node() or served


def _unraisable(ignored: sys.UnraisableHookArgs) -> None:
    error = ignored.exc_value or ignored.exc_type()
    name = getattr(ignored.object, "__name__", "")
    if collector.runs or not taken(present_node(), error, f"in {name}" if name else "where Python ignores it"):
        _before[0](ignored)


def _thread_failed(failed: threading.ExceptHookArgs) -> None:
    owner = None if failed.thread is None else _started_by.get(failed.thread)
    if not taken(owner, failed.exc_value or failed.exc_type(), "in a thread"):
        _before[1](failed)


def taken(owner: Node | None, error: BaseException, place: str, job: ExecutorJob | None = None) -> bool:
    """Hand an exception of `owner` to who watches that; return whether anybody has taken it."""
    reference = None if owner is None else _takers.get(owner)
    taker = None if reference is None else reference()
    if owner is None or taker is None or isinstance(error, KeyboardInterrupt | SystemExit):
        return False
    return taker(owner, error, place, job)


class ProcessEndedError(BaseException):
    """A program has ended its process: its vehicle has died, which has been told."""


@contextmanager
def caught(taker: Callable[[Node | None, str], None]) -> Iterator[None]:
    """Call `taker` within the block with each node that ends this process, and with the call that does."""
    global _process
    _replace()
    _process = os.getpid()
    _end_takers.append(taker)
    try:
        yield
    finally:
        _end_takers.remove(taker)


@contextmanager
def ends_refused() -> Iterator[None]:
    """Raise SystemExit where the present thread would end this process, if it is not a program's, in the block."""
    global _process
    _replace()
    thread, _process = threading.get_ident(), os.getpid()
    is_first = thread not in _importing
    _importing.add(thread)
    try:
        yield
    finally:
        if is_first:
            _importing.discard(thread)


def count_as_death(*first: Callable[[], None]) -> None:
    """Have this process, which is that of its programs, end with a status other than 0 if one of them ends it.

    What is in `first` is called before.
    """
    global _process, _is_programs_own
    _replace()
    _process, _is_programs_own, _before_death[:] = os.getpid(), True, first


def refuse_success() -> None:
    """Have `os._exit` and `exec*` end this process with a status other than 0 from now on, whoever calls them.

    A test's process that a thread, a finalizer or an `atexit` function of a program ends has not passed.
    """
    global _process, _status_late
    _replace()
    _process, _status_late = os.getpid(), DEATH_STATUS


def _replace() -> None:
    for name in ("_exit", "execv", "execve"):
        original = getattr(os, name)
        if not hasattr(original, "__wrapped__"):
            replacement = _replacement(name, original)  # one, so that it can be pickled by its name
            for module in (os, posix):
                setattr(module, name, replacement)


def _replacement(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(original)
    def end(*args: Any, **options: Any) -> Any:
        if os.getpid() != _process:  # a process that a program has forked
            return original(*args, **options)
        call = f"os.{name}({', '.join([*map(repr, args[:1]), *(f'{key}={options[key]!r}' for key in options)])})"
        node = present_node()
        if _is_programs_own:
            status = args[0] if name == "_exit" and args and isinstance(args[0], int) else 0
            for call_first in _before_death:
                call_first()
            _end_as_death(node, call, status)
        if threading.get_ident() in _importing:
            raise SystemExit([*args, options.get("status", 0)][0] if name == "_exit" else 0)
        if not _end_takers or (node is None and not threading.current_thread().name.startswith(f"{JOBS}_")):
            if _status_late and (name != "_exit" or not args or args[0] == 0):
                sys.stderr.write(f"vnet: {call} ended the process of the tests\n")
                exit_now(_status_late)
            return original(*args, **options)
        for taker in tuple(_end_takers):
            taker(node, call)
        raise ProcessEndedError(call)

    return end


def _end_as_death(node: Node | None, call: str, status: int) -> NoReturn:
    sys.stderr.write(f"vnet-agent: the program of {'a vehicle' if node is None else node.id} called {call}\n")
    sys.stderr.flush()
    exit_now(status or DEATH_STATUS)


ENDING_S = 60.0
"""Seconds for an agent, or a separate router, to end: Zenoh gives a connection up after ten."""


def end_within(seconds: float = ENDING_S) -> None:
    """Have this process end after so many seconds at the latest, with status 1 and its stacks on standard error."""
    if sys.__stderr__ is not None:
        faulthandler.dump_traceback_later(seconds, exit=True, file=sys.__stderr__)


# The end of a process that was forked from a zygote.
#
# An interpreter that ends takes all of its objects apart, and so writes to memory that it has shared with the
# zygote so far: at the end of a run all agents at once would need several times the memory that they ran in.


def end_forked(status: int, shared: Collection[str]) -> NoReturn:
    """End this process with `status`, and leave the objects of the modules named in `shared` as they are.

    As when an interpreter ends, threads are awaited and functions of `atexit` called, and what the other modules
    hold is discarded, so that files which they have left open are written.
    """
    threading._shutdown()  # type: ignore[attr-defined]  # as multiprocessing does, and `_exit` below
    atexit._run_exitfuncs()
    for name in [name for name in reversed(sys.modules) if name not in shared]:
        module = sys.modules.pop(name)
        with suppress(AttributeError, TypeError):  # what a program has put in a module's place
            vars(module).clear()
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):  # closed, none, or without a reader
            stream.flush()
    exit_now(status)
