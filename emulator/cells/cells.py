"""The cells of an experiment: one run each, many at once, never the same one twice.

A cell is a scenario and its labels in a table. A run leaves its metrics, period by period, and a few figures. The
file of a finished cell is named by the digest of its scenario and of the code: an experiment that was interrupted
goes on where it stopped, and a cell whose scenario or program has changed runs again.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from emulator.drivers.attachment import LiveOptions
from emulator.drivers.emulation import Emulation
from emulator.drivers.join import split_into_processes
from emulator.drivers.live import run_live
from emulator.drivers.simulate import simulate
from emulator.records.atomic import atomically, write_atomically
from emulator.records.code_digest import digests_of, entries_of
from emulator.records.divergence import first_divergences
from emulator.records.reported import reported_figures
from emulator.records.run_folder import RunFolder
from emulator.scenario.scenario import Scenario, dump_scenario
from emulator.world.world import build_world
from vnet.errors import VnetError
from vnet.transport.access import Access
from vnet.transport.session import quiet_zenoh
from vnet.types import Array

FORMAT = 1
_code_digests = cache(digests_of)


@dataclass(frozen=True)
class Cell:
    """One run: its `labels` in the table, its scenario, and from when on it counts."""

    labels: Mapping[str, str | int | float]
    scenario: Scenario
    from_s: float = 0.0
    keeps_states: bool = False
    """True if every vehicle's state in every period is kept too."""

    @property
    def digest(self) -> str:
        """Names the cell's files: everything that its result depends on."""
        code = _code_digests(entries_of(self.scenario))
        text = json.dumps([FORMAT, code, self.from_s, dump_scenario(self.scenario)])
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def run_cells(
    cells: Sequence[Cell], folder: Path, live: bool = False, title: str = "cells"
) -> list[dict[str, Any]]:
    """Run what is not there yet, with a progress bar; returns labels and figures of all cells, in their order.

    Simulated cells run on all cores; live ones one after the other, because each starts a process a vehicle.
    Raises VnetError if a cell cannot be run: those that are finished stay.
    """
    store = folder / ("live" if live else "cells")
    store.mkdir(parents=True, exist_ok=True)
    missing = {cell.digest: cell for cell in cells if not _result_path(store, cell).exists()}
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(title, total=len(cells), completed=len(cells) - len(missing))
        for _ in _run_all(list(missing.values()), store, live):
            progress.advance(task)
    return [dict(cell.labels) | json.loads(_result_path(store, cell).read_text()) for cell in cells]


def read_series(cell: Cell, folder: Path) -> pa.Table:
    """The metrics of a finished cell, a row a period."""
    return pq.read_table(folder / "cells" / f"{cell.digest}.parquet")


def read_states(cell: Cell, folder: Path) -> pa.Table:
    """The states of a finished cell that keeps them, a row for each vehicle and period."""
    return pq.read_table(_states_path(folder / "cells", cell))


def has_result(cell: Cell, folder: Path) -> bool:
    """Return whether a cell has been simulated."""
    return _result_path(folder / "cells", cell).exists()


def has_states(cell: Cell, folder: Path) -> bool:
    """Return whether a cell has been simulated and its states kept."""
    return _states_path(folder / "cells", cell).exists()


def write_results(results: Sequence[dict[str, Any]], folder: Path, name: str) -> Path:
    """All cells as one Parquet file."""
    path = folder / f"{name}.parquet"
    pq.write_table(pa.Table.from_pylist(list(results)), path)
    return path


def _result_path(store: Path, cell: Cell) -> Path:
    return store / f"{cell.digest}.json"


def _states_path(store: Path, cell: Cell) -> Path:
    return store / f"{cell.digest}.states.parquet"


def _run_all(cells: list[Cell], store: Path, live: bool) -> Iterator[Cell]:
    """Yields each cell as it is finished."""
    if live:
        for cell in cells:
            run_cell(cell, store, live=True)
            yield cell
        return
    pool = ProcessPoolExecutor(max_workers=os.cpu_count())
    try:
        futures = {pool.submit(run_cell, cell, store): cell for cell in cells}
        for future in as_completed(futures):
            try:
                future.result()
            except BrokenProcessPool:
                raise VnetError("a process of the experiment was killed; run it again to go on") from None
            yield futures[future]
    finally:
        pool.shutdown(cancel_futures=True)


