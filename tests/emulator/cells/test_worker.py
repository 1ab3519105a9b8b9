"""Worker processes: fit to run programs, kept for many jobs, and gone with whoever started them."""

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import pytest

from emulator.cells.cells import WorkerPool, each_done, open_executor
from emulator.cells.worker import (
    Place,
    Worker,
    WorkerDiedError,
    WorkerTimeoutError,
    call_fitly,
    is_fit,
    temporary_prefix,
)
from emulator.scenario.scenario import Scenario
from tests.support.paths import ROOT
from vnet.errors import PayloadTooLargeError, ScenarioError, VnetError
from vnet.runtime import running_node

pytestmark = pytest.mark.slow

SCENARIO = Scenario()


@pytest.fixture(scope="module", autouse=True)
def are_started_anew() -> Iterator[None]:
    """Start workers as users do, and not as other tests: with an interpreter of their own."""
    with patch("emulator.cells.worker.subprocess", subprocess):
        yield


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    one = Worker(Place.here(SCENARIO))
    yield one
    one.close()


def refuse(message: str) -> None:
    raise ScenarioError(message)


def send_too_much() -> None:
    raise PayloadTooLargeError(3, 2)


def test_a_worker_is_fit_and_does_many_jobs(worker: Worker) -> None:
    assert worker.call(is_fit)
    assert worker.call(os.getpid) == worker.pid
    assert worker.call(os.getcwd) == str(Path.cwd())
    with pytest.raises(ValueError, match="invalid literal") as raised:
        worker.call(int, "x")
    assert "in a worker process:\nTraceback" in raised.value.__notes__[0]
    with pytest.raises(ScenarioError, match=r"^no$"):
        worker.call(refuse, "no")
    with pytest.raises(VnetError, match=r"PayloadTooLargeError: payload of 3 bytes"):
        worker.call(send_too_much)
    assert worker.call(os.getpid) == worker.pid, "no error ends it"


def start_another(pipe: str, then: Callable[[], None]) -> None:
    """Start a process that keeps a pipe open for writing."""
    subprocess.Popen(["sleep", "1000"], stdout=os.open(pipe, os.O_WRONLY))
    then()


@pytest.mark.parametrize("then", [os.getpid, os.abort])
def test_what_a_job_has_started_ends_with_its_worker(tmp_path: Path, then: Callable[[], None]) -> None:
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    one = Worker(Place.here(SCENARIO))
    with suppress(WorkerDiedError):
        one.call(start_another, str(tmp_path / "pipe"), then)
    one.close()
    os.set_blocking(reader, True)
    assert os.read(reader, 1) == b"", "nobody has it open any more"
    os.close(reader)


def test_code_that_is_not_the_same_is_refused() -> None:
    place = replace(Place.here(SCENARIO), code=(("vnet", "another"),))
    other = Worker(place)
    for _ in range(2):
        with pytest.raises(VnetError, match=r"vnet, or agents\.beacon:main, is not the code that was to be run"):
            other.call(os.getpid)
    other.close()


def test_a_worker_that_dies_or_takes_too_long_says_so() -> None:
    one = Worker(Place.here(SCENARIO))
    with pytest.raises(WorkerDiedError, match=r"^its process ended with status 3$"):
        one.call(os._exit, 3)
    assert not one.is_alive
    one = Worker(Place.here(SCENARIO))
    with pytest.raises(WorkerTimeoutError, match=r"not over within 0\.1 s"):
        one.call(time.sleep, 1000, limit_s=0.1)
    assert not one.is_alive


def mapped_files() -> str:
    return Path("/proc/self/maps").read_text()


def test_no_memory_of_a_worker_lies_on_the_disk_of_temporary_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Memory that a full disk cannot give ends a process by SIGBUS."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    one = Worker(Place.here(SCENARIO))
    assert str(tmp_path) not in one.call(mapped_files) + mapped_files()
    one.close()


def test_the_temporary_folders_of_a_worker_lie_where_its_starter_removes_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker that looks for a place by itself takes another where the disk has become full."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    one = Worker(Place.here(SCENARIO))
    left = Path(one.call(tempfile.mkdtemp, "", temporary_prefix(one.pid)))
    one.close()
    assert not left.exists()


def test_a_thread_keeps_its_worker_and_takes_it_along() -> None:
    place = Place.here(SCENARIO)
    with ThreadPoolExecutor(1) as pool:
        pids = {pool.submit(call_fitly, place, os.getpid).result() for _ in range(3)}
    assert len(pids) == 1 and os.getpid() not in pids
    with pytest.raises(ProcessLookupError):
        os.kill(pids.pop(), 0)


def test_a_worker_ends_with_its_starter_in_the_midst_of_a_job() -> None:
    code = (
        "import os, threading, time\n"
        "from emulator.cells.worker import Place, Worker\n"
        "from emulator.scenario.scenario import Scenario\n"
        "worker = Worker(Place.here(Scenario()))\n"
        "worker.call(os.getpid)\n"
        "threading.Thread(target=worker.call, args=(time.sleep, 1000), daemon=True).start()\n"
        "print(worker.pid, flush=True)\n"
        "os._exit(0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    gone = False
    for _ in range(1000):  # ten seconds at most
        try:
            os.kill(int(done.stdout), 0)
        except ProcessLookupError:
            gone = True
            break
        threading.Event().wait(0.01)
    assert gone


@dataclass(frozen=True)
class Work:
    """A job that counts its tries in a file, and ends its process in the first of them."""

    scenario: Scenario
    labels: dict[str, int]
    file: Path
    deaths: int


def try_it(work: Work) -> int:
    with work.file.open("a") as file:
        file.write("x")
    tries = len(work.file.read_text())
    if tries <= work.deaths:
        os.kill(os.getpid(), 9)
    return tries


def test_a_job_whose_worker_dies_is_run_again_but_not_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("emulator.cells.cells.MOST_TRIES", 2)
    works = [Work(Scenario(), {"seed": deaths}, tmp_path / str(deaths), deaths) for deaths in (1, 2)]
    done = each_done(works, try_it, most=1)
    assert next(done) == (works[0], 2)
    with pytest.raises(VnetError, match=r"^cell \{'seed': 2\}: its process ended with SIGKILL, 2 times$"):
        next(done)


def run_on(work: Work) -> None:
    running_node.running.show("v07")
    time.sleep(1000)


def test_a_job_whose_program_runs_on_and_on_is_ended_and_named(tmp_path: Path) -> None:
    impatient = Scenario.model_validate({"run": {"stall_timeout_s": 0.1}})
    with pytest.raises(VnetError, match=r"^cell \{'seed': 1\}: v07: no yield within 0\.1 s of wall clock$"):
        next(each_done([Work(impatient, {"seed": 1}, tmp_path, 0)], run_on, most=1))


def test_a_pool_that_is_closed_gives_up_what_it_does() -> None:
    pool = WorkerPool(1)
    future = pool.submit(call_fitly, Place.here(SCENARIO), time.sleep, 1000)
    while not future.running():
        threading.Event().wait(0.01)
    pool.shutdown(cancel_futures=True)
    with pytest.raises(WorkerDiedError, match="its process"):
        future.result()


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("ray://here:1", "write it as dask://HOST:PORT"),
        ("dask://here", "write it as dask://HOST:PORT"),
        ("dask://127.0.0.1:1", "no Dask scheduler answers"),
    ],
)
def test_an_executor_that_is_none_is_one_line(address: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("emulator.cells.cells.DASK_PATIENCE_S", 0.2)
    with pytest.raises(VnetError, match=f"^--executor {address}: {message}"), open_executor(address):
        pass
