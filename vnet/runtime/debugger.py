"""A debugger, pdb, that stops in one node's program and nowhere else.

A process may host several nodes on one loop, and their programs share code. So every event of Python's tracing is
taken only while code runs on behalf of the node that is debugged: breakpoints, steps and `breakpoint()` of others
pass. The loop is blocked at the prompt, and emulated time with it.
"""

from __future__ import annotations

import dis
import inspect
import io
import json
import os
import pdb
import socket
import sys
import sysconfig
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from types import FrameType, TracebackType
from typing import IO, Any, TextIO, cast

from vnet.errors import LONGEST_MESSAGE, printable
from vnet.runtime.debug_target import DebugTarget
from vnet.runtime.error_text import error_line
from vnet.units import NS_PER_S

_NOT_STEPPED_INTO = (
    "agents.host",
    "emulator.",
    "namedtuple_",  # what Python generates for named tuples
    "vnet.gateway",
    "vnet.node",
    "vnet.radio",
    "vnet.reports",
    "vnet.runtime.",
    "vnet.transport.",
)
"""Beginnings of the names of modules in which a step does not stop: what lies between the lines of a program."""
_LIBRARIES = ("<frozen ", *(f"{sysconfig.get_path(name)}/" for name in ("stdlib", "purelib", "platlib")))
"""Beginnings of the files in which a step does not stop either, unless the program itself is installed there."""
_BELOW_THE_PROGRAM = ("asyncio.events", "vnet.runtime.host")
"""Modules whose frames, and those below, are not shown."""
_BETWEEN_COROUTINES = (StopIteration, GeneratorExit)
_SUSPENDED_AT = ("YIELD_VALUE", "RESUME")
"""Instructions at which a coroutine that waits is found: up to Python 3.12 the former, from 3.13 on the latter."""
_RESUMABLE = inspect.CO_COROUTINE | inspect.CO_GENERATOR | inspect.CO_ASYNC_GENERATOR


