"""emulator: everything that vehicles live in. It stands on vnet and never imports agents.

Its public names are those of `__all__`; they are imported when they are first used, because commands import this
package too and must start fast. It imports nothing itself: until `vnet` runs, Ctrl-C prints a traceback.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from emulator.api import Run, run, simulate
    from emulator.cells.sweep import sweep
    from emulator.checks.own import Result
    from emulator.learning.environment import environment, radio_for
    from emulator.learning.episode import Moment
    from emulator.radio.own_rules import Answer, RadioFrame
    from emulator.world.own_sensors import SensedTruth

__all__ = [
    "Answer",
    "Moment",
    "RadioFrame",
    "Result",
    "Run",
    "SensedTruth",
    "environment",
    "radio_for",
    "run",
    "simulate",
    "sweep",
]

_PUBLIC = {
    "Answer": "emulator.radio.own_rules",
    "Moment": "emulator.learning.episode",
    "RadioFrame": "emulator.radio.own_rules",
    "Result": "emulator.checks.own",
    "Run": "emulator.api",
    "SensedTruth": "emulator.world.own_sensors",
    "environment": "emulator.learning.environment",
    "radio_for": "emulator.learning.environment",
    "run": "emulator.api",
    "simulate": "emulator.api",
    "sweep": "emulator.cells.sweep",
}
"""Modules of the public names."""


def __getattr__(name: str) -> Any:
    """Return a public name."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'emulator' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted([*globals(), *__all__])
