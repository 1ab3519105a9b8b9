"""Trips from matrices: NPZ with `lat_deg`, `lon_deg` or `x_m`, `y_m` (N, K), a row for each vehicle, and `rate_hz`.

Column k is the time k / rate_hz. A vehicle is absent where both coordinates are NaN. `id` (N,), `heading_rad` and
`speed_mps` (N, K) are optional; without ids vehicles are v1, v2, …, padded with zeros so that they sort.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from emulator.world.arrays import read_arrays
from emulator.world.trips.samples import DEGREES, METRES, MOST_SAMPLES, OPTIONAL, Samples
from vnet.errors import ScenarioError, printable
from vnet.types import Array

_LARGEST_BYTES = 8 * MOST_SAMPLES + (1 << 20)
"""Largest array that is read."""


def read_npz(path: Path, window_s: tuple[float, float] | None) -> Samples:
    """Return the samples of an NPZ file. Raise ScenarioError, naming the array or the row, for a bad file."""
    arrays = _load(path)
    where = METRES if set(METRES) <= arrays.keys() else DEGREES
    for name in (*where, "rate_hz"):
        if name not in arrays:
            raise ScenarioError(f"{path}: no array {name!r}; needed are rate_hz, and lat_deg, lon_deg or x_m, y_m")
    first, second = (arrays[name] for name in where)
    count, length = _shape(path, where, first, second)
    rate_hz = arrays["rate_hz"]
    if rate_hz.ndim or not 0 < rate_hz <= 10_000:
        raise ScenarioError(f"{path}: rate_hz = {printable(str(rate_hz))}: a number in (0, 10000] is needed")
    time_s = np.arange(length) / float(rate_hz)
    columns = [*where, *(name for name in OPTIONAL if name in arrays)]
    for name in columns:
        if arrays[name].shape != (count, length):
            raise ScenarioError(f"{path}: {name} is {arrays[name].shape}, and {where[0]} {(count, length)}")
    samples = Samples(path, "row", window_s)
    for row, node_id in enumerate(_ids(path, arrays, count)):
        present = ~(np.isnan(first[row]) & np.isnan(second[row]))
        if not present.any():
            continue
        values = {"time_s": time_s[present], **{name: arrays[name][row, present] for name in columns}}
        row_number = np.full(int(present.sum()), row + 1)
        samples.add(pa.array([node_id]).take(pa.array(np.zeros(len(row_number), np.int64))), row_number, values)
    return samples


def _load(path: Path) -> dict[str, NDArray[Any]]:
    arrays = read_arrays(path, (*METRES, *DEGREES, *OPTIONAL, "rate_hz", "id"), _LARGEST_BYTES)
    for name, array in arrays.items():
        if name != "id":
            if array.dtype.kind not in "fiu":
                raise ScenarioError(f"{path}: {name} holds {array.dtype}: numbers are needed")
            arrays[name] = array.astype(float)
    return arrays


def _shape(path: Path, where: tuple[str, str], first: Array, second: Array) -> tuple[int, int]:
    if first.ndim != 2 or first.shape != second.shape or not first.size:
        shapes = f"{where[0]} is {first.shape}, {where[1]} {second.shape}"
        raise ScenarioError(f"{path}: {shapes}: matrices of one shape are needed, a row for each vehicle")
    return first.shape


def _ids(path: Path, arrays: dict[str, NDArray[Any]], count: int) -> list[str]:
    if "id" not in arrays:
        width = len(str(count))
        return [f"v{number:0{width}d}" for number in range(1, count + 1)]
    ids = [str(name) for name in arrays["id"].ravel()]
    if len(ids) != count:
        raise ScenarioError(f"{path}: {len(ids)} ids for {count} rows")
    if len(set(ids)) != count:
        twice = next(name for number, name in enumerate(ids) if name in ids[:number])
        raise ScenarioError(f"{path}: id = {printable(twice)} appears twice; ids must differ")
    return ids
