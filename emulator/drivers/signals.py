"""Signal handlers of a run: set for as long as it lasts, and afterwards as they were before.

Python gives signals to its main thread alone. On any other thread nothing is set here.
"""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from types import FrameType
from typing import Any

ENDING = (signal.SIGINT, signal.SIGTERM)
"""The signals that end a run early."""


def gets_signals() -> bool:
    """Return whether this thread is the one to which Python gives signals."""
    return threading.current_thread() is threading.main_thread()


@contextmanager
def signals_handled(
    handler: Callable[[int, FrameType | None], Any] | signal.Handlers, *numbers: signal.Signals
) -> Iterator[None]:
    """Handle these signals so within the block; restore what was set before on every way out of it."""
    if not gets_signals():
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items():
            # None: a handler that Python has not set, and cannot set again.
            signal.signal(number, signal.SIG_DFL if earlier is None else earlier)


@contextmanager
def terminated_as_interrupted() -> Iterator[None]:
    """Have SIGTERM raise KeyboardInterrupt within the block, as Ctrl-C does, where it would end this process."""
    is_deadly = gets_signals() and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    with signals_handled(signal.default_int_handler, *([signal.SIGTERM] if is_deadly else [])):
        yield


@asynccontextmanager
async def cancelled_by_signals() -> AsyncIterator[None]:
    """Let the first Ctrl-C or SIGTERM cancel the task that runs the block; any further one changes nothing.

    Set with `signal.signal`: `loop.add_signal_handler` could not give back a handler of the caller's loop.
    """
    loop = asyncio.get_running_loop()
    task = asyncio.current_task()
    assert task is not None
    interrupted = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted
        if not interrupted:
            interrupted = True
            loop.call_soon_threadsafe(task.cancel)  # which wakes the loop, unlike a call of cancel itself

    with signals_handled(interrupt, *ENDING):
        yield


@contextmanager
def first_interrupt_told(tell: Callable[[], None]) -> Iterator[Callable[[], bool]]:
    """Tell of the block's first Ctrl-C or SIGTERM, and go on; at the second raise KeyboardInterrupt.

    The block gets a function that returns whether there was one.
    """
    told = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal told
        if told:
            raise KeyboardInterrupt
        told = True
        tell_from_handler(tell)

    with signals_handled(interrupt, *ENDING):
        yield lambda: told


def tell_from_handler(tell: Callable[[], None]) -> None:
    """Tell on another thread: a handler may have interrupted one that holds the lock of what is printed to."""
    threading.Thread(target=tell, daemon=True).start()


@contextmanager
def signals_ignored() -> Iterator[Callable[[], None]]:
    """Ignore Ctrl-C and SIGTERM within the block, but where a run in it handles them: records are kept.

    The block gets a function for the run to call as soon as it does: it sends the first one of before again.
    """
    came: list[int] = []

    def send_again() -> None:
        for number in came[:1]:
            signal.raise_signal(number)

    with signals_handled(lambda number, frame: came.append(number), *ENDING):
        yield send_again
