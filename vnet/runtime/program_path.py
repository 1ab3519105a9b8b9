"""The folders in which a process looks for the modules of programs, after all that is installed."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable
from pathlib import Path

_added: list[str] = []
"""The folders that were added last: those of another run give way."""


def search_programs_in(folders: Iterable[Path]) -> None:
    """Have modules looked for in `folders`, in this order, and then in the current one.

    They come last on `sys.path`, so that they shadow nothing. Folders of an earlier call are looked in no more.
    """
    sys.path[:] = [path for path in sys.path if path not in _added]
    wanted = dict.fromkeys(str(folder) for folder in [*folders, Path.cwd()])
    _added[:] = [path for path in wanted if path not in sys.path]
    sys.path.extend(_added)
    importlib.invalidate_caches()
