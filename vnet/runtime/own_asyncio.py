"""Tasks and futures of vnet's loops, and what stands in for names of Python and numpy while programs run.

asyncio's own tasks and futures hash by their address, which decides the order of a set of them: the children of a
task group, what `asyncio.wait` returns. Those of vnet's loops hash by a number of their node's. It depends on what
the node did before, and on nothing else: not on which other nodes share its loop.

Programs also make tasks and futures past their loop, and ask for all tasks of it. So while programs run, some names
of the package `asyncio` are others. On other loops of the same process all of them do what asyncio's own do.

A node travels with asyncio's contexts into tasks, callbacks and jobs (`current_node`). A program may run code in a
context of its own, which does not have the variable. So a loop in virtual time knows by itself to which node the
callback belongs that runs.

**Chance.** The functions of `random` and `numpy.random` that share a generator, and what asks `os.urandom` for
bytes (`secrets`, `uuid.uuid4`, generators without a seed), draw from generators of the node whose code runs on a
loop. They have the seed of `node.rng`, and are other streams. A module that is imported meanwhile draws from
generators of its own: nodes that share a process share it, and the one that imports it first may be another there.
All other code draws as ever.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextvars
import faulthandler
import gc
import importlib
import inspect
import logging
import os
import random
import signal
import sys
import tempfile
import threading
from abc import ABCMeta
from collections.abc import Callable, Iterable, Mapping
from contextvars import Context
from functools import wraps
from itertools import count
from types import FrameType, FunctionType, ModuleType
from typing import TYPE_CHECKING, Any, cast
from weakref import WeakKeyDictionary

import numpy as np

from vnet.runtime import asyncio_internals
from vnet.runtime.own_packages import names_of, users_file

if TYPE_CHECKING:
    from vnet.node import Node

current_node: contextvars.ContextVar[Node | None] = contextvars.ContextVar("vnet_node", default=None)
"""A node, in one of its incarnations; None outside programs."""
NOBODY = contextvars.Context()
"""Context of callbacks that vnet itself sets while programs run."""
NOBODY.run(current_node.set, None)

_SEED_BYTES = 16
_system_bytes, _seed, _system_entropy = os.urandom, random.Random.seed, os.getrandom
_python_state, _numpy_state = random._inst, np.random.mtrand._rand
_set_threshold, _signal, _basic_config = gc.set_threshold, signal.signal, logging.basicConfig
_watch_later, _remove_handler = faulthandler.dump_traceback_later, logging.Logger.removeHandler
_OTHER_NAMES = {"ranf": "random_sample", "sample": "random_sample", "seed": "seed"}
"""Functions of `numpy.random` that are no methods of its generator, and the methods that they call."""


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


class Numbered:
    """An object that hashes by a number of the present node, which is given when it is first asked for."""

    def __hash__(self) -> int:
        if "_vnet_number" not in vars(self):
            self._vnet_number = _next_number(present_node())
        return self._vnet_number


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
"""Name, its own value, and the one while programs run."""


class Chance:
    """Generators in place of the system's random bytes, and of the shared ones of `random` and `numpy.random`."""

    def __init__(self, seed: int | str) -> None:
        self.system = random.Random(f"system {seed}")
        self.python = random.Random(f"python {seed}")
        words = random.Random(f"numpy {seed}").getrandbits(128)
        self.numpy = np.random.RandomState(np.random.MT19937(words))


_chances: WeakKeyDictionary[Node | ModuleType, Chance] = WeakKeyDictionary()
_imports: Mapping[str, Any] = importlib._bootstrap._module_locks  # type: ignore[attr-defined]
"""Modules that are being imported, in any thread."""
_CALLBACK = asyncio.Handle._run.__code__


def chance_of(owner: Node | ModuleType) -> Chance:
    """Return the generators of a node, or of a module that is imported."""
    chance = _chances.get(owner)
    if chance is None:
        seed = owner.__name__ if isinstance(owner, ModuleType) else owner.seed
        chance = _chances[owner] = Chance(seed)
    return chance


