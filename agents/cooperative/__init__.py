"""The cooperative positioning program: decentralized cooperative map matching, one vehicle's part of it.

`agents.cooperative:main` is the program's entry; it is imported when it is first used, so that its mathematics
(`agents.cooperative.cmm`) can be had without it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from vnet.errors import ProgramError
from vnet.extras import require

if TYPE_CHECKING:
    from agents.cooperative.program import main as main

__all__ = ["main"]
DECLARES = "agents.cooperative.declared"


def __getattr__(name: str) -> Any:
    """Return the program."""
    if name != "main":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    require("program.entry = 'agents.cooperative:main'", "scipy", "osqp", error=ProgramError)
    return import_module("agents.cooperative.program").main
