"""The end of a process that was forked from a zygote.

An interpreter that ends takes all of its objects apart, and so writes to memory that it has shared with the zygote
so far: at the end of a run all agents at once would need several times the memory that they ran in.
"""

from __future__ import annotations

import atexit
import sys
import threading
from collections.abc import Collection
from contextlib import suppress
from typing import NoReturn

from vnet.runtime.process_end import exit_now


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