def _drawing() -> Chance | None:
    """Return the generators of what draws; None in threads, whose order nothing decides, and in child processes."""
    node = None if asyncio._get_running_loop() is None else present_node()
    return None if node is None else chance_of((_imports and _imported_module()) or node)


def _imported_module() -> ModuleType | None:
    """Return the module of this process that runs because the present callback imports it; None if none does."""
    frame: FrameType | None = sys._getframe()
    while frame is not None and frame.f_code is not _CALLBACK:
        name = frame.f_globals.get("__name__", "") if frame.f_code.co_name == "<module>" else ""
        module = sys.modules.get(name)
        if module is not None and vars(module) is frame.f_globals and module.__name__ != "__main__":
            return module
        frame = frame.f_back
    return None


def _random_bytes(size: int, /) -> bytes:
    chance = _drawing()
    return _system_bytes(size) if chance is None else chance.system.randbytes(size)


def _entropy(size: int, flags: int = 0) -> bytes:
    return _system_entropy(size, flags) if _drawing() is None else _random_bytes(size)


def _seeded(generator: random.Random, a: Any = None, version: int = 2) -> None:
    if a is None and _drawing() is not None:
        a = _random_bytes(_SEED_BYTES)
    _seed(generator, a, version)


def _drawer(own: Callable[..., Any], module: ModuleType, name: str, kind: str) -> Callable[..., Any]:
    """Return a function of a module that draws by its node's generator of this kind, or as ever."""
    method_name = _OTHER_NAMES.get(name, name) if kind == "numpy" else name

    @wraps(own)
    def draw(*arguments: Any, **options: Any) -> Any:
        chance = _drawing()
        method = own if chance is None else getattr(getattr(chance, kind), method_name)
        return method(*arguments, **options)

    draw.__module__, draw.__qualname__ = module.__name__, own.__name__  # for pickle
    return draw


class _SharedState:
    """The generator of `numpy.random`, which scipy draws from without its functions: that of the present node."""

    __class__: Any = np.random.RandomState
    _own: Any = _numpy_state
    _kind, _name = "numpy", "_shared_numpy"

    def __getattr__(self, name: str) -> Any:
        chance = _drawing()
        return getattr(self._own if chance is None else getattr(chance, self._kind), name)

    def __reduce__(self) -> str:
        """Be the same object in a copy, and in a pickle."""
        return self._name


class _SharedPythonState(_SharedState):
    """The generator of `random`, which networkx draws from, likewise."""

    __class__: Any = random.Random
    _own = _python_state
    _kind, _name = "python", "_shared_python"


_shared_numpy, _shared_python = _SharedState(), _SharedPythonState()


class _Nobodys(random.Random):
    """A generator that the whole process shares, as that of names in `tempfile`: its seed is no node's."""

    def seed(self, a: Any = None, version: int = 2) -> None:
        """Seed from the system, unless there is a seed."""
        _seed(self, int.from_bytes(_system_bytes(_SEED_BYTES)) if a is None else a, version)


def _configure_logging(**options: Any) -> None:
    """Configure logging as if vnet had no handler; it stays."""
    root = logging.getLogger()
    ours = list(filter(_is_vnets, root.handlers))
    for handler in ours:
        _remove_handler(root, handler)
    try:
        _basic_config(**options)
    finally:
        for handler in ours:
            root.addHandler(handler)


def _is_vnets(handler: logging.Handler) -> bool:
    return getattr(handler, "is_vnets", False)


def _handler_removed(logger: logging.Logger, hdlr: logging.Handler) -> None:
    """Remove a handler, but for vnet's if a program asks, as `logging.config` does of all."""
    if present_node() is None or not _is_vnets(hdlr):
        _remove_handler(logger, hdlr)


def _signal_set(number: int, handler: Any) -> Any:
    """Set a handler; of a program in another thread than the main one, as in a test, nothing, and no error."""
    if _drawing() is None or threading.current_thread() is threading.main_thread():
        return _signal(number, handler)
    return signal.getsignal(number)


_is_watched = False
"""True if a program has armed a watchdog."""


