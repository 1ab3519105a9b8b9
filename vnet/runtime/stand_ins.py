"""What stands in for names of Python's and numpy's while programs run: of asyncio, and of chance."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from types import FunctionType
from typing import Any

from vnet.runtime import asyncio_internals, chance, own_asyncio

_STAND_INS: list[tuple[Any, str, Any, Any]] = [
    *((module, *each) for module in (asyncio, asyncio.futures, asyncio.tasks) for each in own_asyncio.STAND_INS),
    *chance.STAND_INS,
]
_OTHER = {id(own): other for _, _, own, other in _STAND_INS}
_lock = threading.Lock()
_users = 0


def attach() -> None:
    """Let these stand in for the names, in all threads; each call is followed by one of `detach`."""
    global _users
    with _lock:
        if _users == 0:
            chance.settle_shared()
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
