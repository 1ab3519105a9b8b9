"""Fifty programs among five hundred vehicles of SUMO that no program drives, stepped with the run, simulated."""

import importlib.util
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from emulator.drivers.session import Session
from emulator.scenario.scenario import Scenario
from emulator.world.driven.sumo import SumoWorld

RUNS = 3
PROGRAMS, VEHICLES = 50, 590
"""Numbers of vehicles; some of all have arrived, or wait for room, when the run begins."""
START_S, DURATION_S = 60.0, 30.0
SCENARIO: dict[str, Any] = {
    "run": {"name": "sumo", "duration_s": DURATION_S},
    "world": {"ranging": {}},
    "radio": {"range_m": 300.0, "loss": 0.1},
    "program": {"entry": "benchmarks.programs:brakes_now_and_then"},
}
CONFIGURATION = """<configuration>
    <input><net-file value="grid.net.xml"/><route-files value="grid.rou.xml"/></input>
</configuration>
"""


def measure() -> dict[str, float]:
    """Return emulated by wall-clock time, the best and the worst of some runs, and what was there."""
    with tempfile.TemporaryDirectory(prefix="vnet-bench-") as name:
        folder = Path(name)
        _write_grid(folder)
        runs = [_run(folder, folder / f"run-{number}") for number in range(RUNS)]
    if len({run["trace"] for run in runs}) > 1:
        raise RuntimeError("runs of the same scenario differ")
    factors = sorted(run["factor"] for run in runs)
    return {
        "real_time_factor": factors[len(factors) // 2],
        "real_time_factor_worst": factors[0],
        "emulated_by_cpu_time_without_sumo": max(run["by_cpu"] for run in runs),
        "start_s": min(run["start_s"] for run in runs),
        "background": runs[0]["background"],
    }


def _run(folder: Path, out: Path) -> dict[str, Any]:
    network = {"kind": "sumo", "path": folder / "grid.sumocfg", "step": True}
    network |= {"start_s": START_S, "max_vehicles": PROGRAMS}
    scenario = Scenario.model_validate(SCENARIO | {"network": network})
    begun_s = time.monotonic()
    session = Session(scenario, out).open()
    start_s = time.monotonic() - begun_s
    world = session.emulation.world
    assert isinstance(world, SumoWorld)
    background = world.vehicles.in_all - PROGRAMS
    cpu_s = time.process_time()
    session.run()
    return {
        "factor": DURATION_S / session.wall_s,
        "by_cpu": DURATION_S / (time.process_time() - cpu_s),
        "start_s": start_s,
        "background": background,
        "trace": session.emulation.engine.trace.sha256(),
    }


def _write_grid(folder: Path) -> None:
    """Write a grid of ten by ten crossings with traffic lights, two lanes a direction, and vehicles through it."""
    command = [_netgenerate(), "--grid", "--grid.number", "10", "--grid.length", "200", "-L", "2", "--tls.guess"]
    command += ["--no-turnarounds", "--xml-validation", "never", "-o", str(folder / "grid.net.xml")]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    edges = re.findall(r'<edge id="([A-Z]+\d+[A-Z]+\d+)"', (folder / "grid.net.xml").read_text())
    draw = random.Random(1)
    trips = []
    for number in range(VEHICLES):
        begin, end = draw.sample(edges, 2)
        trips.append(
            f'<trip id="car{number}" depart="{number / 10:.1f}" from="{begin}" to="{end}" departLane="best"/>'
        )
    (folder / "grid.rou.xml").write_text("\n".join(["<routes>", *trips, "</routes>"]))
    (folder / "grid.sumocfg").write_text(CONFIGURATION)


def _netgenerate() -> str:
    """Return the path of SUMO's program that makes networks; raise ModuleNotFoundError if there is none."""
    folders = [os.environ.get("PATH", ""), str(Path(sys.executable).parent)]
    if (package := importlib.util.find_spec("sumo")) is not None and package.origin is not None:
        folders.append(str(Path(package.origin).parent / "bin"))
    found = shutil.which("netgenerate", path=os.pathsep.join(folders))
    if found is None or importlib.util.find_spec("libsumo") is None:
        raise ModuleNotFoundError("SUMO is not installed", name="SUMO")
    return found
