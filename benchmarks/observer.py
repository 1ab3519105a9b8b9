"""Cost of observing: the observer of a run of 50 vehicles at 10 Hz, in real time, as a process of its own.

The messages are those of a simulated run, published over Zenoh at the pace of the wall clock; the observer saves
and serves them. What it does in the beginning is not counted. Others compute at the lowest priority meanwhile, as a
run's processes do: the processor of an idle virtual machine goes to sleep, and the same work then takes half as
much again to nearly twice as much.
"""

from __future__ import annotations

import contextlib
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from emulator.drivers.observers import Messages
from emulator.drivers.session import Session
from emulator.records.run_folder import RECORDING
from emulator.scenario.scenario import Scenario
from emulator.viewer.scenes import DrawnReference
from vnet.transport import keys, wire
from vnet.transport.access import OBSERVER, Access
from vnet.transport.session import open_router, router_endpoint

ROOT = Path(__file__).parents[1]
RUN = "observed"
LOWEST = 19
"""Priority."""
BEGINNING_S = 5.0
"""Warm-up that is not counted: the start of the process, and of the drawing."""


def measure(vehicles: int = 50, duration_s: float = 35.0) -> dict[str, float]:
    """Observe a run; what it cost."""
    with tempfile.TemporaryDirectory(prefix="vnet-bench-") as name:
        folder = Path(name)
        told = _told(folder, vehicles, duration_s)
        access = Access.create(RUN, [["v01"]])
        credentials = folder / "observer.json"
        credentials.write_text(access.credentials(OBSERVER).dumps())
        with open_router("tcp/127.0.0.1:0", access) as session:
            endpoint = router_endpoint(session)
            command = [sys.executable, "-P", "-m", "emulator", "record", "--connect", endpoint, "--run", RUN]
            command += ["--credentials", str(credentials), "--out", str(folder / RECORDING), "--rerun", "serve"]
            single = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
            with _awake(), subprocess.Popen(command, cwd=ROOT, env={**os.environ, **single}) as observer:
                figures = _publish(session, told, observer.pid, folder / RECORDING)
                assert observer.wait(60) == 0
        return {**figures, "limit_share_of_a_core": _limit_share(told)}


@contextlib.contextmanager
def _awake() -> Iterator[None]:
    """Every core has something to compute, which gives way to everybody else."""
    command = [sys.executable, "-c", f"import os\nos.nice({LOWEST})\nwhile True: pass"]
    others = [subprocess.Popen(command) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def _told(folder: Path, vehicles: int, duration_s: float) -> list[tuple[str, dict[str, Any]]]:
    scenario = Scenario.model_validate(
        {
            "run": {"name": RUN, "duration_s": duration_s},
            "network": {"vehicles": vehicles},
            "radio": {"loss": 0.1},
            "program": {"entry": "agents.cooperative:main"},
        }
    )
    session = Session(scenario, folder / "run").open()
    messages = Messages(session.emulation)
    told = [("scene", messages.scene())]
    session.emulation.watch(lambda view: told.append(("period", messages.period(view))))
    session.run()
    return [*told, ("end", messages.end())]


def _publish(session: Any, told: list[tuple[str, dict[str, Any]]], pid: int, recording: Path) -> dict[str, float]:
    """Publish the messages in real time; what the process `pid` did meanwhile."""
    packed = [(stream, wire.encode_observation(message), message) for stream, message in told]
    publisher = {s: session.declare_publisher(keys.observe(RUN, s)) for s in ("scene", "period", "end")}
    while not publisher["period"].matching_status.matching:
        time.sleep(0.05)
    start = time.monotonic()
    begun: tuple[float, float, int] | None = None
    sizes = []
    for stream, data, message in packed:
        time.sleep(max(0.0, start + message.get("time_ns", 0) / 1e9 - time.monotonic()))
        if begun is None and time.monotonic() - start > BEGINNING_S:
            begun = (time.monotonic(), _cpu_s(pid), recording.stat().st_size)
        if stream == "end":
            assert begun is not None
            wall_s = time.monotonic() - begun[0]
            cpu_s, size = _cpu_s(pid) - begun[1], recording.stat().st_size - begun[2]
        publisher[stream].put(data)
        sizes.append(len(data))
    return {
        "share_of_a_core": cpu_s / wall_s,
        "written_kB_s": size / wall_s / 1e3,
        "heard_kB_s": statistics.mean(sizes) * 10 / 1e3,
    }


def _cpu_s(pid: int) -> float:
    """Seconds that a process has computed so far, in all its threads."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _limit_share(told: list[tuple[str, dict[str, Any]]]) -> float:
    """Share of it that the line of the bound takes, at 10 Hz."""
    bound = DrawnReference(told[0][1])
    bound.step(told[1][1])
    periods = [message for stream, message in told[2:] if stream == "period"]
    started = time.thread_time()
    for message in periods:
        bound.step(message)
    return (time.thread_time() - started) / len(periods) * 10