def run_cell(cell: Cell, store: Path, live: bool = False) -> None:
    """Run one cell and keep its metrics and figures in `store`; both are put in place in one step."""
    scenario = cell.scenario
    with tempfile.TemporaryDirectory(prefix="vnet-cell-") as name:
        folder = RunFolder.create(Path(name) / "run", scenario)
        emulation = Emulation(scenario, build_world(scenario), folder)
        if live:
            quiet_zenoh()
            groups = split_into_processes(emulation.world.node_ids, scenario.run.nodes_per_process)
            options = LiveOptions(Access.create(scenario.run.name, groups))
            _, interrupted = asyncio.run(run_live(emulation, options, lambda state: None))
        else:
            _, interrupted = simulate(emulation)
        if interrupted:
            raise KeyboardInterrupt
        broken = [e for e in folder.events if e.kind in ("died", "crashed", "spun", "stalled")]
        if broken:
            event = broken[0]
            raise VnetError(f"cell {cell.labels}: {event.node} {event.kind}: {event.details.get('error', '')}")
    figures = measure(emulation, cell.from_s)
    with atomically(store / f"{cell.digest}.parquet") as part:
        pq.write_table(emulation.metrics.metrics_table(), part)
    if cell.keeps_states:
        with atomically(_states_path(store, cell)) as part:
            pq.write_table(emulation.metrics.states_table(), part)
    write_atomically(_result_path(store, cell), json.dumps(figures))


def measure(emulation: Emulation, from_s: float) -> dict[str, Any]:
    """Figures of a run from `from_s` on: roots of mean squares over the periods, in metres.

    Of the common error at the end of the period (`rmse_m`, `deviation_m`, by component), right after stacking
    (`stacked_…`), of positions; means of the consistency figures; `divergent` vehicles (MODEL 6); bytes a period.
    """
    rows = [row for row in emulation.metrics.rows if row.time_ns >= from_s * 1e9]

    def rms(name: str) -> float | None:
        values = [getattr(row, name) for row in rows if getattr(row, name) is not None]
        return float(np.sqrt(np.mean(np.square(values)))) if values else None

    def mean(name: str) -> float | None:
        values = [getattr(row, name) for row in rows if getattr(row, name) is not None]
        return float(np.mean(values)) if values else None

    states = emulation.metrics.states_table()
    return {
        "rmse_m": rms("common_error_rmse_m"),
        "deviation_m": rms("deviation_m"),
        "bias_m": rms("bias_m"),
        "stacked_rmse_m": rms("stacked_rmse_m"),
        "stacked_deviation_m": rms("stacked_deviation_m"),
        "component_rmse_m": _rms_columns([row.component_rmse_m for row in rows]),
        "position_rmse_m": rms("position_rmse_m"),
        "fix_rmse_m": rms("fix_rmse_m"),
        "consensus_error_m": rms("consensus_error_m"),
        "common_error_anees": mean("common_error_anees"),
        "position_anees": mean("position_anees"),
        "divergent": _divergent(states, len(emulation.world.node_ids), emulation.world.period_ns),
        "bytes": _mean_value(states, "bytes"),
        "not_finite": sum(row.not_finite for row in rows),
        "metrics_sha256": emulation.metrics.sha256(),
    }


def _rms_columns(rows: list[list[float | None]]) -> list[float]:
    """Root mean square of each column; none where vehicles move and the number of components changes."""
    if len({len(row) for row in rows}) > 1:
        return []
    table = np.array([[np.nan if value is None else value for value in row] for row in rows], dtype=float)
    return [float(value) for value in np.sqrt(np.mean(table**2, axis=0))]


def _points(states: pa.Table, name: str) -> Array:
    return np.array([(np.nan, np.nan) if p is None else p for p in states[name].to_pylist()], dtype=float)


def _divergent(states: pa.Table, vehicles: int, period_ns: int) -> int:
    """The number of vehicles that diverged at any time."""
    error_m = np.hypot(*(_points(states, "common_error_estimate_m") - _points(states, "common_error_m")).T)
    return len(first_divergences(error_m.reshape(-1, vehicles), period_ns))


def _mean_value(states: pa.Table, name: str) -> float | None:
    figure = reported_figures(states).get(name)
    return None if figure is None else figure.mean
