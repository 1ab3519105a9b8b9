"""Code of the user's own in the emulator's process: importing checks and rules, what programs declare, and bounds.

A program's module names one in a constant, `DECLARES = "package.module"`. The constant is read from the source, so
that no program is imported here. docs/how-to/results.md describes such a module.

A rule that loops, or waits, forever is stopped. A thread looks at the processor time of the calling thread now and
then. So a slow machine, or one that is stopped, stops nothing. In the main thread, to which Python gives signals, a
call that has had its time is interrupted by a signal whose handler raises; the handler is set for the call alone.
From any other thread the function is called on a thread of its own, which is left behind. In a single long call
into a library nothing is interrupted before it returns.
"""

from __future__ import annotations

import ast
import inspect
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextvars import copy_context
from dataclasses import dataclass, field
from functools import partial
from importlib.machinery import PathFinder
from importlib.util import find_spec
from pathlib import Path
from queue import SimpleQueue
from types import FrameType, ModuleType, TracebackType
from typing import Any, NoReturn, TypeVar

from emulator.scenario.program import Program
from vnet.errors import ScenarioError, VnetError, printable
from vnet.extras import missed_by
from vnet.runtime.programs import import_for_run

LONGEST_ERROR = 300
CONSTANT = "DECLARES"
LIMIT_S = 10.0
"""Processor time of one call: a thousand times what a rule for hundreds of receivers takes."""
WAIT_LIMIT_S = 30.0
"""Time that one call may wait: three times what it may compute."""
BUSY_SHARE = 0.01
"""Share of processor time above which a call computes, and does not wait."""
WAKE_UP = signal.SIGALRM
LOOK_EVERY_S = 0.1
IDLE_S = 5.0
"""Time without a call after which the thread ends."""
T = TypeVar("T")


class NonsenseError(VnetError):
    """An answer of a function of the user's own that is none."""


def load_function(key: str, entry: str, program: Program, usage: str) -> Callable[..., Any]:
    """Import the function that a scenario's `key` names as `module:function`; `usage` is how one is written.

    Raises ScenarioError for one that cannot be imported, or is in a program's module.
    """
    name, _, function = entry.partition(":")
    problem = f"{key} = {entry!r}"
    if name in {each.entry.partition(":")[0] for each in (program, *program.exceptions)}:
        raise ScenarioError(f"{problem}: is in the program's module: put it into a module of its own")
    try:
        module = import_for_run(name)
    except (Exception, SystemExit) as error:
        raise ScenarioError(f"{problem}: cannot import: {in_words(error)}") from error
    found = getattr(module, function, None)
    if found is None:
        file = getattr(module, "__file__", None) or "built in"
        raise ScenarioError(f"{problem}: module {name} ({file}) has no {function!r}")
    if not callable(found) or inspect.iscoroutinefunction(found):
        raise ScenarioError(f"{problem}: is not a function {usage.format(function)}")
    return found  # type: ignore[no-any-return]


def in_words(error: BaseException) -> str:
    """Return an exception in one line."""
    said = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
    return missed_by(error) or printable(said, LONGEST_ERROR)


def outside(error: BaseException, *files: str) -> TracebackType | None:
    """Return the traceback of an exception from the first line on that is not of these files of vnet, or None."""
    frames = error.__traceback__
    while frames is not None and frames.tb_frame.f_code.co_filename in files:
        frames = frames.tb_next
    return frames


def line_of(frames: TracebackType | None) -> str:
    """Return the last line `FILE:NUMBER` of a traceback in the file in which it begins; "" for None."""
    extracted = traceback.extract_tb(frames)
    if not extracted:
        return ""
    last = [frame for frame in extracted if frame.filename == extracted[0].filename][-1]
    return f"{Path(last.filename).name}:{last.lineno}"


def declared(program: Program, name: str) -> list[Any]:
    """Return what the modules that a scenario's programs declare hold by this name. Raises ScenarioError."""
    modules = map(_imported, _declared(program))
    return [getattr(module, name) for module in modules if hasattr(module, name)]


def declared_checks(program: Program) -> list[str]:
    """Return the checks that a scenario's programs declare, `CHECKS`, as entries; so is a module that fails."""
    entries: list[str] = []
    for module in _declared(program):
        try:
            checks = getattr(_imported(module), "CHECKS", ())
        except ScenarioError:
            checks = None
        if isinstance(checks, (list, tuple)) and all(isinstance(each, str) for each in checks):
            entries += checks
        else:
            entries.append(f"{module}:CHECKS")  # its check says why
    return entries


def are_here(program: Program) -> bool:
    """Return whether all programs of a scenario are found, so that what they declare is known."""
    return all(module in sys.modules or _text(module) for module in _modules(program))


