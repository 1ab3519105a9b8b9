"""Former place of the estimators' mathematics, `agents.cooperative.cmm`; it goes with the next version."""

from importlib import import_module
from typing import Any
from warnings import warn


def __getattr__(name: str) -> Any:
    """Return a public name of `agents.cooperative.cmm`."""
    if name.startswith("__") and name != "__all__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module("agents.cooperative.cmm"), name)
    warn(f"vnet.cmm moved: import {name} from agents.cooperative.cmm", DeprecationWarning, stacklevel=2)
    return found
