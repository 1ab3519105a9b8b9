"""The cells of a study: one run each, many at once, never the same one twice, on any executor of cells.

A cell is a scenario and its labels in a table. A run leaves its metrics, period by period, and its figures. The
file of a finished cell is named by the digest of its scenario and of the code: a study that was interrupted goes on
where it stopped, and a cell whose scenario or program has changed runs again. Results come back to whoever asked,
and are written there, aside and then renamed: a cell that runs twice, or is killed, does no harm.

Executors are the processes of this machine, any `concurrent.futures.Executor`, and Dask's workers.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from emulator.cells.worker import (
    Place,
    Worker,
    WorkerDiedError,
    WorkerTimeoutError,
    call_fitly,
    modules_of,
    temporary_prefix,
)
from emulator.checks.own import PREFIX
from emulator.drivers.emulation import Emulation
from emulator.drivers.session import Local, Session, over_zenoh
from emulator.drivers.signals import terminated_as_interrupted
from emulator.drivers.simulate import MOST_APART
from emulator.records.code_digest import digests_of
from emulator.records.disk import atomically, disk_errors, write_atomically
from emulator.records.events import Level
from emulator.records.run_folder import is_run_folder
from emulator.scenario.loading import dump_scenario
from emulator.scenario.scenario import Scenario
from vnet.errors import VnetError
from vnet.extras import require

R = TypeVar("R")
T = TypeVar("T")
MOST_TRIES = 3
"""Tries of a job whose worker is killed: a machine may be short of memory, or the job what kills it."""
DASK = "dask://"
DASK_PATIENCE_S = 10.0
"""Seconds for which a Dask scheduler is called."""
FORMAT = 3
WALL_CLOCK = ("wall_s", "real_time_factor")
"""Figures that the machine decides: they differ from run to run."""
Measure = Callable[[Emulation, float], tuple[dict[str, Any], pa.Table]]
"""A function of a module: figures of a run from some second on, and its metrics."""
_code_digests = cache(digests_of)


class Job(Protocol):
    """Work with a scenario, and labels by which messages name it."""

    @property
    def scenario(self) -> Scenario:
        """The scenario, which says what programs are needed."""

    @property
    def labels(self) -> Any:
        """Names of values, for messages."""


J = TypeVar("J", bound=Job)


class WorkerPool(Executor):
    """Worker processes of this machine, each kept for many calls; `close` ends them in the midst of a call."""

    def __init__(self, size: int | None = None) -> None:
        self._threads = ThreadPoolExecutor(size or os.cpu_count() or 1, thread_name_prefix="vnet worker")
        self._local = threading.local()
        self._workers: list[Worker] = []
        self._lock = threading.Lock()
        self._closed = False

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Run `call_fitly`, or any other function, on a thread of the pool; the former in that thread's process."""
        if fn is call_fitly:
            return self._threads.submit(self.call, *args, **kwargs)
        return self._threads.submit(fn, *args, **kwargs)

    def call(self, place: Place, function: Callable[..., T], *args: Any, **limits: Any) -> T:
        """Return what the function returns in a worker of the calling thread; limits are those of `call_fitly`."""
        return self._worker(place).call(function, *args, **limits)

    def _worker(self, place: Place) -> Worker:
        worker: Worker | None = getattr(self._local, "worker", None)
        if worker is not None and worker.is_alive and worker.place == place:
            return worker
        with self._lock:
            if self._closed:
                raise WorkerDiedError("its process was closed")
            if worker is not None:
                worker.close()
                self._workers.remove(worker)
            worker = self._local.worker = Worker(place)
            self._workers.append(worker)
        return worker

    def close(self) -> None:
        """End all processes, whatever they do; no call that is on returns."""
        with self._lock:
            self._closed = True
            for worker in self._workers:
                worker.close()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for all calls, and end all processes; with `cancel_futures` those that are on end too."""
        if cancel_futures:
            self.close()
        self._threads.shutdown(wait, cancel_futures=cancel_futures)
        self.close()


BROKEN = (BrokenExecutor, CancelledError)
"""Errors of an executor that does no further job: Dask cancels all once its scheduler is gone."""


def each_done(
    jobs: Sequence[J],
    function: Callable[[J], R],
    executor: Executor | None = None,
    most: int | None = None,
    last: Callable[[J], J] = lambda job: job,
) -> Iterator[tuple[J, R]]:
    """Yield each job with its result as they are done, on `executor` or in `most` processes of this machine.

    A job whose worker dies is run again, at last as `last` changes it; so is one that stalls. Raises VnetError that
    names the first job that cannot be done; what has not begun is then cancelled.
    """
    if not jobs:
        return
    own = WorkerPool(min(most or os.cpu_count() or 1, len(jobs))) if executor is None else None
    pool = executor or own
    assert pool is not None
    places: dict[object, Place] = {}

    def submit(job: J) -> Future[R]:
        key = modules_of(job.scenario), job.scenario.program.folders
        if key not in places:
            places[key] = Place.here(job.scenario)
        stall_limit_s = job.scenario.run.stall_timeout_s
        return pool.submit(call_fitly, places[key], function, job, stall_limit_s=stall_limit_s)

    waiting: dict[Future[R], tuple[J, int]] = {}
    try:
        waiting |= {submit(job): (job, 1) for job in jobs}
        while waiting:
            done, _ = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                job, tries = waiting.pop(future)
                try:
                    yield job, future.result()
                except BROKEN:
                    raise VnetError(
                        f"cell {dict(job.labels)}: the executor is broken; run it again to go on"
                    ) from None
                except Exception as error:
                    stalled = isinstance(error, WorkerTimeoutError)
                    if not stalled and not worker_died(error):
                        raise
                    if tries == MOST_TRIES:
                        times = "" if stalled else f", {tries} times"
                        raise VnetError(f"cell {dict(job.labels)}: {error}{times}") from None
                    tries = MOST_TRIES if stalled else tries + 1
                    waiting[submit(last(job) if tries == MOST_TRIES else job)] = job, tries
    finally:
        for future in waiting:
            future.cancel()
        if own is not None:
            own.shutdown(cancel_futures=True)


def worker_died(error: Exception) -> bool:
    """Return whether it is the worker that failed, and not the job. Dask's error is known by its name alone."""
    return isinstance(error, WorkerDiedError) or type(error).__name__ == "KilledWorker"


