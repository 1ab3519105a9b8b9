"""Run random programs in several layouts of processes, and compare traces: `python -m tests.hunt.layouts`."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import tomli_w

VNET = [sys.executable, "-P", "-W", "ignore", "-m", "emulator.cli"]
FAULTS: list[dict[str, Any]] = [
    {"kind": "restart", "at_s": 1.2, "duration_s": 0.4, "nodes": ["v02"]},
    {"kind": "pause", "at_s": 0.9, "duration_s": 0.5, "nodes": ["v03"]},
]
SIMULATED: dict[str, list[str]] = {
    "simulated": ["simulate"],
    "processes": ["simulate", "--processes", "3"],
    "windows off": ["simulate", "--set", "run.windows=false"],
}
LIVE: dict[str, list[str]] = {
    "live": ["run"],
    "live, windows off": ["run", "--set", "run.windows=false"],
    "nodes 2": ["run", "--set", "run.nodes_per_process=2"],
    "nodes all": ["run", "--set", "run.nodes_per_process=3"],
    "spawn": ["run", "--set", "run.start=spawn"],
    "two hosts": ["run", "--hosts", "2"],
}


def scenario_of(seed: int) -> dict[str, Any]:
    """Return the scenario of a random program; two of three have faults."""
    return {
        "run": {"name": f"random{seed}", "duration_s": 2.5, "settle_s": 0.5},
        "network": {"vehicles": 3},
        "world": {"gnss": {"rate_hz": 5}},
        "radio": {"loss": 0.1, "range_m": 1e6},
        "program": {"entry": "tests.hunt.random_programs:main", "options": {"seed": seed}},
        "fault": FAULTS[: seed % 3],
    }


def trace_of(folder: Path, seed: int, layout: list[str]) -> str:
    """Run a program in a layout; returns the trace's hash, or why there is none."""
    path, out = folder / "random.toml", folder / "run"
    path.write_text(tomli_w.dumps(scenario_of(seed)))
    command, *options = layout
    words = [*VNET, command, str(path), "--out", str(out), "--no-report", "--quiet", *options]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    try:
        return str(json.loads((out / "verdict.json").read_text())["trace_sha256"])
    except OSError:
        return f"status {done.returncode}: {done.stderr[-300:]}"


def differences(seeds: Iterable[int], layouts: dict[str, list[str]]) -> list[str]:
    """Return the layouts in which programs gave another trace than in the first, with their seeds."""
    found = []
    for seed in seeds:
        traces = {}
        for name, layout in layouts.items():
            if scenario_of(seed)["fault"] and name.startswith("nodes"):
                continue  # faults of one vehicle in a process of several are refused
            with TemporaryDirectory() as folder:
                traces[name] = trace_of(Path(folder), seed, layout)
        first = traces[next(iter(layouts))]
        found += [f"seed {seed}, {name}: {trace}" for name, trace in traces.items() if trace != first]
    return found


def main() -> int:
    """Read the options, and compare."""
    parser = argparse.ArgumentParser(prog="python -m tests.hunt.layouts", description=__doc__)
    parser.add_argument("--simulated", type=int, default=2000, help="programs in the simulated layouts")
    parser.add_argument("--live", type=int, default=100, help="programs in all layouts")
    options = parser.parse_args()
    found = differences(range(options.simulated), SIMULATED)
    found += differences(range(options.live), {"simulated": SIMULATED["simulated"], **SIMULATED, **LIVE})
    print("\n".join(found) or f"{options.simulated} and {options.live} programs: no differences")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
