"""Modules of which each program has its own, and how `sys.modules` has them, for what finds a module by its name.

`pickle` finds classes so, and `pydantic` and others the names of annotations. What stands here in `sys.modules` is,
to the code of a program, that program's own module, and to all other code what was there before.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any


def facade(real: ModuleType, parts: Mapping[str, Callable[[], Any]] = {}, /, **own: Any) -> ModuleType:
    """Return a module in which some names are others; `parts` load modules below it that are a program's own."""
    module = ModuleType(real.__name__, real.__doc__)
    names = {
        name: value
        for name, value in vars(real).items()
        if (not name.startswith("__") or name == "__all__") and name not in parts
    }

    def find(name: str) -> Any:
        return parts[name]() if name in parts else getattr(real, name)

    vars(module).update(names, __getattr__=find, **own)
    return module


class _Proxy(ModuleType):
    """Stands for the modules of one name."""

    def __getattribute__(self, attribute: str) -> Any:
        name = object.__getattribute__(self, "__name__")
        entry = _shown.get(name)
        module = None if entry is None else entry.present(name) or entry.real
        if module is None:
            raise AttributeError(f"module {name!r} is a program's, and none runs")
        return getattr(module, attribute)


@dataclass
class _Entry:
    """A name that is shown."""

    proxy: ModuleType
    real: ModuleType | None
    """The shared module of that name, which was there before."""
    present: Callable[[str], ModuleType | None]
    """Returns the module of the program whose code runs, if one does."""
    programs: int = 0


_shown: dict[str, _Entry] = {}


def show(name: str, present: Callable[[str], ModuleType | None]) -> None:
    """Have a module of a program found by its name, where its code runs, until `hide`."""
    entry = _shown.get(name)
    if entry is None:
        entry = _shown[name] = _Entry(_Proxy(name), sys.modules.get(name), present)
        sys.modules[name] = entry.proxy
    entry.programs += 1


def hide(name: str) -> None:
    """Take back what one program has shown; the last one leaves `sys.modules` as it was before."""
    entry = _shown[name]
    entry.programs -= 1
    if entry.programs:
        return
    del _shown[name]
    if sys.modules.get(name) is entry.proxy:
        if entry.real is None:
            del sys.modules[name]
        else:
            sys.modules[name] = entry.real


def import_shared(name: str) -> ModuleType:
    """Import a module that all programs share; it finds shared modules alone while it is loaded."""
    if name in sys.modules and name not in _shown:
        return importlib.import_module(name)
    hidden = [(each, entry) for each, entry in _shown.items() if sys.modules.get(each) is entry.proxy]
    for each, entry in hidden:
        if entry.real is None:
            del sys.modules[each]
        else:
            sys.modules[each] = entry.real
    try:
        return importlib.import_module(name)
    finally:
        for each, entry in hidden:
            if sys.modules.get(each) in (None, entry.real):
                sys.modules[each] = entry.proxy
