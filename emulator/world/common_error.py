"""The GNSS error that all vehicles share: drawn, or read from a file of recorded errors."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from emulator.scenario.random_streams import stream
from emulator.scenario.scenario import Scenario
from emulator.scenario.sections import WILD_M
from emulator.world.csv_file import open_csv
from vnet.errors import ScenarioError, shown
from vnet.types import Array
from vnet.units import NS_PER_S

MOST_ROWS = 1_000_000
"""Most rows of a file: a day of ten a second has fewer."""
LONGEST_LINE = 10_000
"""Characters of a line of the file."""
FARTHEST_M = 100 * WILD_M
"""Largest recorded error."""
_COMPONENT = re.compile(r"(.+_|)(?:east|north)_m")


@dataclass(frozen=True)
class CommonErrors:
    """The common error `common_m` (K, 2) at the start of each period, in metres.

    `receiver_m` (K, R, 2) is what each of a file's receivers has beyond it; None without several. Vehicle n has
    that of receiver n mod R.
    """

    common_m: Array
    receiver_m: Array | None = None


def common_errors(scenario: Scenario, periods: int) -> CommonErrors:
    """Return the common error of a run. Raise ScenarioError for a file that cannot be used."""
    common = scenario.world.common_error
    if common.path is None:
        error_m = gauss_markov(scenario, "common error", (common.sigma_m, common.tau_s), (periods, 2))
        return CommonErrors(error_m)
    time_s, error_m = _read(common.path)
    start_s = time_s[0] if common.start_s is None else common.start_s
    at_s = start_s + np.arange(periods) * scenario.period_ns / NS_PER_S
    if start_s < time_s[0] or at_s[-1] > time_s[-1]:
        raise ScenarioError(
            f"{common.path}: has errors from {time_s[0]:.10g} to {time_s[-1]:.10g} s; "
            f"the run needs them from {start_s:.10g} to {at_s[-1]:.10g} s"
        )
    columns = [np.interp(at_s, time_s, column) for column in error_m.reshape(len(time_s), -1).T]
    recorded_m = np.stack(columns, axis=1).reshape(periods, -1, 2)
    common_m = recorded_m.mean(axis=1)
    return CommonErrors(common_m, recorded_m - common_m[:, None] if recorded_m.shape[1] > 1 else None)


def gauss_markov(
    scenario: Scenario, name: str, law: tuple[float, float], shape: tuple[int, ...], item: int = 0
) -> Array:
    """Return a first-order Gauss-Markov process of `shape` (K, …) that starts in its stationary state.

    `law` is its standard deviation and its correlation time in s; `name` and `item` are those of its random stream.
    """
    sigma, tau_s = law
    normal = stream(scenario.run.seed, name, item).standard_normal(shape)
    keep = math.exp(-scenario.period_ns / NS_PER_S / tau_s)
    process = np.empty_like(normal)
    process[0] = sigma * normal[0]
    added = sigma * math.sqrt(1 - keep**2)
    for k in range(1, len(normal)):
        process[k] = keep * process[k - 1] + added * normal[k]
    return process


def _read(path: Path) -> tuple[Array, Array]:
    """Return times (k,) in s and errors (k, R, 2) in m of each receiver. Raise ScenarioError for a bad file."""
    with open_csv(path, LONGEST_LINE) as lines:
        reader = csv.DictReader(lines)
        columns = _columns(path, reader.fieldnames or ())
        rows = []
        for row in reader:
            rows.append([_number(path, reader.line_num, name, row[name]) for name in columns])
            if len(rows) > MOST_ROWS:
                raise ScenarioError(f"{path}: more than {MOST_ROWS:,} rows")
    if not rows:
        raise ScenarioError(f"{path}: no rows of errors")
    table = np.array(rows)
    late = np.flatnonzero(np.diff(table[:, 0]) <= 0)
    if len(late):
        time_s = table[late[0] + 1, 0]
        raise ScenarioError(f"{path}: time_s = {time_s:.10g} follows {table[late[0], 0]:.10g}: times must increase")
    far = np.abs(table[:, 1:]).max()
    if far > FARTHEST_M:
        raise ScenarioError(f"{path}: an error of {far:g} m; at most {FARTHEST_M:g} m are allowed")
    return table[:, 0], table[:, 1:].reshape(len(table), -1, 2)


def _columns(path: Path, names: object) -> list[str]:
    """Return the columns that are read: time_s, then east and north of each receiver."""
    found = [str(name) for name in names] if isinstance(names, (list, tuple)) else []
    receivers = dict.fromkeys(match[1] for name in found if (match := _COMPONENT.fullmatch(name)))
    columns = ["time_s", *(f"{receiver}{axis}_m" for receiver in receivers for axis in ("east", "north"))]
    missing = [name for name in columns if name not in found] or (["east_m"] if len(columns) == 1 else [])
    if missing:
        raise ScenarioError(
            f"{path}: no column {missing[0]}; time_s, east_m and north_m are needed, or of several receivers "
            "NAME_east_m and NAME_north_m each"
        )
    for name in columns:
        if found.count(name) > 1:
            raise ScenarioError(f"{path}: column {name} is there twice")
    return columns


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    try:
        number = float(text or "")
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ScenarioError(f"{path}: line {line}: {name} = {shown(text)}: a finite number is needed")
    return number
