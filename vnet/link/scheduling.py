"""How the Linux scheduler treats the threads of a run in real time.

Whoever passes messages on has little to do and must do it at once; programs compute for milliseconds, many on one
processor. Since Linux 6.12 a thread with a short time slice preempts those with longer ones as soon as it is
woken (EEVDF: `sched_runtime` of sched_setattr(2), no privilege needed). Elsewhere these calls do nothing.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct

PROMPT_SLICE_NS = 100_000
"""For threads that pass messages on; the least that Linux takes."""
COMPUTING_SLICE_NS = 6_000_000
"""For programs: longer than they take for a period, so that one is done before the next begins."""
DEFAULT_SLICE = 0
"""Whatever the kernel gives."""

_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
_ATTRIBUTES = struct.Struct("IIQiIQQQ")


def set_time_slice(slice_ns: int) -> bool:
    """Ask for this time slice in nanoseconds, for this thread and those that it will start; False if refused."""
    number = _SCHED_SETATTR.get(platform.machine())
    if number is None or os.uname().sysname != "Linux" or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return False
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    attributes = _ATTRIBUTES.pack(_ATTRIBUTES.size, os.SCHED_OTHER, 0, nice, 0, slice_ns, 0, 0)
    refused = ctypes.CDLL(None).syscall(number, 0, ctypes.create_string_buffer(attributes), 0)
    return bool(refused == 0)
