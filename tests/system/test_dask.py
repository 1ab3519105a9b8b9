"""A sweep on Dask: a real scheduler and two worker processes on loopback, one of which is killed meanwhile."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import emulator
from emulator.cells import cells
from emulator.cells.cells import WALL_CLOCK, open_executor

if TYPE_CHECKING:
    from distributed import LocalCluster

pytestmark = pytest.mark.slow

TINY: dict[str, Any] = {
    "run": {"name": "tiny", "duration_s": 0.3},
    "network": {"kind": "generated", "vehicles": 4},
    "program": {"entry": "agents.beacon:main"},
}
VARY: dict[str, list[Any]] = {"radio.loss": [0, 0.5]}


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[LocalCluster]:
    """A scheduler, and two workers that are started again if they end."""
    from distributed import LocalCluster  # slow to import, and but one worker of pytest needs it

    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": "127.0.0.1:0"}
    with LocalCluster(**options, host="127.0.0.1", local_directory=str(tmp_path), silence_logs=50) as started:
        yield started


def test_a_worker_that_is_killed_loses_nothing(
    cluster: LocalCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from distributed import Client

    keep, killed = cells.keep, list[int]()

    def keep_and_kill_once(*arguments: Any) -> None:
        keep(*arguments)
        if not killed:
            with Client(cluster, set_as_default=False) as client:
                killed.extend(client.run(os.getpid).values())
            os.kill(killed[0], signal.SIGKILL)

    monkeypatch.setattr(cells, "keep", keep_and_kill_once)
    with open_executor(cluster.scheduler_address.replace("tcp://", "dask://")) as executor:
        there = emulator.sweep(TINY, VARY, seeds=3, out=tmp_path / "there", executor=executor)
    assert len(killed) == 2
    monkeypatch.undo()
    here = emulator.sweep(TINY, VARY, seeds=3, out=tmp_path / "here", jobs=1)
    assert len(there) == 6 and set(there["verdict"].to_pylist()) == {"valid"}
    assert there.drop_columns(list(WALL_CLOCK)).equals(here.drop_columns(list(WALL_CLOCK)))


def test_a_scheduler_without_workers_is_told(cluster: LocalCluster) -> None:
    said = list[str]()
    cluster.scale(0)
    cluster.sync(cluster._correct_state)
    with open_executor(cluster.scheduler_address.replace("tcp://", "dask://"), said.append):
        assert len(said) == 1 and "no worker" in said[0]
