"""Figures of large runs, as a table: `python -m benchmarks scale [--only ROW …] [--runs N] [--write]`.

Each row measures by itself, in runs that are interleaved where it compares two things, and shows the median. A row
that fails says why in its place. With `--write` the table of `docs/benchmarks.md` gets what was measured.
"""

from __future__ import annotations

import argparse
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

import emulator
from benchmarks import hosts
from benchmarks.__main__ import ROOT, event, vnet
from vnet import Node

PAGE = ROOT / "docs" / "benchmarks.md"
BEGIN, END = "<!-- measured: python -m benchmarks scale --write -->", "<!-- end -->"
BEACON, COOPERATIVE = "scenarios/beacon.toml", "scenarios/quickstart.toml"
COOPERATE = ("--program", "agents.cooperative:main")
"""The cooperative program with its default options, on the beacons' network: about 12 neighbours for any number."""
SAMPLE_S = 0.5
"""Time between two samples of the processes' memory."""
PARTS = 2
"""Longer runs of a comparison of CPU time have this many times the emulated time of shorter ones."""


@dataclass(frozen=True)
class Row:
    """One row of the table: what is measured, the figures of issue 16, and the function that measures."""

    what: str
    reach: str
    aim: str
    measure: Callable[[int], str]


def _vehicles(count: int) -> list[str]:
    return ["--set", f"network.vehicles={count}"]


def median_of(runs: int, measure: Callable[[], float]) -> float:
    """Return the median of some runs."""
    return statistics.median(measure() for _ in range(runs))


# Rows.


def start(runs: int, counts: Sequence[int] = (50, 200, 1000)) -> str:
    """Time in s from the first process to time 0 of all."""
    return " / ".join(f"{median_of(runs, lambda count=count: _start_s(count)):.2g}" for count in counts) + " s"  # type: ignore[misc]


def _start_s(count: int) -> float:
    result = vnet("run", BEACON, *_vehicles(count), "--duration", "1", "--set", "run.join_timeout_s=600")
    return float(event(result, "started")["start_up_s"])


def memory(runs: int) -> str:
    """Unique and proportional set size of a process of 50 beacons near the run's end, medians over processes."""
    sizes: list[tuple[float, float]] = []

    def watch(pid: int) -> None:
        while Path(f"/proc/{pid}").exists():
            time.sleep(SAMPLE_S)
            sample = agents_mb(pid)
            if len(sample) >= len(sizes):  # before processes end
                sizes[:] = sample

    for _ in range(runs):
        vnet("run", BEACON, *_vehicles(50), "--duration", "20", watch=watch)
    uss_mb, pss_mb = (statistics.median(column) for column in zip(*sizes, strict=True))
    return f"{uss_mb:.1f} / {pss_mb:.1f} MB"


def agents_mb(parent: int) -> list[tuple[float, float]]:
    """Return USS and PSS in MB of each child of a process; those that are gone meanwhile are left out."""
    sizes = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            stat = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(stat[1]) != parent:
                continue
            lines = [line.split() for line in (folder / "smaps_rollup").read_text().splitlines()[1:]]
        except (OSError, IndexError):
            continue
        size_kb = {line[0]: int(line[1]) for line in lines if len(line) == 3}
        private_kb = sum(kb for name, kb in size_kb.items() if name.startswith("Private_"))
        sizes.append((private_kb / 1024, size_kb.get("Pss:", 0) / 1024))
    return sizes


def live_beacons(runs: int, count: int = 50, duration_s: int = 30) -> str:
    """Real-time factor of live beacons in lockstep."""
    options = [*_vehicles(count), "--duration", str(duration_s), "--set", "run.join_timeout_s=600"]
    return f"{median_of(runs, lambda: _factor('run', BEACON, *options)):.2g}"


def _factor(command: str, scenario: str, *options: str) -> float:
    return float(vnet(command, scenario, *options)["real_time_factor"])


def live_thousand(runs: int) -> str:
    """Real-time factor of 1000 live beacons in lockstep."""
    return live_beacons(runs, 1000, 10)


