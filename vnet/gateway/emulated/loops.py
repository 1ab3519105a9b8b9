"""Event loops of a program on virtual time: Python's own asyncio, loaded for the program alone.

A loop waits where it asks its selector, in the thread of the program that runs it, as any other call that blocks.
"""

from __future__ import annotations

import signal
import weakref
from collections.abc import Callable
from itertools import count
from typing import Any

from greenlet import GreenletExit

from vnet.gateway.emulated.strands import Lock, Threads, fail
from vnet.runtime.asyncio_internals import abandon_pending, close_abandoned, disclaim, is_unretrieved
from vnet.runtime.outside_loop import collector
from vnet.runtime.virtual_time import VirtualTimeLoop
from vnet.units import NS_PER_S

_WITHOUT_SOCKETS = {name: each for name, each in vars(VirtualTimeLoop).items() if each is VirtualTimeLoop._refuse}
"""Methods that would wait on the world."""


class _Selector:
    """Waits for time, and for other threads of the program: there is no file to wait for."""

    def __init__(self) -> None:
        self._news = Lock()
        self._news.acquire()

    def select(self, timeout: float | None = None) -> list[Any]:
        """Block until `wake`, or for so many seconds; return that no file is ready."""
        if timeout is not None and timeout <= 0:
            self._news.acquire(blocking=False)
        else:
            self._news.acquire(timeout=-1 if timeout is None else timeout)
        return []

    def wake(self) -> None:
        """End what `select` waits for, or the next."""
        self._news.release_if_locked()


def prepare_asyncio(
    module: Any, steady_ns: Callable[[], int], threads: Threads, set_handler: Callable[[int, Any], Any]
) -> None:
    """Have the loops of a program's `asyncio` wait on emulated time, and its futures hash by number.

    By address, which is Python's way, the order of a set of them would be another in each run.
    """

    loops: list[Any] = []

    def close_tasks() -> None:
        for loop in loops:
            for task in abandon_pending([*module.all_tasks(loop)]):
                close_abandoned(task, module)

    threads.close_tasks = close_tasks
    failed: weakref.WeakSet[Any] = weakref.WeakSet()

    def set_exception(self: Any, error: Any) -> None:
        given_exception(self, error)
        failed.add(self)

    def tell_failed() -> None:
        for future in sorted(filter(is_unretrieved, failed), key=number_of):
            if future.get_loop().get_exception_handler() is None:  # else it is told of what fails
                fail(disclaim(future), "in a task or a future of asyncio")

    given_exception, module.Future.set_exception = module.Future.set_exception, set_exception
    threads.tell_failed = tell_failed

    class Loop(module.BaseEventLoop):  # type: ignore[misc]
        def __init__(self, selector: object = None) -> None:
            super().__init__()
            loops.append(self)
            self._selector = _Selector()
            self._write_to_self = self._selector.wake

        def time(self) -> float:
            return steady_ns() / NS_PER_S

        def _process_events(self, events: object) -> None:
            pass

        def default_exception_handler(self, context: dict[str, Any]) -> None:
            error = context.get("exception")
            if threads.are_over or isinstance(error, GreenletExit):
                return
            if isinstance(error, Exception) and not collector.runs:
                fail(error, "in a task or a callback of asyncio")
            else:
                super().default_exception_handler(context)

        def add_signal_handler(self, number: int, callback: Callable[..., object], *args: Any) -> None:
            set_handler(number, lambda *_: self.call_soon_threadsafe(callback, *args))

        def remove_signal_handler(self, number: int) -> bool:
            default = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
            return callable(set_handler(number, default))

    for name, refuse in _WITHOUT_SOCKETS.items():
        setattr(Loop, name, refuse)
    module.unix_events._UnixDefaultEventLoopPolicy._loop_factory = Loop
    module.SelectorEventLoop = module.EventLoop = Loop
    numbers = count()

    def number_of(future: Any) -> int:
        try:
            return int(future._vnet_number)
        except AttributeError:
            future._vnet_number = number = next(numbers)
            return number

    def as_completed(fs: Any, **options: Any) -> Any:
        return given([module.ensure_future(each) for each in dict.fromkeys(fs)], **options)

    module.Future.__hash__ = module.Task.__hash__ = number_of
    given = module.as_completed
    module.as_completed = module.tasks.as_completed = as_completed
