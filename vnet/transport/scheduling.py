"""How the Linux scheduler treats the threads of a run.

Whoever passes messages on has little to do and must do it at once; programs compute for milliseconds, many on one
processor. Since Linux 6.12 a thread with a short time slice preempts those with longer ones as soon as it is
woken (EEVDF: `sched_runtime` of sched_setattr(2), no privilege needed). Elsewhere these calls do nothing.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager

PROMPT_SLICE_NS = 100_000
"""For threads that pass messages on; the least that Linux takes."""
COMPUTING_SLICE_NS = 6_000_000
"""For programs: longer than they take for a period, so that one is done before the next begins."""
DEFAULT_SLICE = 0
"""Whatever the kernel gives."""

_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
_this_thread = threading.local()
_ATTRIBUTES = struct.Struct("IIQiIQQQ")


def set_time_slice(slice_ns: int) -> bool:
    """Ask for this time slice in nanoseconds, for this thread and those that it will start; False if refused."""
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
    """For starting processes, which inherit the time slice of the thread that starts them."""
    former_ns = getattr(_this_thread, "slice_ns", DEFAULT_SLICE)
    set_time_slice(DEFAULT_SLICE)
    try:
        yield
    finally:
        set_time_slice(former_ns)