class NodeDebugger(pdb.Pdb):
    """Pdb for one node's program, on the terminal of this process or on another pair of files.

    `at_prompt` is entered for as long as the user is asked. `on_quit` is called when the user quits, or has gone;
    it may raise what is to end the program.
    """

    def __init__(
        self,
        target: DebugTarget,
        at_prompt: Callable[[], AbstractContextManager[object]],
        on_quit: Callable[[], None],
        stdin: IO[str] | io.TextIOBase | None = None,
        stdout: IO[str] | io.TextIOBase | None = None,
    ) -> None:
        super().__init__(
            stdin=cast("IO[str] | None", stdin),
            stdout=cast("IO[str] | None", stdout),
            nosigint=True,
        )
        self._target = target
        self._at_prompt = at_prompt
        self._on_quit = on_quit
        self._is_here: Callable[[], bool] = lambda: False
        self._now_ns: Callable[[], int] = lambda: 0
        self._package = ""
        self._before: tuple[Callable[..., Any], Any] | None = None

    # What the host asks of it.

    def attach(self, is_here: Callable[[], bool], now_ns: Callable[[], int]) -> None:
        """Have `breakpoint()` stop here, until `detach`.

        `is_here` tells whether code runs on behalf of a node whose program goes on; `now_ns` gives emulated time.
        """
        self._is_here, self._now_ns = is_here, now_ns
        self._before = sys.breakpointhook, sys.gettrace()
        sys.breakpointhook = self._breakpoint

    def detach(self) -> None:
        """Stop nowhere any more: the programs have ended."""
        self._is_here = lambda: False
        if self._before is not None:
            sys.breakpointhook, trace = self._before
            sys.settrace(trace)
            self._before = None

    def stops_in(self, node: str) -> bool:
        """Return whether this node is the one that is debugged."""
        return node == self._target.node

    def begin(self, node: str, program: Callable[..., Any]) -> None:
        """Stop at the first line of the program that the caller is about to run for `node`, or at the target's."""
        if not self.stops_in(node) or self._before is None:
            return
        self._package = str(program.__module__).partition(".")[0]
        self.reset()
        self.botframe = sys._getframe(1)
        if self._target.file:
            self.set_break(self._target.file, self._target.line)
            self.set_continue()
        else:
            self.set_step()
        sys.settrace(self.trace_dispatch)

    def crashed(self, node: str, error: BaseException) -> None:
        """Let the user look at the program of `node`, which this exception has just left."""
        if self._is_here():
            self.reset()
            self.message(f"{node} has crashed: {printable(error_line(error), LONGEST_MESSAGE)}")
            self.interaction(None, error.__traceback__)

    def _breakpoint(self, *args: Any, **options: Any) -> Any:
        """Stand for `breakpoint()`: it stops in the node's code alone, in the debugger that the user prefers."""
        if not self._is_here():
            return None
        if os.environ.get("PYTHONBREAKPOINT"):
            return sys.__breakpointhook__(*args, **options)
        self.set_trace(sys._getframe(1))
        return None

    # What pdb does otherwise.

    def trace_dispatch(self, frame: FrameType, event: str, arg: Any) -> Any:
        """Take an event of tracing, if it is the node's."""
        return super().trace_dispatch(frame, event, arg) if self._is_here() else None

    def stop_here(self, frame: FrameType) -> bool:
        """Return whether a step stops here: in the program itself, and where the user has taken the last one."""
        return (frame is self.stopframe or self._is_own(frame)) and super().stop_here(frame)

    def _is_own(self, frame: FrameType) -> bool:
        module = str(frame.f_globals.get("__name__"))
        if module.startswith(_NOT_STEPPED_INTO) or frame.f_code.co_filename == "<string>":  # made, as by dataclass
            return False
        return module.partition(".")[0] == self._package or not frame.f_code.co_filename.startswith(_LIBRARIES)

    def dispatch_call(self, frame: FrameType, arg: Any) -> Any:
        """Enter a function; a coroutine is entered whenever it goes on, and stops at its next line, as a script."""
        if frame.f_code.co_flags & _RESUMABLE or frame.f_code.co_name == "<module>":
            return self.trace_dispatch
        return super().dispatch_call(frame, arg)

    def dispatch_return(self, frame: FrameType, arg: Any) -> Any:
        """Leave a function; a coroutine that only waits is not left."""
        if frame.f_code.co_flags & _RESUMABLE:
            if dis.opname[frame.f_code.co_code[frame.f_lasti]] in _SUSPENDED_AT:
                return self.trace_dispatch
            if frame is self.stopframe and frame is not self.botframe:
                self._set_stopinfo(None, None)  # type: ignore[attr-defined]  # next: in whoever awaits it
        return super().dispatch_return(frame, arg)

    def dispatch_exception(self, frame: FrameType, arg: Any) -> Any:
        """Take an exception, but for those by which coroutines return to each other."""
        return self.trace_dispatch if arg[0] in _BETWEEN_COROUTINES else super().dispatch_exception(frame, arg)

    def get_stack(self, f: FrameType | None, t: TracebackType | None) -> tuple[list[tuple[FrameType, int]], int]:
        """Return the frames of the program, without those that run it."""
        stack, index = super().get_stack(f, t)
        below = [n for n, (frame, _) in enumerate(stack) if frame.f_globals.get("__name__") in _BELOW_THE_PROGRAM]
        first = below[-1] + 1 if below else 0
        return (stack, index) if first > index else (stack[first:], index - first)

    def interaction(self, *where: Any) -> None:
        """Ask the user what to do; say of whom and when."""
        with self._at_prompt(), self._standard_streams():
            self.message(f"{self._target.node}, {self._now_ns() / NS_PER_S:.6f} s of emulated time")
            super().interaction(*where)
            quits, self.quitting = self.quitting, False
        if quits:
            self.clear_all_breaks()
            self._is_here = lambda: False
            self._on_quit()

    @contextmanager
    def _standard_streams(self) -> Iterator[None]:
        """Let commands that use `input`, such as `clear` and `interact`, ask where the debugger does."""
        before = sys.stdin, sys.stdout, sys.stderr
        if not self.use_rawinput:
            sys.stdin, sys.stdout, sys.stderr = (cast("TextIO", self.stdin), *2 * (cast("TextIO", self.stdout),))
        try:
            yield
        finally:
            sys.stdin, sys.stdout, sys.stderr = before

    def do_run(self, arg: str) -> None:
        """Refuse to start again: the run is not this program's alone."""
        self.error("the run cannot be started again from here; q ends it")

    do_restart = do_run


# The user's terminal, for a debugger in another process: lines of JSON over a Unix socket.
#
# The process connects for as long as it asks, and sends `{"text": …, "prompt": …}`; each is answered with
# `{"line": …}`, which is empty when the user has gone. `{"text": …, "quit": true}` ends the run.


class RemoteTerminal(io.TextIOBase):
    """Standard input and output of a debugger. The user answers at the socket `path`, within `open`."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._text: list[str] = []
        self._stream: IO[str] | None = None

    @contextmanager
    def open(self) -> Iterator[None]:
        """Connect to the user. Without a connection nobody answers."""
        with socket.socket(socket.AF_UNIX) as connection:
            with suppress(OSError):
                connection.connect(str(self._path))
                self._stream = connection.makefile("rw", encoding="utf-8")
            try:
                yield
            finally:
                self._say()
                self._stream = None

    def quit(self) -> None:
        """Tell that the user wants the run to end."""
        with self.open():
            self._say(quit=True)

    def write(self, text: str) -> int:
        """Keep text until something is asked, or the connection ends."""
        self._text.append(text)
        return len(text)

    def readline(self, size: int | None = -1, /) -> str:  # type: ignore[override]
        """Return the line that the user enters; "" when nobody answers."""
        text, newline, prompt = "".join(self._text).rpartition("\n")
        self._text = [text + newline]
        self._say(prompt=prompt)
        with suppress(OSError, ValueError):
            if self._stream is not None and (answer := self._stream.readline()):
                return str(json.loads(answer)["line"])
        return ""

    def _say(self, **message: Any) -> None:
        text, self._text = "".join(self._text), []
        if self._stream is not None and (text or message):
            with suppress(OSError):
                self._stream.write(json.dumps({"text": text, **message}) + "\n")
                self._stream.flush()
