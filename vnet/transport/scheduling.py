"""Scheduling of a run's threads by Linux: who may preempt whom.

In real time, threads that pass messages on have little work but must run at once; programs compute for
milliseconds, many on one processor. Since Linux 6.12 a thread with a short time slice preempts those with longer
ones as soon as it wakes (EEVDF: `sched_runtime` of sched_setattr(2), without privileges). In lockstep nobody waits
for the wall clock: a thread that is not preempted finds its caches as it left them. On other systems these
functions do nothing.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PROMPT_SLICE_NS = 100_000
"""Time slice of threads that pass messages on: the least that Linux accepts."""
COMPUTING_SLICE_NS = 6_000_000
"""Time slice of programs: longer than their work for a period, so that each is finished before the next starts."""
DEFAULT_SLICE = 0
"""The kernel's default."""

_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
_this_thread = threading.local()
_ATTRIBUTES = struct.Struct("IIQiIQQQ")


def set_time_slice(slice_ns: int) -> bool:
    """Set the time slice in ns of this thread and of those it will start; return false if the kernel refuses."""
    number = _SCHED_SETATTR.get(platform.machine()) if struct.calcsize("P") == 8 else None
    try:
        if number is None or os.uname().sysname != "Linux" or os.sched_getscheduler(0) != os.SCHED_OTHER:
            return False
        nice = os.getpriority(os.PRIO_PROCESS, 0)
    except OSError:
        return False
    attributes = _ATTRIBUTES.pack(_ATTRIBUTES.size, os.SCHED_OTHER, 0, nice, 0, slice_ns, 0, 0)
    refused = ctypes.CDLL(None).syscall(number, 0, ctypes.create_string_buffer(attributes), 0)
    if refused == 0:
        _this_thread.slice_ns = slice_ns
    return bool(refused == 0)


@contextmanager
def default_time_slice() -> Iterator[None]:
    """Set the default time slice within the context, to start processes, which inherit the thread's time slice."""
    former_ns = getattr(_this_thread, "slice_ns", DEFAULT_SLICE)
    set_time_slice(DEFAULT_SLICE)
    try:
        yield
    finally:
        set_time_slice(former_ns)


def never_preempt() -> list[int]:
    """Have no thread of this process, nor those that they will start, preempt others as it wakes (SCHED_BATCH).

    Returns the ids of the threads whose policy this has changed. See sched(7).
    """
    changed: list[int] = []
    if not hasattr(os, "SCHED_BATCH"):
        return changed
    with suppress(OSError):
        for thread in [int(path.name) for path in Path("/proc/self/task").iterdir()]:
            if _set_policy(thread, os.SCHED_OTHER, os.SCHED_BATCH):
                changed.append(thread)
    return changed


@contextmanager
def preempting_nobody() -> Iterator[None]:
    """Have no thread of this process preempt others within the context, as `never_preempt` does."""
    changed = never_preempt()
    try:
        yield
    finally:
        for thread in changed:
            _set_policy(thread, os.SCHED_BATCH, os.SCHED_OTHER)


def _set_policy(thread: int, former: int, policy: int) -> bool:
    """Change the policy of a thread, if it is `former`; return whether it was, and the thread is still there."""
    with suppress(OSError):
        if os.sched_getscheduler(thread) == former:
            os.sched_setscheduler(thread, policy, os.sched_param(0))
            return True
    return False
