"""vnet's own top-level packages, and files of a user's that bear the names of others.

Of two modules of one name a process imports one: whichever is found first hides the other. These functions name the
file for the one line of an error.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.machinery import EXTENSION_SUFFIXES, ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

from vnet.runtime.error_text import NOT_THE_PROGRAM

OWN = ("agents", "emulator", "vnet")
INSTALLED = {"site-packages", "dist-packages"}
"""Folders of installed packages, of whatever interpreter."""
ROOT = Path(__file__).resolve().parents[2]
"""The folder that holds vnet's own packages."""


def foreign_on_path(package: str, path: Sequence[str] | None = None) -> str:
    """Name what `path` (default: `sys.path`) has in place of one of vnet's own packages; "" if nothing."""
    if package not in OWN:
        return ""
    found = _file_of(PathFinder.find_spec(package, path))
    if found is None or found.parent == ROOT / package:
        return ""
    return f"{package}: found {found}, which is not vnet's package of this name: rename it"


def _file_of(spec: ModuleSpec | None) -> Path | None:
    if spec is None:
        return None
    folders = list(spec.submodule_search_locations or ())
    file = spec.origin or (f"{folders[0]}/__init__.py" if folders else None)
    return None if file is None else Path(file).resolve()


def name_clash(module: str, folder: Path) -> str:
    """Name the file in `folder` that is not imported because another of its name is found first; "" if none.

    Either something else has been found in place of vnet's own package, or vnet's own, Python's or an installed
    module hides the one in `folder`.
    """
    package = module.partition(".")[0]
    if foreign := foreign_on_path(package):
        return foreign
    for file in (folder / f"{package}.py", folder / package / "__init__.py"):
        if not file.exists():
            continue
        hider = _hider(package, file)
        return f"{hider}: rename {file}" if hider else ""
    return ""


def names_of(name: str) -> dict[str, Any]:
    """Return what a module of this process defines, without loading one that is lazy."""
    module = sys.modules.get(name)
    return object.__getattribute__(module, "__dict__") if issubclass(type(module), ModuleType) else {}


def users_file(name: str) -> Path | None:
    """Return the file of a module of this process; None if it is vnet's, Python's or installed, or has none."""
    file = names_of(name).get("__file__")
    if not isinstance(file, str) or file.startswith(NOT_THE_PROGRAM) or name.partition(".")[0] in OWN:
        return None
    return None if INSTALLED.intersection(Path(file).parts) else Path(file).resolve()


def is_compiled(file: str | Path | None) -> bool:
    """Return whether a module's file is no Python source."""
    return file is not None and str(file).endswith(tuple(EXTENSION_SUFFIXES))


def another_file(module: ModuleType) -> Path | None:
    """Return the file that would be imported by this name now, if it is not that of the module of a process."""
    own = getattr(module, "__file__", None)
    if own is None or "." in module.__name__:
        return None
    found = _file_of(PathFinder.find_spec(module.__name__))
    return None if found == Path(own).resolve() else found


def _hider(package: str, file: Path) -> str:
    """Say what `import package` finds in place of `file`; "" if it finds the file."""
    if package in OWN:
        return "" if file.resolve().parent == ROOT / package else f"{package} is a package of vnet's own"
    if package in sys.builtin_module_names:
        return f"{package} is a module of Python's own"
    found = _file_of(PathFinder.find_spec(package))
    if found is None or found == file.resolve():
        return ""
    return f"{package} is found at {found}"