def _watched_later(*arguments: Any, **options: Any) -> None:
    """Arm a watchdog; that of a program ends with the programs, and not what vnet does after them."""
    global _is_watched
    _is_watched = _is_watched or present_node() is not None
    _watch_later(*arguments, **options)


def _threshold_set(*thresholds: int) -> None:
    """Leave it to a loop in virtual time when garbage is collected, where its program asks."""
    if _drawing() is None or not hasattr(asyncio._get_running_loop(), "start_at"):
        _set_threshold(*thresholds)


def _of_chance() -> list[tuple[Any, str, Any, Any]]:
    found: list[tuple[Any, str, Any, Any]] = [
        (os, "urandom", _system_bytes, _random_bytes),
        (os, "getrandom", _system_entropy, _entropy),
        (random, "_urandom", _system_bytes, _random_bytes),  # asked by `secrets`, and by numpy for its seeds
        (random.Random, "seed", _seed, _seeded),
        (np.random.mtrand, "_rand", _numpy_state, _shared_numpy),
        (random, "_inst", _python_state, _shared_python),
        (tempfile, "_Random", random.Random, _Nobodys),
    ]
    for module, kind in (random, "python"), (np.random, "numpy"), (np.random.mtrand, "numpy"):
        shared = _python_state if module is random else _numpy_state
        for name, own in vars(module).items():
            if getattr(own, "__self__", None) is shared or (kind == "numpy" and name in _OTHER_NAMES):
                found.append((module, name, own, _drawer(own, module, name, kind)))
    return found


_STAND_INS: list[tuple[Any, str, Any, Any]] = [
    *((module, *each) for module in (asyncio, asyncio.futures, asyncio.tasks) for each in STAND_INS),
    *_of_chance(),
    (gc, "set_threshold", _set_threshold, _threshold_set),
    (signal, "signal", _signal, _signal_set),
    (faulthandler, "dump_traceback_later", _watch_later, _watched_later),
    (logging, "basicConfig", _basic_config, _configure_logging),
    (logging.Logger, "removeHandler", _remove_handler, _handler_removed),
]
_OTHER = {id(own): other for owner, _, own, other in _STAND_INS if owner is not tempfile}
"""Stand-ins by the identity of what they stand for, under whatever name; `random.Random` stays itself."""
_lock = threading.Lock()
_users = 0


def attach() -> None:
    """Let these stand in for the names, in all threads; each call is followed by one of `detach`."""
    global _users
    with _lock:
        _users += 1
        _set_names(own=False)
        _use_in_modules()
        asyncio_internals.hash_gatherings_by(number_of)


def detach() -> None:
    """Give the names their own values back when no programs run any more."""
    global _users, _is_watched
    with _lock:
        _users -= 1
        if _users == 0:
            _set_names(own=True)
            if _is_watched:
                faulthandler.cancel_dump_traceback_later()
            _is_watched = False


def _set_names(own: bool) -> None:
    """Set the names, but for those that somebody else has set."""
    for owner, name, *both in _STAND_INS:
        present = vars(owner).get(name)
        if present is both[0] or present is both[1]:
            setattr(owner, name, both[0 if own else 1])


def use_stand_ins(function: Callable[..., Any]) -> None:
    """Let the module of a program use these where it has imported names by `from … import` before they were set."""
    _use_in(function.__globals__ if isinstance(function, FunctionType) else {})


def _use_in(names: dict[str, Any]) -> None:
    for name, value in list(names.items()):
        if (other := _OTHER.get(id(value))) is not None:
            names[name] = other


_seen: set[str] = set()


def _use_in_modules() -> None:
    """Let modules of the user's that were imported before, as a test's may be, and scipy's generators use these."""
    for name in sys.modules.keys() - _seen:
        _seen.add(name)
        names = names_of(name)
        if name.startswith("scipy.stats."):
            for value in names.values():
                if getattr(value, "__dict__", {}).get("_random_state") is _numpy_state:
                    value._random_state = _shared_numpy
        elif users_file(name) is not None:
            _use_in(names)