@contextmanager
def progress_bar(title: str, total: int, done: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar on standard error; yields what moves it on by one."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True, force_jupyter=False)) as progress:  # which has no widgets
        task = progress.add_task(title, total=total, completed=done)
        yield lambda: progress.advance(task)


@contextmanager
def open_executor(address: str | None, say: Callable[[str], object] = print) -> Iterator[Executor | None]:
    """Yield the executor that an address names, `dask://host:port`; None for None. Raises VnetError.

    `say` is given what a user should know: that the scheduler has no worker.
    """
    if address is None:
        yield None
        return
    host = address.removeprefix(DASK)
    if not address.startswith(DASK) or not host.rpartition(":")[2].isdecimal():
        raise VnetError(f"--executor {address}: write it as dask://HOST:PORT, the address of a Dask scheduler")
    require(f"--executor {address}", "distributed")
    from distributed import Client  # slow to import, and an extra

    try:
        client = Client(f"tcp://{host}", timeout=f"{DASK_PATIENCE_S}s", set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise VnetError(f"--executor {address}: no Dask scheduler answers: {error}") from None
    with client:
        if not client.nthreads():
            say(f"--executor {address}: the scheduler has no worker yet; the runs wait for one")
        yield client.get_executor(pure=False)


@dataclass(frozen=True)
class Cell:
    """One run: its `labels` in the table, its scenario, and from when on it counts."""

    labels: Mapping[str, Any]
    scenario: Scenario
    from_s: float = 0.0
    keeps_states: bool = False
    """True if every vehicle's state in every period is kept too."""
    measure: Measure | None = None
    """Gives an experiment's figures, which a crash ends; without one they are those of the run's verdict."""
    apart: bool = False
    """True for a process a vehicle: one that ends or stalls its process does so to nothing else."""

    @property
    def digest(self) -> str:
        """Names the cell's files: everything that its result depends on."""
        measure = () if self.measure is None else (f"{self.measure.__module__}:{self.measure.__name__}",)
        code = _code_digests((*modules_of(self.scenario), *measure), self.scenario.program.folders)
        text = json.dumps([FORMAT, code, self.from_s, *measure, dump_scenario(self.scenario)])
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class CellResult:
    """Result of the run of a cell: its figures, its metrics, and its states if they are kept."""

    figures: dict[str, Any]
    metrics: pa.Table
    states: pa.Table | None


def run_cells(
    cells: Sequence[Cell],
    folder: Path,
    live: bool = False,
    title: str = "cells",
    executor: Executor | None = None,
    jobs: int | None = None,
) -> list[dict[str, Any]]:
    """Run what is not there yet, with a progress bar; returns labels and figures of all cells, in their order.

    Simulated cells run on `executor`, or in `jobs` processes of this machine (default: as many as it has cores);
    live ones one after the other, because each starts a process a vehicle. Raises VnetError if a cell cannot be
    run or the folder is that of a run, and KeyboardInterrupt after Ctrl-C or SIGTERM: those that are finished stay.
    """
    if is_run_folder(folder):
        raise VnetError(f"{folder}: this is a run's folder, which is for that run alone")
    store = folder / ("live" if live else "cells")
    with disk_errors(store):
        store.mkdir(parents=True, exist_ok=True)
    _code_digests.cache_clear()  # in a notebook a program may have been edited since
    missing = {cell.digest: cell for cell in cells if not _result_path(store, cell).exists()}
    with terminated_as_interrupted(), progress_bar(title, len(cells), len(cells) - len(missing)) as advance:
        if live:
            for cell in missing.values():
                keep(cell, compute(cell, live=True), store)
                advance()
        else:
            left = list(missing.values())
            for cell, result in each_done(left, compute, executor, jobs, partial(replace, apart=True)):
                keep(cell, result, store)
                advance()
    return [read_result(cell, folder, live) for cell in cells]


def compute(cell: Cell, live: bool = False) -> CellResult:
    """Run one cell in this process. Raises VnetError that names the cell if it cannot be run."""
    with tempfile.TemporaryDirectory(prefix=temporary_prefix(os.getpid())) as name:
        try:
            return _compute(cell, Path(name) / "run", live)
        except VnetError as error:
            raise VnetError(f"cell {dict(cell.labels)}: {error}") from None


def _compute(cell: Cell, path: Path, live: bool) -> CellResult:
    session = Session(cell.scenario, path, over_zenoh if live else Local(MOST_APART if cell.apart else 1)).open()
    session.run()
    if session.interrupted:
        raise KeyboardInterrupt
    emulation = session.emulation
    if cell.measure is None:
        _, verdict = session.close()
        if unkept := session.folder.unkept:  # the disk is to blame: the cell is not finished
            raise VnetError(unkept[0])
        figures, metrics = judged_figures(verdict), emulation.metrics.metrics_table()
    else:
        _ = emulation.metrics.rows  # figures that fail are an event
        if broken := [event for event in session.folder.events if event.level is Level.FAILURE]:
            event = broken[0]
            raise VnetError(f"{event.node} {event.kind}: {event.details.get('error', '')}")
        figures, metrics = cell.measure(emulation, cell.from_s)
    states = emulation.metrics.states_table() if cell.keeps_states else None
    return CellResult(figures, metrics, states)


def judged_figures(verdict: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of a judged run as one flat row.

    `failed`: the names of the checks with the run's verdict, unless it is valid; `failure`: what the first of them
    saw; `frames_OUTCOME`: receptions by outcome; `packet_delivery_ratio`; all of vnet's figures by name; of each
    value that programs report the mean over all reports by its name, and as `last.NAME` the mean over the vehicles
    of their last one; of own checks each number by `own:NAME.FIGURE`. Texts and rows are left out.
    """
    frames = verdict["frames_by_outcome"]
    broken = [check for check in verdict["checks"] if check["verdict"] == verdict["verdict"] != "valid"]
    broken.sort(key=lambda check: check["name"] != "progress")  # what cut a run explains what else it lacks
    row = {
        "verdict": verdict["verdict"],
        "failed": ", ".join(check["name"] for check in broken),
        "failure": broken[0]["text"] if broken else "",
        "vehicles": verdict["vehicles"],
        "emulated_s": verdict["emulated_s"],
        "packet_delivery_ratio": verdict["packet_delivery_ratio"],
        **{f"frames_{outcome}": count for outcome, count in frames.items()},
        **verdict["figures"],
        "trace_sha256": verdict["trace_sha256"],
        "metrics_sha256": verdict["metrics_sha256"],
        **{name: verdict[name] for name in WALL_CLOCK},
    }
    for name, figure in verdict["reported"].items():
        if figure["mean"] is not None:
            row[name if name not in row else f"reported.{name}"] = figure["mean"]
            row[f"last.{name}"] = figure["last"]
    for check in verdict["checks"]:
        if check["name"].startswith(PREFIX):
            figures = check.get("figures", {}).items()
            row |= {f"{check['name']}.{key}": value for key, value in figures if isinstance(value, int | float)}
    return row


# Results.


def keep(cell: Cell, result: CellResult, store: Path) -> None:
    """Write a result into a folder's `cells`; the figures last, because they say that all is there."""
    with atomically(store / f"{cell.digest}.parquet") as part:
        pq.write_table(result.metrics, part)
    if result.states is not None:
        with atomically(_states_path(store, cell)) as part:
            pq.write_table(result.states, part)
    write_atomically(_result_path(store, cell), json.dumps(result.figures))


def read_result(cell: Cell, folder: Path, live: bool = False) -> dict[str, Any]:
    """Labels and figures of a finished cell; a figure of a label's name is `reported.NAME`.

    Raises VnetError for a file that is no result.
    """
    path = _result_path(folder / ("live" if live else "cells"), cell)
    try:
        figures: dict[str, Any] = json.loads(path.read_text())
        named = {f"reported.{name}" if name in cell.labels else name: value for name, value in figures.items()}
        return {**cell.labels, **named}
    except (OSError, ValueError, AttributeError) as error:
        raise VnetError(f"{path}: not the result of a cell: {error}; remove it to run the cell again") from None


def read_series(cell: Cell, folder: Path) -> pa.Table:
    """The metrics of a finished cell, a row a period."""
    return pq.read_table((folder / "cells" / f"{cell.digest}.parquet").absolute())


def read_states(cell: Cell, folder: Path) -> pa.Table:
    """The states of a finished cell that keeps them, a row for each vehicle and period."""
    return pq.read_table(_states_path(folder / "cells", cell).absolute())


def has_result(cell: Cell, folder: Path) -> bool:
    """Return whether a cell has been simulated."""
    return _result_path(folder / "cells", cell).exists()


def has_states(cell: Cell, folder: Path) -> bool:
    """Return whether a cell has been simulated and its states kept."""
    return _states_path(folder / "cells", cell).exists()


def write_results(results: Sequence[dict[str, Any]], folder: Path, name: str) -> Path:
    """All cells as one Parquet file."""
    path = folder / f"{name}.parquet"
    with atomically(path) as part:
        pq.write_table(pa.Table.from_pylist(list(results)), part)
    return path


def _result_path(store: Path, cell: Cell) -> Path:
    return store / f"{cell.digest}.json"


def _states_path(store: Path, cell: Cell) -> Path:
    return store / f"{cell.digest}.states.parquet"
