"""The folder of a run: everything that is kept of it, written so that an interruption leaves it readable.

`scenario.toml` first, `events.jsonl` line by line as things happen, tables, `world.npz` and `verdict.json` at the
end, each put in place in one step. `run_files` and `recorded_run` read it.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from emulator.records.atomic import atomically, disk_errors
from emulator.records.code_digest import code_digests
from emulator.scenario.scenario import Scenario, dump_scenario, input_digests
from vnet.errors import VnetError

RUNS = Path("runs")
SCENARIO_FILE = "scenario.toml"
EVENTS_FILE = "events.jsonl"
TRACE_FILE = "trace.parquet"
STATES_FILE = "states.parquet"
METRICS_FILE = "metrics.parquet"
BUSY_FILE = "busy.parquet"
WORLD_FILE = "world.npz"
VERDICT_FILE = "verdict.json"
REPORT, INDEX, RECORDING = "report.html", "index.html", "recording.rrd"
"""Names of a run's report and recording, and of the list of the runs in a folder."""
AGAIN = "again"
"""The folder, in a run's own, of the second run of `--check-determinism`."""
FORMAT = 2
"""Version of the folder's files; `verdict.json` holds it. docs/reference/files.md says what changed with each."""


@dataclass(frozen=True)
class Event:
    """One line of `events.jsonl`: something that happened to a node, or to the run where `node` is None."""

    time_ns: int
    kind: str
    node: str | None
    details: dict[str, Any]


class RunFolder:
    """A run's folder; see the module's text. All methods raise VnetError where the disk does not play along."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.logs = path / "logs"
        self.events: list[Event] = []
        self.scenario_text = ""
        """`scenario.toml` as it is now."""
        self._digests: dict[str, dict[str, str]] = {}

    @classmethod
    def create(cls, path: Path | None, scenario: Scenario) -> RunFolder:
        """Make the folder, at `path` or as `runs/{name}-{seed}` with a number where that exists already.

        Never touches another run's files: a `path` that is not empty is refused.
        """
        default = RUNS / f"{scenario.run.name}-{scenario.run.seed}"
        with disk_errors(path or default):
            if path is not None and path.exists() and (not path.is_dir() or any(path.iterdir())):
                raise VnetError(f"--out {path}: exists and is not an empty folder")
            folder = cls(path or _claim(default))
            folder.logs.mkdir(parents=True)
            # Digests are those of the start: what is edited while the run is on has not been read.
            folder._digests = {"inputs": input_digests(scenario), "code": code_digests(scenario)}
            folder.put_scenario(scenario)
            (folder.path / EVENTS_FILE).touch()
            if path is None:
                _point_latest_to(folder.path)
        return folder

    @property
    def code(self) -> dict[str, str]:
        """The digests of program and vnet at the run's start."""
        return self._digests["code"]

    @property
    def scenario_path(self) -> Path:
        """The file that runs it again."""
        return self.path / SCENARIO_FILE

    def put_scenario(self, scenario: Scenario) -> None:
        """Write the scenario, with every default and the digests of what the run has read at its start."""
        self.scenario_text = dump_scenario(scenario, self._digests)
        self.put(SCENARIO_FILE, lambda path: write_text(path, self.scenario_text))

    def put_table(self, name: str, table: pa.Table) -> None:
        """Write a table as Parquet in one step."""
        self.put(name, lambda path: pq.write_table(table, path, compression="zstd"))

    def event(self, time_ns: int, kind: str, node: str | None = None, **details: Any) -> None:
        """Write down what happened at an emulated instant."""
        event = Event(time_ns, kind, node, details)
        self.events.append(event)
        line = json.dumps({"time_ns": time_ns, "kind": kind, "node": node, **details})
        with disk_errors(self.path), (self.path / EVENTS_FILE).open("a") as file:
            file.write(line + "\n")

    def put(self, name: str, write: Callable[[Path], None]) -> None:
        """Have `write` make a file beside its place, then move it there in one step."""
        with atomically(self.path / name) as part:
            write(part)

    def put_json(self, name: str, data: dict[str, Any]) -> None:
        """Write a JSON file in one step."""
        self.put(name, lambda path: write_text(path, json.dumps(data, indent=2) + "\n"))


def write_text(path: Path, text: str) -> None:
    """Write a text file, for `RunFolder.put`."""
    path.write_text(text)


def _claim(path: Path) -> Path:
    """Make the first of path, path-2, path-3 … that does not exist; two runs that start at once get two."""
    for number in count(1):
        candidate = path if number == 1 else path.with_name(f"{path.name}-{number}")
        with contextlib.suppress(FileExistsError):
            candidate.mkdir(parents=True)
            return candidate
    raise AssertionError("count() ends")


def _point_latest_to(path: Path) -> None:
    link = path.parent / "latest"
    fresh = path.parent / f".latest-{os.getpid()}"
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(path.name)
    fresh.replace(link)
