"""The two simulators: ns-3 through a program of ours in C++, and vnet's engine alone."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.ns3.ground import SIZE_BYTES, Outcome, ScheduleConstraints
from emulator.radio.engine import Engine
from emulator.radio.outcomes import Outcome as Fate
from emulator.scenario.scenario import Radio

PROGRAM = Path(__file__).with_name("broadcast.cc")
MODULES = ("core", "network", "mobility", "propagation", "wifi", "wave")
HOW_TO_GET_IT = "apt-get install g++ pkg-config libgsl-dev libns3-dev (Debian 12 has ns-3 3.37)"
RADIO: dict[str, Any] = {
    "max_peers": 10_000,
    "access_jitter_ms": 0.0,
    "queue_frames": 500,
    "path_loss": {"kind": "log_distance", "exponent": 2.0, "reference_db": 47.86, "tx_power_dbm": 20.0},
    "mac": {"access_category": "BE"},
}
"""All else are vnet's defaults, and ns-3's."""


class MissingError(Exception):
    """ns-3 cannot be used here; says in one line why, and how to get it."""


def build(folder: Path, source: Path = PROGRAM, modules: Sequence[str] = MODULES) -> Path:
    """Compile a program, which uses these modules of ns-3, into `folder`. Raises MissingError."""
    for tool in ("g++", "pkg-config"):
        if shutil.which(tool) is None:
            raise MissingError(f"{tool} is missing: {HOW_TO_GET_IT}")
    names = [f"ns3-{module}" for module in modules]
    found = subprocess.run(["pkg-config", "--cflags", "--libs", *names], capture_output=True, text=True)
    if found.returncode:
        raise MissingError(f"ns-3 is missing: {HOW_TO_GET_IT}")
    program = folder / source.stem
    command = ["g++", "-O2", "-std=c++17", str(source), "-o", str(program), *found.stdout.split()]
    compiled = subprocess.run(command, capture_output=True, text=True)
    if compiled.returncode:
        raise MissingError(f"{source.name} does not compile: {_last_line(compiled.stderr)}: {HOW_TO_GET_IT}")
    return program


def _last_line(text: str) -> str:
    return text.strip().splitlines()[-1] if text.strip() else "no reason given"


def ns3(program: Path, ground: ScheduleConstraints, fading: bool) -> Outcome:
    """The ground in ns-3. Raises MissingError if the program fails."""
    arguments = [f"--fading={int(fading)}", f"--bytes={SIZE_BYTES}", f"--seconds={ground.seconds:g}"]
    done = subprocess.run([program, *arguments], input=ground.text(), capture_output=True, text=True)
    if done.returncode:
        raise MissingError(f"{program.name} ended with status {done.returncode}: {_last_line(done.stderr)}")
    figures = json.loads(done.stdout)
    if figures["sent"] != ground.sent.tolist():
        raise MissingError(f"{program.name}: not every frame was sent")
    return Outcome(np.array(figures["received"]), np.array(figures["busy"]), figures["wall_s"], figures["cpu_s"])


def ours(ground: ScheduleConstraints, fading: bool) -> Outcome:
    """The ground in vnet's engine, period by period."""
    count = len(ground.east_m)
    radio = Radio.model_validate({**RADIO, **({"fading": {}} if fading else {})})
    position_m = np.column_stack([ground.east_m, np.zeros(count)])
    engine = Engine([f"v{number}" for number in range(count)], radio, 1, position_m, None)
    payload, period_ns = [bytes(SIZE_BYTES)], 100_000_000
    next_ns = period_ns
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    for time_ns, sender in zip(ground.time_ns.tolist(), ground.sender.tolist(), strict=True):
        while time_ns >= next_ns:
            engine.advance(next_ns)
            next_ns += period_ns
        engine.transmit(time_ns, sender, payload)
    engine.drain()
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    trace = engine.trace
    received = np.zeros((count, count))
    pairs = trace.column("sender"), trace.column("receiver")
    np.add.at(received, pairs, trace.column("outcome") == Fate.delivered)
    busy = np.mean(engine.busy_ratios(round(ground.seconds * 1e9)), axis=0)
    return Outcome(received, busy, wall_s, cpu_s)
