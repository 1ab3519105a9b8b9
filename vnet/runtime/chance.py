"""Chance of programs: what they draw without a seed of their own has one of their node's.

While programs run, the functions of `random` and `numpy.random` that share a generator, and whatever asks the
system for random bytes (`os.urandom`, `secrets`, `uuid.uuid4`, generators without a seed), draw from generators of
the node on whose behalf the code runs. They have the seed of `node.rng`, and are other streams. All other code of
the process draws as ever.
"""

from __future__ import annotations

import os
import random
import tempfile
from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np

from vnet.runtime.own_asyncio import present_node

if TYPE_CHECKING:
    from vnet.node import Node

_SEED_BYTES = 16
_system_bytes, _seed = os.urandom, random.Random.seed


class Chance:
    """Generators in place of the system's random bytes, and of the shared ones of `random` and `numpy.random`."""

    def __init__(self, seed: int | str) -> None:
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


def _begin_child() -> None:
    """Let a child process draw other numbers than its program, as without vnet."""
    for chance in _chances.values():
        chance.__init__(_system_bytes(_SEED_BYTES).hex())  # type: ignore[misc]


os.register_at_fork(after_in_child=_begin_child)


def _random_bytes(size: int, /) -> bytes:
    node = present_node()
    return _system_bytes(size) if node is None else chance_of(node).system.randbytes(size)


def _seeded(generator: random.Random, a: Any = None, version: int = 2) -> None:
    if a is None and present_node() is not None:
        a = _random_bytes(_SEED_BYTES)
    _seed(generator, a, version)


def _drawing(own: Callable[..., Any], name: str, kind: str) -> Callable[..., Any]:
    """Return a function that draws by a method of a node's generator of this kind, or as ever."""

    @wraps(own)
    def draw(*arguments: Any, **options: Any) -> Any:
        node = present_node()
        method = own if node is None else getattr(getattr(chance_of(node), kind), name)
        return method(*arguments, **options)

    return draw


def _stand_ins() -> list[tuple[Any, str, Any, Any]]:
    found: list[tuple[Any, str, Any, Any]] = [
        (os, "urandom", _system_bytes, _random_bytes),
        (random, "_urandom", _system_bytes, _random_bytes),  # asked by `secrets`, and by numpy for its seeds
        (random.Random, "seed", _seed, _seeded),
    ]
    renamed = {"ranf": "random_sample", "sample": "random_sample", "seed": "seed"}
    for module, kind in (random, "python"), (np.random, "numpy"):
        shared = random._inst if module is random else np.random.mtrand._rand
        for name, own in vars(module).items():
            if getattr(own, "__self__", None) is shared:
                found.append((module, name, own, _drawing(own, name, kind)))
            elif module is np.random and name in renamed:
                found.append((module, name, own, _drawing(own, renamed[name], kind)))
    return found


STAND_INS = _stand_ins()
"""Module or class, name, its own value, and the one while programs run."""


def settle_shared() -> None:
    """Have what a whole process shares draw its seed now, and not from the first node that needs it."""
    next(tempfile._get_candidate_names())  # type: ignore[attr-defined]
