"""Compare random programs in several layouts of processes: `python -m tests.hunt.layouts`.

Simulations are made one after the other in workers that are kept: 2000 programs would else start 6000 interpreters.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any
from zlib import crc32

import pyarrow as pa
import pyarrow.parquet as pq
import tomli_w

from emulator.cells.cells import each_done
from emulator.drivers.session import Local, Session, with_order_steps
from emulator.records.run_folder import RunFolder
from emulator.scenario.loading import scenario_of
from emulator.scenario.scenario import Scenario
from tests.support import forked_commands
from tests.support.forked_commands import VNET

FAULTS: list[dict[str, Any]] = [
    {"kind": "pause", "at_s": 0.9, "duration_s": 0.3, "nodes": ["v03"]},  # while garbage is collected
    {"kind": "restart", "at_s": 1.1, "duration_s": 0.2, "nodes": ["v02"]},
]
SIMULATED: dict[str, tuple[int, bool]] = {
    "simulated": (1, True),
    "3 processes": (3, True),
    "windows off": (1, False),
}
"""Number of processes, and whether there are windows."""
LIVE: dict[str, list[str]] = {
    "live": ["run"],
    "live, windows off": ["run", "--set", "run.windows=false"],
    "nodes 2": ["run", "--set", "run.nodes_per_process=2"],
    "nodes all": ["run", "--set", "run.nodes_per_process=3"],
    "spawn": ["run", "--set", "run.start=spawn"],
    "two hosts": ["run", "--hosts", "2"],
}
"""Commands, with their options."""


def settings_of(seed: int) -> dict[str, Any]:
    """Return the scenario of a random program; two of three have faults, one of four has two collections."""
    return {
        "run": {"name": f"random{seed}", "duration_s": 2.4 if seed % 4 == 3 else 1.4, "settle_s": 0.1},
        "network": {"vehicles": 3},
        "world": {"gnss": {"rate_hz": 5}},
        "radio": {"loss": 0.1, "range_m": 1e6},
        "program": {"entry": "tests.hunt.random_programs:main", "options": {"seed": seed}},
        "fault": FAULTS[: seed % 3],
    }


@dataclass(frozen=True)
class RandomProgram:
    """A random program, by its seed."""

    seed: int

    @property
    def scenario(self) -> Scenario:
        """Scenario that runs it."""
        return with_order_steps(scenario_of(settings_of(self.seed), {"run.pacing": "lockstep"}))

    @property
    def labels(self) -> str:
        """Name in messages."""
        return f"seed {self.seed}"


def simulated(program: RandomProgram) -> dict[str, str]:
    """Return digests of the program's runs, simulated from this process in each layout."""
    traces = {}
    for name, (processes, windows) in SIMULATED.items():
        scenario = program.scenario
        scenario = scenario.model_copy(update={"run": scenario.run.model_copy(update={"windows": windows})})
        with TemporaryDirectory() as folder:
            session = Session(scenario, RunFolder.scratch(Path(folder) / "run"), Local(processes))
            session.run()
            emulation = session.emulation
            traces[name] = digest(emulation.engine.trace.sha256(), emulation.metrics.states_table())
    return traces


def digest(trace_sha256: str, states: pa.Table) -> str:
    """Return a digest of what vehicles sent and reported; by text, because NaN is not equal to itself."""
    return f"{trace_sha256[:16]} {crc32(repr(states.to_pydict()).encode()):08x}"


def live(seed: int, layouts: Mapping[str, list[str]]) -> Iterator[tuple[str, str]]:
    """Yield the layouts with a process for some vehicles, and the run's digest, or why there is none."""
    for name, (command, *options) in layouts.items():
        if settings_of(seed)["fault"] and name.startswith("nodes"):
            continue  # faults of one vehicle in a process of several are refused
        with TemporaryDirectory() as folder:
            path, out = Path(folder) / "random.toml", Path(folder) / "run"
            path.write_text(tomli_w.dumps(settings_of(seed)))
            words = [*VNET, command, str(path), "--out", str(out), "--no-report", "--quiet", *options]
            done = forked_commands.run(words, capture_output=True, timeout=300)
            try:
                verdict = json.loads((out / "verdict.json").read_text())
                yield name, digest(verdict["trace_sha256"], pq.read_table(out / "states.parquet"))
            except OSError:
                yield name, f"status {done.returncode}: {done.stderr[-300:]}"


def differences(
    seeds: Iterable[int], layouts: Mapping[str, list[str]] = MappingProxyType({}), workers: int = 1
) -> Iterator[str]:
    """Yield the layouts in which programs sent or reported something else than in the first, with their seeds."""
    programs = [RandomProgram(seed) for seed in seeds]
    for program, traces in each_done(programs, simulated, most=workers):
        found: Mapping[str, str] = traces | dict(live(program.seed, layouts))
        expected = found["simulated"]
        yield from (f"seed {program.seed}, {name}: {found[name]}" for name in found if found[name] != expected)


def main() -> int:
    """Read the options, and compare."""
    parser = argparse.ArgumentParser(prog="python -m tests.hunt.layouts", description=__doc__)
    parser.add_argument("--simulated", type=int, default=2000, help="programs in the simulated layouts")
    parser.add_argument("--live", type=int, default=100, help="programs in all layouts")
    parser.add_argument("--first", type=int, default=0, help="the first of their seeds")
    parser.add_argument("--workers", type=int, default=1, help="programs that are simulated at a time")
    options = parser.parse_args()
    found = 0
    for count, layouts in ((options.live, LIVE), (options.simulated, {})):
        seeds = range(options.first, options.first + count)
        for difference in differences(seeds, layouts, options.workers):
            print(difference, flush=True)
            found += 1
    print(f"{options.live} programs in all layouts, {options.simulated} in the simulated: {found} differences")
    return 1 if found else 0


if __name__ == "__main__":
    from tests.hunt import layouts  # workers import it by this name

    sys.exit(layouts.main())
