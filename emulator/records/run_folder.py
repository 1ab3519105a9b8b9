"""The folder of a run: everything that is kept of it, written so that an interruption leaves it readable.

`scenario.toml` first, `events.jsonl` line by line as things happen, tables and `verdict.json` at the end, each
put in place in one step.
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

from emulator.records.atomic import disk_errors, whole
from emulator.scenario.scenario import Scenario, dump_scenario
from vnet.errors import VnetError

RUNS = Path("runs")
REPORT, INDEX, RECORDING = "report.html", "index.html", "recording.rrd"
"""Names of a run's report and recording, and of the list of the runs in a folder."""


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
            (folder.path / "scenario.toml").write_text(dump_scenario(scenario))
            (folder.path / "events.jsonl").touch()
            if path is None:
                _point_latest_to(folder.path)
        return folder

    def event(self, time_ns: int, kind: str, node: str | None = None, **details: Any) -> None:
        """Write down what happened at an emulated instant."""
        event = Event(time_ns, kind, node, details)
        self.events.append(event)
        line = json.dumps({"time_ns": time_ns, "kind": kind, "node": node, **details})
        with disk_errors(self.path), (self.path / "events.jsonl").open("a") as file:
            file.write(line + "\n")

    def put(self, name: str, write: Callable[[Path], None]) -> None:
        """Have `write` make a file beside its place, then move it there in one step."""
        with whole(self.path / name) as part:
            write(part)

    def put_json(self, name: str, data: dict[str, Any]) -> None:
        """Write a JSON file in one step."""
        self.put(name, lambda path: write_text(path, json.dumps(data, indent=2) + "\n"))


def check_is_run(folder: Path) -> None:
    """Raises VnetError if the folder is not a run's."""
    if not (folder / "scenario.toml").is_file():
        raise VnetError(f"{folder}: not a run's folder: there is no scenario.toml in it")


def read_events(folder: Path) -> list[Event]:
    """The events of a run. Raises VnetError if they cannot be read."""
    events = []
    try:
        lines = (folder / "events.jsonl").read_text().splitlines()
    except OSError as error:
        raise VnetError(f"{folder}: not a run's folder: events.jsonl: {error.strerror}") from None
    for line in lines:
        try:
            data = json.loads(line)
            events.append(Event(data.pop("time_ns"), data.pop("kind"), data.pop("node"), data))
        except (ValueError, KeyError, AttributeError):
            continue  # the last line of a run that was killed
    return events


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
