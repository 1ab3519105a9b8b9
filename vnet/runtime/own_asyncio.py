"""Tasks and futures of vnet's loops, and what stands in for parts of asyncio while programs run (`stand_ins`).

asyncio's own tasks and futures hash by their address, which decides the order of a set of them: the children of a
task group, what `asyncio.wait` returns. Those of vnet's loops hash by a number of their node's. It depends on what
the node did before, and on nothing else: not on which other nodes share its loop.

Programs also make tasks and futures past their loop, and ask for all tasks of it. So while programs run, some names
of the package `asyncio` are others. On other loops of the same process all of them do what asyncio's own do.

A node travels with asyncio's contexts into tasks, callbacks and jobs (`current_node`). A program may run code in a
context of its own, which does not have the variable. So a loop in virtual time knows by itself to which node the
callback belongs that runs.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextvars
import inspect
from abc import ABCMeta
from collections.abc import Iterable
from contextvars import Context
from itertools import count
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from vnet.node import Node


current_node: contextvars.ContextVar[Node | None] = contextvars.ContextVar("vnet_node", default=None)
"""A node, in one of its incarnations; None outside programs."""
NOBODY = contextvars.Context()
"""Context of callbacks that vnet itself sets while programs run."""
NOBODY.run(current_node.set, None)


def present_node() -> Node | None:
    """Return the node on whose behalf the present code runs, whatever its context."""
    node: Node | None = getattr(asyncio._get_running_loop(), "running_node", None)
    return current_node.get() if node is None else node


_STANDS_FOR: dict[type, type] = {}
_numbers_of_nobody = count()


class _StandIn(ABCMeta):
    """Metaclass of classes that stand for asyncio's: what is an instance of asyncio's is one of these."""

    def __instancecheck__(cls, instance: Any) -> bool:
        own = _STANDS_FOR.get(cls)
        return super().__instancecheck__(instance) if own is None else isinstance(instance, own)

    def __subclasscheck__(cls, subclass: type) -> bool:
        own = _STANDS_FOR.get(cls)
        return super().__subclasscheck__(subclass) if own is None else issubclass(subclass, own)


def _runs_programs(loop: object) -> bool:
    return hasattr(loop, "on_task")


def _next_number(node: Node | None) -> int:
    return next(_numbers_of_nobody if node is None else node._hashes)


def number_of(future: asyncio.Future[Any]) -> int:
    """Return the hash of a future, which is given when it is first asked for."""
    try:
        return cast(int, future._vnet_number)  # type: ignore[attr-defined]
    except AttributeError:
        number = _next_number(present_node()) if _runs_programs(future.get_loop()) else object.__hash__(future)
        future._vnet_number = number  # type: ignore[attr-defined]
        return number


class Future(asyncio.Future[Any], metaclass=_StandIn):
    """A future that tells its loop when it fails; `job_context` is that of the executor job whose result it is."""

    job_context: Context | None = None
    __hash__ = number_of

    def set_exception(self, exception: type | BaseException, /) -> None:
        """Mark the future as failed."""
        super().set_exception(exception)
        loop = self.get_loop()
        if _runs_programs(loop):
            loop.on_failed(self)  # type: ignore[attr-defined]


class Task(asyncio.Task[Any], metaclass=_StandIn):
    """A task of the node whose code makes it, whatever its context; it tells its loop that it is there."""

    node: Node | None = None
    __hash__ = number_of

    def __init__(self, coro: Any, **options: Any) -> None:
        loop = options.get("loop") or asyncio.get_running_loop()
        if _runs_programs(loop):
            context = options.get("context")
            self.node = present_node()
            if self.node is None and context is not None:
                self.node = context.get(current_node)
            loop.check_owner(self.node)  # type: ignore[union-attr]
            self._vnet_number = _next_number(self.node)
            if self.node is not None and options.get("name") is None:
                options["name"] = f"Task-{next(self.node._task_names)}"
        super().__init__(coro, **options)
        if _runs_programs(loop):
            loop.on_task(self)  # type: ignore[union-attr]


_STANDS_FOR.update({Future: asyncio.Future, Task: asyncio.Task})
_all_tasks, _as_completed, _wrap_future = asyncio.all_tasks, asyncio.as_completed, asyncio.wrap_future


def all_tasks(loop: asyncio.AbstractEventLoop | None = None) -> set[asyncio.Task[Any]]:
    """Return the pending tasks of a loop, of those that belong to programs only the present node's."""
    loop = asyncio.get_running_loop() if loop is None else loop
    tasks = _all_tasks(loop)
    node = present_node()
    if node is None or not _runs_programs(loop):
        return tasks
    own = sorted((each for each in tasks if getattr(each, "node", node) is node), key=hash)
    return set(own)


def as_completed(fs: Iterable[Any], *, timeout: float | None = None) -> Any:
    """Do as asyncio's, which makes tasks of coroutines in the order of their addresses; here in the order given."""
    if present_node() is not None and not inspect.isawaitable(fs):
        fs = [asyncio.ensure_future(each) for each in dict.fromkeys(fs)]
    return _as_completed(fs, timeout=timeout)


def wrap_future(future: Any, *, loop: asyncio.AbstractEventLoop | None = None) -> asyncio.Future[Any]:
    """Do as asyncio's; but refuse a future of `concurrent.futures` where time is emulated: a thread ends it."""
    running = asyncio._get_running_loop() if loop is None else loop
    if isinstance(future, concurrent.futures.Future) and hasattr(running, "running_node"):
        raise RuntimeError(
            "asyncio.wrap_future(): in lockstep nothing says at which emulated time another thread ends a future; "
            'use loop.run_in_executor(executor, function, *arguments), or run.pacing = "realtime"'
        )
    return _wrap_future(future, loop=loop)


STAND_INS: list[tuple[str, Any, Any]] = [
    ("Future", asyncio.Future, Future),
    ("Task", asyncio.Task, Task),
    ("all_tasks", _all_tasks, all_tasks),
    ("as_completed", _as_completed, as_completed),
    ("wrap_future", _wrap_future, wrap_future),
]
"""Name, its own value, and the one while programs run (`stand_ins`)."""
