"""Run all benchmarks: a table on stderr, JSON on stdout. `python -m benchmarks [NAME ...]` runs some.

`python -m benchmarks scale` prints the table of large runs instead, `python -m benchmarks size` the code's size.
"""

import json
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from agents.cooperative.cmm.rbpf import Observation, Rbpf, RbpfConfig
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap

Figures = dict[str, float]
ROOT = Path(__file__).parents[1]


def vnet(command: str, scenario: str, *options: str, watch: Callable[[int], None] | None = None) -> dict[str, Any]:
    """Run a vnet command; returns its verdict and events, and the whole wall-clock time as `total_s`."""
    with tempfile.TemporaryDirectory(prefix="vnet-bench-") as folder:
        out = Path(folder) / "run"
        arguments = [
            sys.executable,
            "-P",
            "-m",
            "emulator",
            command,
            scenario,
            "--out",
            str(out),
            "--no-report",
            *options,
        ]
        started = time.monotonic()
        process = subprocess.Popen(arguments, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        watcher = threading.Thread(target=watch or (lambda pid: None), args=(process.pid,))
        watcher.start()
        process.wait()
        watcher.join()
        result: dict[str, Any] = json.loads((out / "verdict.json").read_text())
        result["events"] = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
        result["total_s"] = time.monotonic() - started
        return result


def event(result: dict[str, Any], kind: str) -> dict[str, Any]:
    """The last event of a kind."""
    return [e for e in result["events"] if e["kind"] == kind][-1]


def bench_demo() -> Figures:
    """The quickstart as `make demo` runs it, from the command to the prompt."""
    result = vnet("run", "scenarios/quickstart.toml", "--rerun", "save")
    return {"total_s": result["total_s"], "start_up_s": event(result, "started")["start_up_s"]}


def bench_rbpf(particles: int = 500, vehicles: int = 10, steps: int = 400) -> Figures:
    """One RBPF step with all fixes present."""
    rng = np.random.default_rng(0)
    heading = rng.uniform(0, 2 * np.pi, vehicles)
    point = rng.uniform(0, 5000, (vehicles, 2))
    rbpf = Rbpf(RbpfConfig(particles=particles), LaneMap(point, heading, 0.85), np.random.default_rng(1))
    times_s = []
    for _ in range(steps):
        fixes = {
            f"v{j}": Observation(point[j] + [2.0, -1.0] + rng.normal(size=2), np.eye(2), float(heading[j]))
            for j in range(vehicles)
        }
        started = time.perf_counter()
        rbpf.step(0.1, fixes)
        times_s.append(time.perf_counter() - started)
    return {"step_us": statistics.median(times_s) * 1e6}


def bench_city_rbpf(particles: int = 500, vehicles: int = 10, lanes: int = 4, steps: int = 400) -> Figures:
    """The same of vehicles that drive on roads of several lanes, each a candidate; on straight lanes beside."""
    rng = np.random.default_rng(0)
    heading = rng.uniform(0, 2 * np.pi, vehicles)
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    aside = np.column_stack([np.sin(heading), -np.cos(heading)])
    place = rng.uniform(0, 5000, (vehicles, 2))
    which, number = np.divmod(np.arange(vehicles * lanes), lanes)
    start = place[which] - 1000 * ahead[which] + 3.5 * (number - (lanes - 1) / 2)[:, None] * aside[which]
    count = vehicles * lanes
    roads = RoadMap(
        start,
        heading[which],
        np.full(count, 3000.0),
        np.full(count, 0.85),
        np.zeros(count, dtype=np.uint8),
        np.ones(count, dtype=np.bool_),
        which.astype(np.int32),
        np.arange(count, dtype=np.int32),
        ("road",),
        1.5,  # so that the lanes stay hypotheses
    )
    filters = {
        name: Rbpf(RbpfConfig(particles=particles), known, np.random.default_rng(1))
        for name, known in (("city", roads), ("straight", LaneMap(place, heading, 0.85)))
    }
    times_s: dict[str, list[float]] = {name: [] for name in filters}
    for step in range(steps):
        for name, rbpf in filters.items():
            position = place + 1.2 * step * ahead * (name == "city")
            noise = rng.normal(size=(vehicles, 2))
            fixes = {
                f"v{j}": Observation(position[j] + [2.0, -1.0] + noise[j], np.eye(2), float(heading[j]))
                for j in range(vehicles)
            }
            started = time.perf_counter()
            rbpf.step(0.1, fixes)
            times_s[name].append(time.perf_counter() - started)
    return {f"{name}_step_us": statistics.median(times) * 1e6 for name, times in times_s.items()}


def bench_dashboard() -> Figures:
    """Cost of the live picture of a run with 50 vehicles: taking a snapshot, and a redraw at 100 × 30."""
    from benchmarks import dashboard

    return dashboard.measure()


def bench_estimators() -> Figures:
    """The RBPF step against the same with a covariance a particle, and against Stone Soup and filterpy."""
    from benchmarks import estimators  # needs the extra `bench`

    return estimators.compare()


def bench_quadratic_programs() -> Figures:
    """The fusion weights by OSQP's update against other solvers."""
    from benchmarks import quadratic_programs  # needs the extra `bench`

    return quadratic_programs.compare()


def bench_observer() -> Figures:
    """The observer of 50 vehicles at 10 Hz in real time: its share of a core, and what it writes."""
    from benchmarks import observer

    return observer.measure()


def bench_zenoh() -> Figures:
    """Zenoh programs as vehicles, in real time and on virtual time."""
    from benchmarks import zenoh_programs

    return zenoh_programs.measure()


def bench_maps() -> Figures:
    """The lanes within 30 m of 1000 vehicles, on 2 113 km of streets."""
    from benchmarks import maps

    return maps.measure()


def bench_startup() -> Figures:
    """`vnet --help` and `--version` to their end, `vnet run` and `simulate` to their first line."""
    from benchmarks import startup

    return startup.measure()


def bench_driving() -> Figures:
    """A hundred vehicles that programs drive, simulated."""
    from benchmarks import driving

    return driving.measure()


def bench_sumo() -> Figures:
    """Fifty programs among five hundred vehicles of SUMO, stepped with the run, simulated."""
    from benchmarks import sumo

    return sumo.measure()


BENCHMARKS: dict[str, Callable[[], Figures]] = {
    "rbpf": bench_rbpf,
    "city_rbpf": bench_city_rbpf,
    "maps": bench_maps,
    "startup": bench_startup,
    "dashboard": bench_dashboard,
    "estimators": bench_estimators,
    "quadratic_programs": bench_quadratic_programs,
    "driving": bench_driving,
    "sumo": bench_sumo,
    "demo": bench_demo,
    "observer": bench_observer,
    "zenoh": bench_zenoh,
}


def main() -> None:
    """Run the benchmarks that the command line names, or all."""
    if sys.argv[1:2] == ["scale"]:  # a table of its own, with options
        from benchmarks import scale

        scale.main(sys.argv[2:])
        return
    if sys.argv[1:] == ["size"]:
        from benchmarks import size

        print(size.table())
        return
    names = sys.argv[1:] or list(BENCHMARKS)
    for name in names:
        if name not in BENCHMARKS:
            sys.exit(f"{name}: no such benchmark; there are {', '.join(BENCHMARKS)}")
    table = Table("benchmark", "figure", "value")
    results = {}
    for name in names:
        try:
            results[name] = BENCHMARKS[name]()
        except ModuleNotFoundError as error:
            installs = "the extra sumo" if name == "sumo" else "`make bench`"
            print(f"{name}: skipped, {error.name} is missing; {installs} installs it", file=sys.stderr)
            continue
        for figure, value in results[name].items():
            table.add_row(name, figure, f"{value:.4g}")
    Console(stderr=True).print(table)
    print(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
