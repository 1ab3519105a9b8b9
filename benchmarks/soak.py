"""`make soak`: twenty vehicles in real time among random faults for half an hour; nothing may leak or stay broken.

    python -m benchmarks.soak [--minutes 30] [--seed 1] [--out FOLDER]

Prints the verdict, how each process's memory grew, and what became of the faults; ends with the run's status.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from emulator.records.events import Event
from emulator.records.recorded_run import RecordedRun
from emulator.scenario.faults import parse_fault
from emulator.scenario.loading import dump_scenario
from emulator.scenario.scenario import Scenario

VEHICLES, SETTLE_S = 20, 20.0
EVERY_S, SHORTEST_S, LONGEST_S = 12.0, 3.0, 10.0
"""A fault begins so often on average, and lasts so long: they overlap now and then."""
KINDS: tuple[tuple[str, dict[str, Any]], ...] = (
    *(("kill", {}), ("restart", {}), ("pause", {}), ("partition", {}), ("block", {}), ("swizzle", {})),
    *(("loss", {"probability": 0.5}), ("burst_loss", {}), ("range", {"range_m": 800.0})),
    *(("delay", {"delay_ms": 60.0}), ("jitter", {"jitter_ms": 40.0}), ("reorder", {}), ("duplicate", {})),
    *(("corrupt", {}), ("gnss_outage", {}), ("gnss_jump", {"offset_m": [15.0, -10.0]}), ("ConstPosOffset", {})),
    *(("RandomPos", {}), ("DataReplay", {}), ("StaleMessages", {}), ("DoS", {"factor": 3}), ("Sybil", {})),
)


def make_scenario(minutes: float, seed: int) -> Scenario:
    """Twenty cooperating vehicles, and one fault after the other, drawn from `seed`."""
    rng = np.random.default_rng(seed)
    duration_s = 60 * minutes
    faults = []
    at_s = 5.0
    while (at_s := at_s + rng.exponential(EVERY_S)) < duration_s - SETTLE_S - LONGEST_S:
        kind, parameters = KINDS[rng.integers(len(KINDS))]
        where = {} if kind == "partition" else {"nodes": {"count": int(rng.integers(1, VEHICLES // 4))}}
        lasting_s = rng.uniform(SHORTEST_S, LONGEST_S)
        times = {"at_s": round(at_s, 2), "duration_s": round(lasting_s, 2)}
        faults.append(parse_fault({"kind": kind, **times, **where, **parameters}))
    return Scenario.model_validate(
        {
            "run": {
                "name": "soak",
                "seed": seed,
                "duration_s": duration_s,
                "settle_s": SETTLE_S,
                "pacing": "realtime",
            },
            "network": {"vehicles": VEHICLES},
            "radio": {"loss": 0.1},
            "program": {"entry": "agents.cooperative:main"},
            "fault": faults,
        }
    )


def slope_kb_per_min(event: Event) -> float:
    """Growth rate of a process's memory, by least squares over the last two thirds of its samples."""
    time_s, private_kb = (np.array(event.details[name], dtype=float) for name in ("time_s", "private_kb"))
    kept = slice(len(time_s) // 3, None)
    return float(np.polyfit(time_s[kept], private_kb[kept], 1)[0]) * 60


def report(folder: Path) -> None:
    """Print the figures of a finished soak."""
    events = RecordedRun.open(folder).events
    verdict = json.loads((folder / "verdict.json").read_text())
    series = [e for e in events if e.kind == "memory" and len(e.details["time_s"]) >= 9]
    slopes = {str(e.node): slope_kb_per_min(e) for e in series if e.node != "emulator"}
    largest = max((max(e.details["private_kb"]) for e in series if e.node != "emulator"), default=0)
    started = [e.details["fault"] for e in events if e.kind == "fault_started"]
    ended = [e.details["fault"] for e in events if e.kind == "fault_ended"]
    late = next((e.details for e in events if e.kind == "late_deliveries"), {})
    print(f"verdict                 {verdict['verdict']}")
    print(f"emulated                {verdict['emulated_s']:g} s, real-time factor {verdict['real_time_factor']}")
    print(f"faults                  {len(started)} began, {len(set(started) - set(ended))} never ended")
    print(f"restarted               {sum(e.kind == 'restarted' for e in events)} processes")
    print(f"late by over 20 ms      {late.get('count')} of {late.get('total')}, p99 {late.get('p99_ms', 0):.1f} ms")
    if slopes:
        median, worst = float(np.median(list(slopes.values()))), max(slopes, key=slopes.__getitem__)
        print(f"memory of agents        median {median:+.1f} kB/min, worst {slopes[worst]:+.1f} ({worst})")
        print(f"largest agent           {largest / 1024:.0f} MB")
    for check in verdict["checks"]:
        if check["verdict"] != "valid":
            print(f"{check['verdict']:8} {check['name']}: {check['text']}")


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("runs/soak"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"soak-{arguments.seed}.toml"
    path.write_text(dump_scenario(make_scenario(arguments.minutes, arguments.seed)))
    run = arguments.out / f"run-{arguments.seed}"
    done = subprocess.run(
        [sys.executable, "-P", "-m", "emulator", "run", str(path), "--out", str(run), "--no-report"],
        check=False,
    )
    if (run / "verdict.json").exists():
        report(run)
    sys.exit(done.returncode)


if __name__ == "__main__":
    main()