def load_entry(entry: str) -> Any:
    """Import what a declared `module:name` names. Raises ScenarioError."""
    module, _, name = entry.partition(":")
    found = getattr(_imported(module), name, None)
    if found is None:
        raise ScenarioError(f"{entry!r}: module {module} has no {name!r}")
    return found


def _declared(program: Program) -> list[str]:
    """Return the names of the declared modules, each once."""
    return list(dict.fromkeys(filter(None, map(_declared_by, _modules(program)))))


def _modules(program: Program) -> list[str]:
    return [each.entry.partition(":")[0] for each in (program, *program.exceptions)]


def _imported(name: str) -> ModuleType:
    try:
        return import_for_run(name)
    except (Exception, SystemExit) as error:
        raise ScenarioError(f"{CONSTANT}: cannot import {name!r}: {in_words(error)}") from error


def _declared_by(module: str) -> str | None:
    """Return the name that a module declares; None for one that declares nothing, or is not found."""
    if module in sys.modules:
        name = getattr(sys.modules[module], CONSTANT, None)
        return name if isinstance(name, str) else None
    try:
        tree = ast.parse(_text(module))
    except (SyntaxError, ValueError):
        return None
    for statement in tree.body:
        match statement:
            case ast.Assign(targets=[ast.Name(id="DECLARES")], value=ast.Constant(value=str(name))):
                return name
    return None


def _text(module: str) -> str:
    """Return the source of a module without importing it, or a package that it is in; "" where there is none."""
    first, *others = module.split(".")
    try:
        spec, name = find_spec(first), first
        for part in others:
            name = f"{name}.{part}"
            spec = None if spec is None else PathFinder.find_spec(name, spec.submodule_search_locations)
        return Path(spec.origin).read_text() if spec is not None and spec.origin and spec.has_location else ""
    except (OSError, ValueError, ImportError):
        return ""


class NoAnswerError(BaseException):
    """A call has had its time. No Exception, so that the function does not catch it by accident."""

    def __str__(self) -> str:
        return f"{LIMIT_S:g} s of processor time"


class WaitedError(NoAnswerError):
    """A call has waited for too long."""

    def __str__(self) -> str:
        return f"{WAIT_LIMIT_S:g} s of waiting"


class NoThreadError(VnetError):
    """This process has no room for a thread that watches a call: not the function's fault."""


def _start(function: Callable[..., object], *arguments: object, name: str) -> threading.Thread:
    thread = threading.Thread(target=function, args=arguments, name=name, daemon=True)
    try:
        thread.start()
    except RuntimeError as error:
        raise NoThreadError(
            f"no room for a thread that watches own figures, rules and sensors: {error}: see ulimit -v and -u"
        ) from None
    return thread


@dataclass(eq=False)
class _Call:
    """A call that is on: its thread, the clock of that thread, and its time by that clock at the start, in ns.

    `looked_ns` is that time when the watch last looked, and `waited_s` how long it has seen the call wait.
    `due` is the exception that the handler of `WAKE_UP` is to raise. `leave`, if given, is called with it instead.
    """

    leave: Callable[[_Call, NoAnswerError], None] | None = None

    thread: int = field(default_factory=threading.get_ident)
    clock: int | None = field(default_factory=lambda: _own_clock())
    start_ns: int = 0
    looked_ns: int = 0
    waited_s: float = 0.0
    is_on: bool = True
    is_signalled: bool = False
    due: NoAnswerError | None = None
    handler_before: Any = None

    def __post_init__(self) -> None:
        self.start_ns = self.looked_ns = self.cpu_ns()

    def take_signals(self) -> None:
        """Set the handler of `WAKE_UP` to that of this call."""
        self.handler_before = signal.signal(WAKE_UP, self._wake_up)

    def cpu_ns(self) -> int:
        """Return the time of the clock; of the whole process where threads have no clocks."""
        return time.process_time_ns() if self.clock is None else time.clock_gettime_ns(self.clock)

    def look(self) -> None:
        """Stop the call if it has had its time: again and again, if it goes on."""
        cpu_ns = self.cpu_ns()
        self.waited_s += LOOK_EVERY_S if cpu_ns - self.looked_ns < BUSY_SHARE * LOOK_EVERY_S * 1e9 else 0.0
        self.looked_ns = cpu_ns
        if cpu_ns - self.start_ns > LIMIT_S * 1e9:
            self.start_ns = cpu_ns
            self._stop(NoAnswerError())
        elif self.waited_s > WAIT_LIMIT_S:
            self.waited_s = 0.0
            self._stop(WaitedError())

    def _stop(self, error: NoAnswerError) -> None:
        if self.handler_before is not None:
            self.due, self.is_signalled = error, True
            signal.pthread_kill(self.thread, WAKE_UP)
        elif self.leave is not None:
            leave, self.leave = self.leave, None
            leave(self, error)

    def release_signals(self) -> None:
        """Set the handler of before; the watch does not look at the call any more."""
        if self.handler_before is not None:
            if self.is_signalled:
                time.sleep(0)  # a signal that has been sent is taken before a system call returns
            signal.signal(WAKE_UP, self.handler_before)
            self.handler_before = None

    def _wake_up(self, number: int, frame: FrameType | None) -> None:
        """Raise in a call that has had its time; give every other such signal to the handler of before."""
        due, self.due = self.due, None
        if due is None:
            if callable(self.handler_before):
                self.handler_before(number, frame)
        elif self.is_on and not _in_debugger(frame):
            raise due


