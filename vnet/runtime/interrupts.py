"""Ctrl-C while a command begins and ends: it ends with status 130, and prints no traceback.

In between Python's own handler raises KeyboardInterrupt, as asyncio expects.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

exit_now = os._exit

INTERRUPTED = 130
"""Exit status of a command that Ctrl-C has ended, as shells have it for the signal."""


def end_at_once() -> None:
    """Have Ctrl-C end this process at once from now on: it has nothing to close yet.

    Lets through what came while `hold` held it back. Where SIGINT is ignored, as in the background of a shell, it
    stays ignored.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def raise_from_now_on() -> None:
    """Have Ctrl-C raise KeyboardInterrupt again, as Python does by default."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def ended_at_once() -> Iterator[None]:
    """Have Ctrl-C end this process at once within the block, for imports: extension modules hide KeyboardInterrupt.

    Changes nothing where the caller has a handler of its own, or is not the main thread.
    """
    try:
        end_at_once()
    except ValueError:  # not the main thread
        yield
        return
    try:
        yield
    finally:
        raise_from_now_on()


@contextmanager
def ended_by_system() -> Iterator[None]:
    """Have Ctrl-C and SIGTERM end this process at once within the block, also in code that is not Python's.

    There is nothing to close yet. Changes nothing where they are ignored, or outside of the main thread.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handled = {number: handler for number, handler in handlers.items() if handler not in (signal.SIG_IGN, None)}
    for number in handled:
        signal.signal(number, signal.SIG_DFL)
    try:
        yield
    finally:
        for number, handler in handled.items():
            signal.signal(number, handler)


def is_in_foreground() -> bool:
    """Return whether this process may read from its terminal: Ctrl-C there is for its group."""
    try:
        with Path("/dev/tty").open() as terminal:
            return os.tcgetpgrp(terminal.fileno()) == os.getpgrp()
    except OSError:
        return False


def hold() -> None:
    """Hold Ctrl-C back until `end_at_once`, in the program that this process executes next, too."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


def finish(status: int) -> None:
    """Have Ctrl-C end this process with `status` from now on: all is done, but for leaving."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, lambda number, frame: exit_now(status))


def _end(number: int, frame: FrameType | None) -> None:
    exit_now(INTERRUPTED)
