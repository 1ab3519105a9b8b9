"""The cooperative positioning program: decentralized cooperative map matching, one vehicle's part of it.

`agents.cooperative:main` is the program's entry; it is imported when it is first used, so that its mathematics
(`agents.cooperative.cmm`) can be had without it. So are the `libraries` that only some of its options need:
processes that are forked have them from the one that asked for all names of `__all__`.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from vnet.errors import ProgramError
from vnet.extras import require

if TYPE_CHECKING:
    from agents.cooperative.program import main as main

    libraries: Sequence[ModuleType]

__all__ = ["libraries", "main"]
DECLARES = "agents.cooperative.declared"


def __getattr__(name: str) -> Any:
    """Return the program, or the libraries that it imports when it first uses them."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    require("program.entry = 'agents.cooperative:main'", "scipy", "osqp", error=ProgramError)
    if name == "libraries":
        return [import_module(library) for library in ("osqp", "scipy.sparse", "scipy.special")]
    return import_module("agents.cooperative.program").main
