"""Arrays from NPZ files that may be anything."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vnet.errors import ScenarioError, printable


def read_arrays(path: Path, names: Iterable[str], largest_bytes: int) -> dict[str, NDArray[Any]]:
    """Those of the arrays `names` that an NPZ file holds. Raises ScenarioError where one is larger than allowed.

    No more memory is taken than the file has content for.
    """
    arrays = {}
    try:
        with zipfile.ZipFile(path) as archive:
            there = set(archive.namelist())
            for name in names:
                if f"{name}.npy" in there:
                    _check_size(archive, f"{name}.npy", largest_bytes)
                    with archive.open(f"{name}.npy") as member:
                        arrays[name] = np.lib.format.read_array(member, allow_pickle=False)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:  # zipfile, zlib and numpy have a dozen ways to say that something is wrong
        raise ScenarioError(f"{path}: not an NPZ file: {printable(str(error), 300)}") from None
    return arrays


def _check_size(archive: zipfile.ZipFile, name: str, largest_bytes: int) -> None:
    """Raises ValueError where an array is larger than what is taken, or than it is."""
    size = archive.getinfo(name).file_size
    if size > largest_bytes:
        raise ValueError(f"{name}: {size:,} bytes; at most {largest_bytes:,} are taken")
    with archive.open(name) as member:
        version = np.lib.format.read_magic(member)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, kind = read(member)
    if math.prod(shape) * kind.itemsize > size:
        raise ValueError(f"{name}: {shape} of {kind} in {size:,} bytes")