def awaiting(runs: int) -> str:
    """Real-time factor of 50 live programs that await each packet of 13 peers, without a delivery tick."""
    options = ["--program", "benchmarks.programs:always_awaits", "--duration", "5", *_vehicles(50)]
    return f"{median_of(runs, lambda: _factor('run', BEACON, *options)):.2g}"


def cooperative(runs: int) -> str:
    """Real-time factors of 50 cooperative vehicles, live and simulated in turns: their ratio, and live."""
    options = [*_vehicles(50), "--duration", "20"]
    pairs = [[_factor(command, COOPERATIVE, *options) for command in ("run", "simulate")] for _ in range(runs)]
    ratio = statistics.median(live / simulated for live, simulated in pairs)
    return f"{ratio:.2g}; {statistics.median(live for live, _ in pairs):.2g}"


def simulated_thousand(runs: int) -> str:
    """Real-time factors of 1000 beacons in one process, and in one for each core."""
    return _in_one_and_in_all(runs, [[*_vehicles(1000), "--duration", "10"]])


def simulated_cooperative(runs: int) -> str:
    """Real-time factors of 50, 200 and 1000 cooperative vehicles in one process, and in one for each core."""
    cases = ((50, 20), (200, 10), (1000, 5))
    return _in_one_and_in_all(
        runs, [[*COOPERATE, *_vehicles(count), "--duration", str(seconds)] for count, seconds in cases]
    )


def _in_one_and_in_all(runs: int, cases: Sequence[Sequence[str]]) -> str:
    """Real-time factors of simulations in one process, and in one for each core, in turns."""
    ways = ("1", "auto")
    medians: dict[str, list[str]] = {way: [] for way in ways}
    for case in cases:
        turns = [[_factor("simulate", BEACON, *case, "--processes", way) for way in ways] for _ in range(runs)]
        for way, factors in zip(ways, zip(*turns, strict=True), strict=True):
            medians[way].append(f"{statistics.median(factors):.2g}")
    return "; ".join(" / ".join(medians[way]) for way in ways)


def estimator(runs: int) -> str:
    """CPU of the estimator a vehicle and period in seconds 5 to 10, with 50 and 1000 vehicles: less a beacon's.

    The same seconds for both, because lanes compete in the first, and more turns where runs are short.
    """
    few = median_of(3 * runs, lambda: _estimator_us(50))
    many = median_of(runs, lambda: _estimator_us(1000))
    return f"{few:.0f} / {many:.0f} µs"


def _estimator_us(count: int) -> float:
    return _cpu_us(count, 5, *COOPERATE) - _cpu_us(count, 5)


def density(runs: int) -> str:
    """CPU a vehicle and period at 1000 vehicles by that at 100, in turns; start and end of the runs left out."""
    pairs = [(_cpu_us(100, 40), _cpu_us(1000, 5)) for _ in range(runs)]
    ratio = statistics.median(many / few for few, many in pairs)
    few_us, many_us = (statistics.median(column) for column in zip(*pairs, strict=True))
    return f"{ratio:.2f} ({many_us:.0f} : {few_us:.0f} µs)"


def _cpu_us(count: int, duration_s: int, *options: str) -> float:
    """Return the CPU time of a vehicle and period in µs: of a longer run less that of a shorter one."""
    shorter_s, longer_s = (_cpu_s(count, part * duration_s, *options) for part in (1, PARTS))
    return (longer_s - shorter_s) * 1e6 / (count * 10 * duration_s * (PARTS - 1))


def _cpu_s(count: int, duration_s: int, *options: str) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    vnet("simulate", BEACON, *options, *_vehicles(count), "--duration", str(duration_s))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def ns3(runs: int, counts: Sequence[int] = (50, 100, 200), seconds: float = 10.0) -> str:
    """CPU time of ns-3 by that of the engine, with fading, in turns."""
    from benchmarks.ns3.ground import ScheduleConstraints
    from benchmarks.ns3.simulators import build, ours
    from benchmarks.ns3.simulators import ns3 as theirs

    ratios = []
    with tempfile.TemporaryDirectory(prefix="vnet-ns3-") as folder:
        program = build(Path(folder))
        for count in counts:
            ground = ScheduleConstraints.of(count, seconds)
            turns = [theirs(program, ground, True).cpu_s / ours(ground, True).cpu_s for _ in range(runs)]
            ratios.append(statistics.median(turns))
    return " / ".join(f"{ratio:.1f}" for ratio in ratios)


