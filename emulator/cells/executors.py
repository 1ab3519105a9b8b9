"""Executors of cells: the processes of this machine, any `concurrent.futures.Executor`, Dask's workers."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from emulator.cells.worker import Place, Worker, WorkerDiedError, call_fitly, modules_of
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

    def call(self, place: Place, function: Callable[..., T], *args: Any, limit_s: float | None = None) -> T:
        """Return what the function returns in a worker process of the calling thread."""
        return self._worker(place).call(function, *args, limit_s=limit_s)

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


def each_done(
    jobs: Sequence[J], function: Callable[[J], R], executor: Executor | None = None, most: int | None = None
) -> Iterator[tuple[J, R]]:
    """Yield each job with its result as they are done, on `executor` or in `most` processes of this machine.

    A job whose worker dies is run again. Raises VnetError that names the first job that cannot be done; what has
    not begun is then cancelled.
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
        return pool.submit(call_fitly, places[key], function, job)

    waiting: dict[Future[R], tuple[J, int]] = {}
    try:
        waiting |= {submit(job): (job, 1) for job in jobs}
        while waiting:
            done, _ = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                job, tries = waiting.pop(future)
                try:
                    yield job, future.result()
                except BrokenExecutor:
                    raise VnetError(
                        f"cell {dict(job.labels)}: the executor is broken; run it again to go on"
                    ) from None
                except Exception as error:
                    if not worker_died(error):
                        raise
                    if tries == MOST_TRIES:
                        raise VnetError(f"cell {dict(job.labels)}: {error}, {tries} times") from None
                    waiting[submit(job)] = job, tries + 1
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
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(title, total=total, completed=done)
        yield lambda: progress.advance(task)


@contextmanager
def open_executor(address: str | None) -> Iterator[Executor | None]:
    """Yield the executor that an address names, `dask://host:port`; None for None. Raises VnetError."""
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
        yield client.get_executor(pure=False)
