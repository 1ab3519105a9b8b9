"""Disks of vehicles: a private folder of each, made when its program first asks for it."""

from __future__ import annotations

import shutil
import weakref
from pathlib import Path
from tempfile import mkdtemp


class Disks:
    """The folders of nodes: `root/NODE`, or folders that end with this process where `root` is None.

    What lies below `root` is there again after a restart.
    """

    def __init__(self, root: Path | None = None) -> None:
        self._root = None if root is None else root.absolute()

    def of(self, node: str) -> Path:
        """Return the folder of `node`, which exists then. Raises OSError where the disk refuses."""
        if self._root is None:
            self._root = Path(mkdtemp(prefix="vnet-disks-"))
            weakref.finalize(self, shutil.rmtree, self._root, ignore_errors=True)
        folder = self._root / node
        folder.mkdir(parents=True, exist_ok=True)
        return folder
