"""Arrays from untrusted NPZ files."""

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
    """Return the arrays of an NPZ file that are among `names`. Raise ScenarioError if one is larger than allowed.

    No more memory is allocated than the file has content for.
    """
    arrays = {}
    try:
        with zipfile.ZipFile(path) as archive:
            members = set(archive.namelist())
            for name in names:
                if f"{name}.npy" in members:
                    _check_size(archive, f"{name}.npy", largest_bytes)
                    with archive.open(f"{name}.npy") as member:
                        arrays[name] = np.lib.format.read_array(member, allow_pickle=False)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:  # zipfile, zlib and numpy raise a dozen types for a bad file
        raise ScenarioError(f"{path}: not an NPZ file: {printable(str(error), 300)}") from None
    return arrays


def _check_size(archive: zipfile.ZipFile, name: str, largest_bytes: int) -> None:
    """Raise ValueError if an array is larger than allowed, or its header claims more than its content."""
    size = archive.getinfo(name).file_size
    if size > largest_bytes:
        raise ValueError(f"{name}: {size:,} bytes; at most {largest_bytes:,} are allowed")
    with archive.open(name) as member:
        version = np.lib.format.read_magic(member)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, kind = read(member)
    if math.prod(shape) * kind.itemsize > size:
        raise ValueError(f"{name}: {shape} of {kind} in {size:,} bytes")
