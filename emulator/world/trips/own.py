"""Networks of the user's own: trips that a function returns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from emulator.scenario.network import Network
from emulator.scenario.own_functions import in_words, line_of, load_function, outside
from emulator.scenario.program import Program
from emulator.world.trips.samples import MOST_SAMPLES, Samples
from vnet.errors import ScenarioError, shown
from vnet.runtime.programs import search_programs_in

USAGE = "def {}(seed, vehicles, duration_s)"
COLUMNS = ("time_s", "x_m", "y_m", "heading_rad")
"""Numbers of a sample; the heading may be missing."""


def own_samples(network: Network, program: Program, duration_s: float) -> Samples:
    """Return the samples of the vehicles of a network of the user's own, of a run of `duration_s`.

    The function gets the network's seed and number of vehicles, and the run's length. It returns a mapping from ids
    to samples (n, 3) or (n, 4): time from the run's beginning in s, x and y in m, and the heading in rad. Raise
    ScenarioError, with the function's line, if it raises, and for an answer that is none.
    """
    assert network.function is not None
    problem = f"network.kind = {network.function!r}"
    search_programs_in(program.folders)
    function = load_function("network.kind", network.function, program, USAGE)
    try:
        answer = function(network.seed, network.vehicles, duration_s)
    except (Exception, SystemExit) as error:
        where = line_of(outside(error, __file__))
        raise ScenarioError(f"{problem}: {in_words(error)}{f' ({where})' if where else ''}") from error
    if not isinstance(answer, Mapping) or not answer:
        raise ScenarioError(f"{problem}: returns {shown(answer)}: a dict from ids to samples is needed")
    samples, first = Samples(Path(problem), "sample"), 1
    tables = {name: _table(problem, name, rows) for name, rows in answer.items()}
    width = min(table.shape[1] for table in tables.values())
    if sum(map(len, tables.values())) > MOST_SAMPLES:
        raise ScenarioError(f"{problem}: more than {MOST_SAMPLES:,} samples")
    for name, table in tables.items():
        lines = np.arange(first, first + len(table))
        columns = dict(zip(COLUMNS[:width], table.T, strict=False))
        samples.add(pa.array([str(name)] * len(table)), lines, columns)
        first += len(table)
    return samples


def _table(problem: str, name: object, rows: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    try:
        table = np.asarray(rows, dtype=np.float64)
    except (TypeError, ValueError):
        table = np.zeros(0)
    if table.ndim != 2 or table.shape[1] not in (3, 4) or not len(table):
        needed = "rows of time_s, x_m, y_m and, if you like, heading_rad are needed"
        raise ScenarioError(f"{problem}: {shown(name)}: {shown(rows)}: {needed}")
    return table