def _in_debugger(frame: FrameType | None) -> bool:
    """Return whether pdb waits for its user."""
    while frame is not None:
        if frame.f_globals.get("__name__") == "bdb":
            return True
        frame = frame.f_back
    return False


def _own_clock() -> int | None:
    return time.pthread_getcpuclockid(threading.get_ident()) if sys.platform == "linux" else None


class _Watch:
    """The calls that are on in this process, and the thread that looks at them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._calls: set[_Call] = set()
        self._thread: threading.Thread | None = None
        self._last_s = 0.0

    def begin(self, call: _Call) -> None:
        if call.leave is None:
            call.take_signals()
        with self._lock:
            self._calls.add(call)
            self._last_s = time.monotonic()
            if self._thread is None or not self._thread.is_alive():  # a fork has no threads but its own
                self._thread = _start(self._look, name="rule watch")

    def end(self, call: _Call) -> None:
        call.is_on = False
        with self._lock:
            self._calls.discard(call)
        call.release_signals()

    def _look(self) -> None:
        while True:
            time.sleep(LOOK_EVERY_S)
            with self._lock:
                for call in self._calls:
                    call.look()
                if not self._calls and time.monotonic() - self._last_s > IDLE_S:
                    self._thread = None
                    return


_WATCH = _Watch()


def call_bounded(function: Callable[..., T], *arguments: object) -> T:
    """Return what a function returns. Raises what it raises, or NoAnswerError after its time.

    It may compute for `LIMIT_S`, and wait for `WAIT_LIMIT_S`.
    """
    # None: a handler that Python has not set, and cannot set again.
    if threading.current_thread() is threading.main_thread() and signal.getsignal(WAKE_UP) is not None:
        return _call_here(_Call(), function, *arguments)
    return _call_aside(function, *arguments)


def _call_aside(function: Callable[..., T], *arguments: object) -> T:
    """Call on a thread of its own, which goes on by itself once it has had its time: nobody takes its answer."""
    answers: SimpleQueue[Callable[[], T]] = SimpleQueue()

    def leave(call: _Call, error: NoAnswerError) -> None:
        stack = _stack(sys._current_frames().get(call.thread))
        answers.put(partial(_raise, error.with_traceback(stack)))

    def run() -> None:
        try:
            answer = _call_here(_Call(leave), function, *arguments)
        except BaseException as error:
            answers.put(partial(_raise, error))
        else:
            answers.put(lambda: answer)

    _start(copy_context().run, run, name="rule")
    return answers.get()()


def _raise(error: BaseException) -> NoReturn:
    raise error


def _stack(frame: FrameType | None) -> TracebackType | None:
    """Return the traceback from this file to where a thread stands, as if it had raised there."""
    traced: TracebackType | None = None
    while frame is not None and frame.f_code.co_filename != __file__:
        traced = TracebackType(traced, frame, frame.f_lasti, frame.f_lineno or frame.f_code.co_firstlineno)
        frame = frame.f_back
    return traced


def _call_here(call: _Call, function: Callable[..., T], *arguments: object) -> T:
    try:
        try:
            _WATCH.begin(call)
            return function(*arguments)
        finally:
            _WATCH.end(call)
    except NoAnswerError:
        _WATCH.end(call)  # it may have been raised while the call ended
        raise


def told(error: BaseException, *files: str) -> tuple[str, str]:
    """Return in one line how a function of the user's own failed, with its line, and the traceback from there on.

    `files` are those of vnet in the traceback, besides this one. Raises NoThreadError if that is the error.
    """
    if isinstance(error, NoThreadError):
        raise error
    if isinstance(error, NonsenseError):
        return f"answers {error}", ""
    frames = outside(error, __file__, *files)
    said = f"does not answer within {error}" if isinstance(error, NoAnswerError) else f"raises {in_words(error)}"
    if frames is None:
        return said, ""
    return f"{said} ({line_of(frames)})", "".join(traceback.format_exception(error.with_traceback(frames)))
