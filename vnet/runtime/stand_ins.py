"""Stand-ins for names of Python and numpy while programs run: of asyncio, and of what draws without a seed.

**Chance.** The functions of `random` and `numpy.random` that share a generator, and what asks `os.urandom` for
bytes (`secrets`, `uuid.uuid4`, generators without a seed), draw from generators of the node whose code runs on a
loop. They have the seed of `node.rng`, and are other streams. All other code draws as ever.
"""

from __future__ import annotations

import asyncio
import os
import random
import tempfile
import threading
from collections.abc import Callable
from functools import wraps
from types import FunctionType, ModuleType
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np

from vnet.runtime import asyncio_internals, own_asyncio
from vnet.runtime.own_asyncio import present_node

if TYPE_CHECKING:
    from vnet.node import Node

_SEED_BYTES = 16
_system_bytes, _seed = os.urandom, random.Random.seed
_numpy_state = np.random.mtrand._rand
_OTHER_NAMES = {"ranf": "random_sample", "sample": "random_sample", "seed": "seed"}
"""Functions of `numpy.random` that are no methods of its generator, and the methods that they call."""


class Chance:
    """Generators in place of the system's random bytes, and of the shared ones of `random` and `numpy.random`."""

    def __init__(self, seed: int) -> None:
        self.system = random.Random(f"system {seed}")
        self.python = random.Random(f"python {seed}")
        words = random.Random(f"numpy {seed}").getrandbits(128)
        self.numpy = np.random.RandomState(np.random.MT19937(words))


_chances: WeakKeyDictionary[Node, Chance] = WeakKeyDictionary()


def chance_of(node: Node) -> Chance:
    """Return a node's generators."""
    chance = _chances.get(node)
    if chance is None:
        chance = _chances[node] = Chance(node.seed)
    return chance


def _drawing_node() -> Node | None:
    """Return the node whose code draws; None in threads, whose order nothing decides, and in child processes."""
    return None if asyncio._get_running_loop() is None else present_node()


def _random_bytes(size: int, /) -> bytes:
    node = _drawing_node()
    return _system_bytes(size) if node is None else chance_of(node).system.randbytes(size)


def _seeded(generator: random.Random, a: Any = None, version: int = 2) -> None:
    if a is None and _drawing_node() is not None:
        a = _random_bytes(_SEED_BYTES)
    _seed(generator, a, version)


def _drawing(own: Callable[..., Any], module: ModuleType, name: str, kind: str) -> Callable[..., Any]:
    """Return a function of a module that draws by its node's generator of this kind, or as ever."""
    method_name = _OTHER_NAMES.get(name, name)

    @wraps(own)
    def draw(*arguments: Any, **options: Any) -> Any:
        node = _drawing_node()
        method = own if node is None else getattr(getattr(chance_of(node), kind), method_name)
        return method(*arguments, **options)

    draw.__module__, draw.__qualname__ = module.__name__, own.__name__  # for pickle
    return draw


class _SharedState:
    """The generator of `numpy.random`, which scipy draws from without its functions: that of the present node."""

    __class__ = np.random.RandomState  # type: ignore[assignment]

    def __getattr__(self, name: str) -> Any:
        node = _drawing_node()
        return getattr(_numpy_state if node is None else chance_of(node).numpy, name)

    def __reduce__(self) -> str:
        """Be the same object in a copy, and in a pickle."""
        return "_shared_state"


_shared_state = _SharedState()


def _of_chance() -> list[tuple[Any, str, Any, Any]]:
    found: list[tuple[Any, str, Any, Any]] = [
        (os, "urandom", _system_bytes, _random_bytes),
        (random, "_urandom", _system_bytes, _random_bytes),  # asked by `secrets`, and by numpy for its seeds
        (random.Random, "seed", _seed, _seeded),
        (np.random.mtrand, "_rand", _numpy_state, _shared_state),
    ]
    for module, kind in (random, "python"), (np.random, "numpy"):
        shared = random._inst if module is random else _numpy_state
        for name, own in vars(module).items():
            if getattr(own, "__self__", None) is shared or (kind == "numpy" and name in _OTHER_NAMES):
                found.append((module, name, own, _drawing(own, module, name, kind)))
    return found


def _settle_shared() -> None:
    """Have what a whole process shares draw its seed now, and not from the first node that needs it."""
    next(tempfile._get_candidate_names())  # type: ignore[attr-defined]


_STAND_INS: list[tuple[Any, str, Any, Any]] = [
    *((module, *each) for module in (asyncio, asyncio.futures, asyncio.tasks) for each in own_asyncio.STAND_INS),
    *_of_chance(),
]
_OTHER = {id(own): other for _, _, own, other in _STAND_INS}
_lock = threading.Lock()
_users = 0


def attach() -> None:
    """Let these stand in for the names, in all threads; each call is followed by one of `detach`."""
    global _users
    with _lock:
        _settle_shared()
        _users += 1
        _set_names(own=False)
        asyncio_internals.hash_gatherings_by(own_asyncio.number_of)


def detach() -> None:
    """Give the names their own values back when no programs run any more."""
    global _users
    with _lock:
        _users -= 1
        if _users == 0:
            _set_names(own=True)


def _set_names(own: bool) -> None:
    """Set the names, but for those that somebody else has set."""
    for owner, name, *both in _STAND_INS:
        present = vars(owner).get(name)
        if present is both[0] or present is both[1]:
            setattr(owner, name, both[0 if own else 1])


def use_stand_ins(function: Callable[..., Any]) -> None:
    """Let the module of a program use these where it has imported names by `from … import` before they were set."""
    names = function.__globals__ if isinstance(function, FunctionType) else {}
    for name, value in list(names.items()):
        names[name] = _OTHER.get(id(value), value)