def three_hosts(runs: int) -> str:
    """Return barriers an emulated second of 50 beacons on three hosts, and their speed by that on one host."""
    return hosts.compare(runs, BEACON, "--duration", "20", *_vehicles(50))


def three_hosts_awaiting(runs: int) -> str:
    """Return the same for programs that await each packet of 13 peers, without a delivery tick."""
    program = ["--program", "benchmarks.programs:always_awaits"]
    return hosts.compare(runs, BEACON, *program, "--duration", "5", *_vehicles(50))


def realtime(runs: int, count: int = 100) -> str:
    """Beacons of 300 bytes on the wall clock: transport gaps, p99 of the latency, and the share over 20 ms."""
    options = ["--program", "benchmarks.programs:steady_beacon", "--pacing", "realtime", "--duration", "30"]
    gaps, p99_ms, late, known = 0, [], [], 0
    for _ in range(runs):
        result = vnet("run", BEACON, *options, *_vehicles(count), "--set", "radio.loss=0.0")
        gaps += sum(each["count"] for each in result["events"] if each["kind"] == "transport_gap")
        lateness = event(result, "late_deliveries")
        p99_ms.append(float(lateness["p99_ms"]))
        late.append(lateness["count"] / max(lateness["total"], 1))
        known += result["verdict"] != "unknown"
    middle_ms, worst_ms = statistics.median(p99_ms), max(p99_ms)
    latency = f"p99 {middle_ms:.1f} ms (worst {worst_ms:.1f}), {statistics.median(late):.2%} over 20 ms"
    return f"{gaps} gaps, {latency}; {known} of {runs} not unknown"


def realtime_200(runs: int) -> str:
    """Return the figures of `realtime` for 200 beacons."""
    return realtime(runs, 200)


def environment(runs: int, agents: int = 20, steps: int = 500) -> str:
    """Return the agent-steps a second of `emulator.environment`; each agent drives and sends a frame a step."""
    return f"{median_of(runs, lambda: _agent_steps_a_second(agents, steps)):.0f}"


def _agent_steps_a_second(agents: int, steps: int) -> float:
    road = {"road": "ring", "length_m": 50.0 * agents}
    scenario = {
        "network": {"kind": "driven", "vehicles": agents, "driven": road},
        "world": {"ranging": {}},
        "run": {"duration_s": steps / 10 + 1, "settle_s": 0.0},
    }
    space = Box(-3, 3, (1,), np.float32)
    env = emulator.environment(
        scenario,
        observe=lambda node, fix, packets: np.array([fix.speed_m_s, len(packets)]),
        act=_drive_and_tell,
        reward=lambda agent, moment: moment.speed_m_s[agent],
        observation_space=Box(0, np.inf, (2,)),
        action_space=space,
    )
    env.reset(seed=1)
    started_s = time.monotonic()
    for step in range(steps):
        acceleration = np.array([1.0 if step % 20 < 10 else -1.0])
        env.step(dict.fromkeys(env.agents, acceleration))
    took_s = time.monotonic() - started_s
    env.close()
    return agents * steps / took_s


async def _drive_and_tell(node: Node, action: NDArray[np.float64]) -> None:
    node.drive(acceleration_m_s2=float(action[0]))
    await node.radio.broadcast(action.tobytes())


