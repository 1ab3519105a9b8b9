"""Exceptions of programs that the event loop never sees: in threads that a program starts, and in `__del__`.

Python hands them to `threading.excepthook` and `sys.unraisablehook`, which print them. While hosts run programs,
these hooks first ask for the node on whose behalf the code runs, and give the exception to whoever watches that
node. What belongs to no node is printed as before, and so is what the garbage collector finds: when it runs depends
on the process, and nothing that a run says may.
"""

from __future__ import annotations

import gc
import sys
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any

from vnet.node import Node
from vnet.runtime import current_node, own_asyncio

Taker = Callable[[Node, BaseException, str], bool]
"""Takes an exception of a node and the place where it was raised; returns False if it is not to be taken."""


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
        """True in the thread that collects, while it does."""
        return self._thread == threading.get_ident()


collector = _Collector()
MOST_UNCOLLECTED = 2_000_000
"""Objects that programs may make, less those that are freed, before Python collects garbage when it likes: a
program that makes so many between two instants needs the memory."""
_lock = threading.Lock()
_schedules = 0
_before_schedules: tuple[tuple[int, int, int], bool] = (gc.get_threshold(), False)
_takers: weakref.WeakKeyDictionary[Node, weakref.WeakMethod[Taker]] = weakref.WeakKeyDictionary()
_started_by: weakref.WeakKeyDictionary[threading.Thread, Node] = weakref.WeakKeyDictionary()
_watchers = 0
_before: tuple[Any, Any] = (sys.unraisablehook, threading.excepthook)
_start_thread = threading.Thread.start


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
            freezes = gc.get_freeze_count() == 0
            _before_schedules = gc.get_threshold(), freezes
            if freezes:
                gc.freeze()
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
    owner = present_node()
    if owner is not None:
        _started_by[thread] = owner
    _start_thread(thread)


def present_node() -> Node | None:
    """Return the node on whose behalf the present code runs: that of its callback, its context, or its thread."""
    return current_node.present_node() or _started_by.get(threading.current_thread())


def _unraisable(ignored: sys.UnraisableHookArgs) -> None:
    error = ignored.exc_value or ignored.exc_type()
    name = getattr(ignored.object, "__name__", "")
    if collector.runs or not _taken(present_node(), error, f"in {name}" if name else "where Python ignores it"):
        _before[0](ignored)


def _thread_failed(failed: threading.ExceptHookArgs) -> None:
    owner = None if failed.thread is None else _started_by.get(failed.thread)
    if not _taken(owner, failed.exc_value or failed.exc_type(), "in a thread"):
        _before[1](failed)


def _taken(owner: Node | None, error: BaseException, place: str) -> bool:
    reference = None if owner is None else _takers.get(owner)
    taker = None if reference is None else reference()
    if owner is None or taker is None or isinstance(error, KeyboardInterrupt | SystemExit):
        return False
    return taker(owner, error, place)