ROWS: dict[str, Row] = {
    "start": Row("start of 50 / 200 / 1000 processes", "1.5 / 6 / 30 s", "0.8 / 3 / 12 s", start),
    "memory": Row("memory a process, USS / PSS, of 50", "10 / 15 MB", "6 / 8 MB", memory),
    "live": Row("50 beacons live, lockstep, real-time factor", "10", "15", live_beacons),
    "awaiting": Row("50 × 13 peers, awaiting each packet, no tick, real-time factor", "2.5", "4", awaiting),
    "cooperative": Row(
        "50 cooperative vehicles (`estimates`), live : simulated; live", "1.2; 1.1", "1.6; 1.5", cooperative
    ),
    "simulated": Row(
        "1000 beacons simulated in one process; in one for each core, real-time factor",
        "1.5",
        "2.5",
        simulated_thousand,
    ),
    "simulated_cooperative": Row(
        "50 / 200 / 1000 cooperative vehicles simulated in one process; in one for each core, real-time factor",
        "4 / 1 / 0.2",
        "6 / 1.5 / 0.3",
        simulated_cooperative,
    ),
    "estimator": Row(
        "CPU of the cooperative program a vehicle and period, with 50 / 1000 vehicles, less that of a beacon",
        "400 / 400 µs ± 20 %",
        "250 µs",
        estimator,
    ),
    "thousand": Row("1000 beacons live, 1000 processes, real-time factor", "0.4", "0.6", live_thousand),
    "density": Row("CPU a vehicle and period at 1000 : at 100 vehicles, simulated", "1.2", "1.05", density),
    "ns3": Row(
        "engine against ns-3 at 50 / 100 / 200 vehicles with fading, CPU", "12 / 18 / 25", "20 / 30 / 50", ns3
    ),
    "hosts": Row(
        "three hosts, 1 ms between them, 50 beacons: barriers an emulated second; speed : one host",
        "≤ 25; 0.6",
        "0.8",
        three_hosts,
    ),
    "hosts_awaiting": Row(
        "the same, 50 × 13 peers, awaiting each packet: barriers; speed : one host",
        "≤ 520; 0.5",
        "0.8",
        three_hosts_awaiting,
    ),
    "realtime": Row("real time, 100 beacons × 10 Hz, 30 s", "0 gaps, p99 ≤ 20 ms", "10 ms", realtime),
    "environment": Row("agent-steps a second with 20 agents that drive and send", "2000", "", environment),
    "realtime_200": Row("real time, 200 beacons", "4 of 5 not unknown, p99 ≤ 50 ms", "", realtime_200),
}
"""The rows by the name that `--only` takes; another row needs an entry here and nothing else."""


# The table.


def machine() -> str:
    """Return the machine, the load of others, the versions and the commit, in a line."""
    commit = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True)
    return (
        f"{os.cpu_count()} cores ({platform.machine()}), load {os.getloadavg()[0]:.1f} before, Python "
        f"{platform.python_version()}, commit {commit.stdout.strip() or 'unknown'}, {date.today()}"
    )


def line(name: str, measured: str, where: str) -> str:
    """Return a row of the table as Markdown."""
    row = ROWS[name]
    return f"| {row.what} (`{name}`) | {row.reach} | {row.aim} | {measured} | {where} |"


def updated(page: str, lines: dict[str, str]) -> str:
    """Return the page with these rows of its table replaced; rows that were not measured stay."""
    head, rest = page.split(BEGIN)
    table, tail = rest.split(END)
    old = {name: text for text in table.splitlines() for name in ROWS if f"(`{name}`) |" in text}
    rows = [lines.get(name) or old.get(name) or line(name, "not measured", "") for name in ROWS]
    title = ["| what | to reach | aim | measured | where |", "|---|---|---|---|---|"]
    return f"{head}{BEGIN}\n\n" + "\n".join([*title, *rows]) + f"\n\n{END}{tail}"


def main(arguments: Sequence[str]) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks scale", description="Measure large runs.")
    parser.add_argument("--only", nargs="+", choices=ROWS, metavar="ROW", help=f"of {', '.join(ROWS)}")
    parser.add_argument("--runs", type=int, default=3, help="runs of which the median is shown (default 3)")
    parser.add_argument("--write", action="store_true", help=f"update {PAGE.relative_to(ROOT)}")
    options = parser.parse_args(arguments)
    lines = {}
    for name in options.only or ROWS:
        where = machine()
        try:
            measured = ROWS[name].measure(options.runs)
        except Exception as error:  # a row that cannot be measured here does not end the table
            measured = f"failed: {type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
        lines[name] = line(name, measured, where)
        print(lines[name], flush=True)
        if options.write:
            PAGE.write_text(updated(PAGE.read_text(), {name: lines[name]}))


if __name__ == "__main__":
    main(sys.argv[1:])
