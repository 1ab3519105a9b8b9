"""The folder of a run: everything that is kept of it, written so that an interruption leaves it readable.

`scenario.toml` first, `events.jsonl` line by line as things happen, tables, `world.npz` and `verdict.json` at the
end, each put in place in one step. `recorded_run` reads it.

`files/NODE/` has what vehicles have left on their disks, copied at the end of a run, bounded, and nothing else.
Disks are what programs made of them: links are not followed, only regular files are read, and names stay below the
folder of their vehicle.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emulator.records.code_digest import code_digests, rule_digests
from emulator.records.disk import atomically, check_is_free, disk_errors
from emulator.records.events import Event, EventKind
from emulator.scenario.loading import dump_scenario, input_digests
from emulator.scenario.scenario import Scenario
from vnet.errors import VnetError, check_utf8
from vnet.units import BYTES_PER_MB

if TYPE_CHECKING:
    import pyarrow as pa

RUNS = Path("runs")
SCENARIO_FILE = "scenario.toml"
EVENTS_FILE = "events.jsonl"
WORLD_FILE = "world.npz"
VERDICT_FILE = "verdict.json"
MARKS = (SCENARIO_FILE, VERDICT_FILE, EVENTS_FILE)
"""A folder with any of these is a run's."""
MANIFEST_FILE = "manifest.json"
REPORT, INDEX, RECORDING = "report.html", "index.html", "recording.rrd"
"""Names of a run's report and recording, and of the list of the runs in a folder."""
PROGRAMS_LOG = "programs.txt"
"""File in `logs`, none of a vehicle, of what programs print where standard output is for the result alone."""
FILES = "files"
"""The folder, in a run's own, of what vehicles have left on their disks."""
AGAIN = "again"
"""The folder, in a run's own, of the second run of `--check-determinism`."""
VERDICT_ROOM_BYTES = 1 << 16
"""Size of most verdicts, with their manifests."""
PLAIN = ("size_bytes", "payload_digest", "copy")
"""Columns of tables, beside times, that are written without a dictionary."""
FORMAT = 5
"""Version of the folder's files; `verdict.json` holds it. docs/reference/files.md says what changed with each."""

MOST_FILES = 1000
"""Files of a vehicle that are kept."""
DEEPEST = 16
"""Levels of folders of a vehicle that are kept."""
MOST_NAMED = 3
"""Names of files that were left out which are told; all are counted."""


class RunFolder:
    """A run's folder; see the module's text. All methods raise VnetError where the disk does not play along.

    `prepare` touches nothing on the disk; until `open` has made the folder, events are kept for it. `out` is where
    it is wanted, or None for `runs/{name}-{seed}`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.events: list[Event] = []
        self._foreseen: list[Event] = []
        self.scenario_text = ""
        """`scenario.toml` as it is now."""
        self._digests: dict[str, dict[str, str]] = {}
        self.is_open = False
        """True once there is a folder, whose files are kept."""
        self._has_own_number = self._is_scratch = False
        self._events_file = path
        """The file of events, wherever a program changes to."""
        self._lacks_events = False
        self.unkept: list[str] = []
        """A line for each file that the disk has refused at the end of the run."""

    @classmethod
    def prepare(cls, out: Path | None, scenario: Scenario) -> RunFolder:
        """Return the folder that `open` will make. Raises VnetError for an `out` not empty, or not UTF-8."""
        path = out or RUNS / f"{scenario.run.name}-{scenario.run.seed}"
        with disk_errors(path):
            check_utf8(str(path.absolute()))
            if out is not None:
                check_is_free(out, "--out ")
        folder = cls(path)
        folder._has_own_number = out is None
        # Digests are those of the start: what is edited while the run is on has not been read.
        folder._digests = _digests(scenario)
        return folder

    @classmethod
    def create(cls, out: Path | None, scenario: Scenario) -> RunFolder:
        """Prepare and make the folder."""
        folder = cls.prepare(out, scenario)
        folder.open(scenario)
        return folder

    @classmethod
    def scratch(cls, path: Path) -> RunFolder:
        """Return the folder of a run of which nothing is kept: only logs and disks of its programs are written.

        What an earlier run has left in it is removed.
        """
        folder = cls(path)
        folder._is_scratch = True
        with disk_errors(path):
            folder.logs.mkdir(parents=True, exist_ok=True)
            if any(each != folder.logs for each in path.iterdir()) or any(folder.logs.iterdir()):
                shutil.rmtree(path)
                folder.logs.mkdir(parents=True)
        return folder

    def open(self, scenario: Scenario) -> None:
        """Make the folder, with a number where `runs/{name}-{seed}` exists already."""
        with disk_errors(self.path):
            if self._has_own_number:
                self.path = _claim(self.path)
            self.logs.mkdir(parents=True, exist_ok=self._is_scratch)
            self._digests = self._digests or _digests(scenario)
            self.is_open = True
            self.put_scenario(scenario)
            self._events_file = (self.path / EVENTS_FILE).absolute()
            self._events_file.write_text("".join(event.line() for event in self.events))
            if self._has_own_number or self.path.absolute().parent == RUNS.absolute():
                _point_latest_to(self.path)

    @property
    def logs(self) -> Path:
        """The folder of the logs of the run's processes."""
        return self.path / "logs"

    @property
    def disks(self) -> Path:
        """The folder of the vehicles' disks while the run is on."""
        return self.path / "disks"

    @property
    def code(self) -> dict[str, str]:
        """The digests of program and vnet at the run's start."""
        return self._digests["code"]

    @property
    def scenario_path(self) -> Path:
        """The file that runs it again."""
        return self.path / SCENARIO_FILE

    def add_rules(self, scenario: Scenario) -> None:
        """Write the scenario with the digest of the rules of the user's own that it has got since the start."""
        self._digests["code"] |= rule_digests(scenario)
        self.put_scenario(scenario)

    def put_scenario(self, scenario: Scenario) -> None:
        """Write the scenario, with every default and the digests of what the run has read at its start."""
        if not self.is_open:
            return
        self.scenario_text = dump_scenario(scenario, self._digests)
        self.put(SCENARIO_FILE, lambda path: write_text(path, self.scenario_text))

    def keep_table(self, name: str, table: pa.Table) -> None:
        """Keep a table as Parquet, as `keep` does."""
        import pyarrow as pa
        import pyarrow.parquet as pq  # slow to import, and a command's first line comes before any table

        # Readers that look for a span of time skip the rest of a file; the least and most of others only take time.
        how: dict[str, Any] = {"compression": "zstd", "write_statistics": ["sent_ns", "time_ns"]}
        # Dictionaries of times are long, and numbers of few values are as small without one.
        if not any(pa.types.is_nested(each.type) for each in table.schema):
            names = table.column_names
            how["use_dictionary"] = [each for each in names if not each.endswith("_ns") and each not in PLAIN]
        self.keep(name, lambda path: pq.write_table(table, path, **how))

    def event(self, time_ns: int, kind: EventKind, node: str | None = None, **details: Any) -> None:
        """Write down what happened at an emulated instant, after all that was foreseen for an earlier one."""
        self.reach(time_ns - 1)
        self._write(Event(time_ns, kind.value, node, details))

    def foresee(self, time_ns: int, kind: EventKind, node: str | None = None, **details: Any) -> None:
        """Write down what happens at an instant that others may not have come to, once they have."""
        self._foreseen.append(Event(time_ns, kind.value, node, details))

    def reach(self, time_ns: int) -> None:
        """Write what has been foreseen until `time_ns`."""
        due = sorted((e for e in self._foreseen if e.time_ns <= time_ns), key=lambda event: event.time_ns)
        if due:
            self._foreseen = [event for event in self._foreseen if event.time_ns > time_ns]
        for event in due:
            self._write(event)

    def _write(self, event: Event) -> None:
        self.events.append(event)
        if self.is_open and not self._lacks_events:
            try:
                with self._events_file.open("a") as file:
                    file.write(event.line())
            except OSError:  # the run goes on, and writes them all at its end
                self._lacks_events = True

    def complete_events(self) -> None:
        """Write the events that the disk has refused while the run was on."""
        if self._lacks_events:
            self.keep(EVENTS_FILE, lambda path: write_text(path, "".join(event.line() for event in self.events)))

    def keep(self, name: str, write: Callable[[Path], None]) -> None:
        """Put a file of a run that is over; if the disk refuses, name it in `unkept`: the others are kept."""
        try:
            self.put(name, write)
        except VnetError as error:
            self.unkept.append(str(error))

    def put(self, name: str, write: Callable[[Path], None]) -> None:
        """Have `write` make a file beside its place, then move it there in one step."""
        with atomically(self.path / name) as part:
            write(part)

    def put_json(self, name: str, data: dict[str, Any]) -> None:
        """Write a JSON file in one step."""
        self.put(name, lambda path: write_text(path, json.dumps(data, indent=2) + "\n"))


def _digests(scenario: Scenario) -> dict[str, dict[str, str]]:
    return {"inputs": input_digests(scenario), "code": code_digests(scenario)}


def write_text(path: Path, text: str) -> None:
    """Write a text file, for `RunFolder.put`."""
    path.write_text(text)


def _claim(path: Path) -> Path:
    """Make the first of path, path-2, path-3 … that does not exist; two runs that start at once get two."""
    path.parent.mkdir(parents=True, exist_ok=True)  # a link to nowhere exists, too, and is none
    for number in count(1):
        candidate = path if number == 1 else path.with_name(f"{path.name}-{number}")
        with suppress(FileExistsError):
            candidate.mkdir()
            return candidate
    raise AssertionError("count() ends")


def _point_latest_to(path: Path) -> None:
    link = path.parent / "latest"
    if link.is_dir() and not link.is_symlink():  # somebody's own
        return
    fresh = path.parent / f".latest-{os.getpid()}"
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(path.name)
    fresh.replace(link)


# What a folder is.


class LaterFormatError(VnetError):
    """A folder is of a format that a later vnet writes."""


def is_run_folder(folder: Path) -> bool:
    """Return whether a folder is that of a run, broken ones included."""
    return any((folder / mark).is_file() for mark in MARKS)


def check_is_run(folder: Path) -> None:
    """Raise VnetError if the folder has no scenario, and so is not a run's."""
    if not (folder / SCENARIO_FILE).is_file():
        raise VnetError(f"{folder}: not a run's folder: there is no {SCENARIO_FILE} in it")


def check_is_finished(folder: Path) -> None:
    """Raise VnetError if the folder is that of a run without a verdict: it is on, or was killed."""
    if (folder / SCENARIO_FILE).is_file() and not (folder / VERDICT_FILE).exists():
        raise not_finished(folder, VERDICT_FILE)


def not_finished(folder: Path, name: str) -> VnetError:
    """Return the error for a run's folder without a file that the end of a run writes; it says what to do."""
    text = f"{folder}: not the folder of a finished run: there is no {name} in it"
    scenario = folder / SCENARIO_FILE
    if (folder / VERDICT_FILE).exists() or not scenario.is_file():
        return VnetError(text)
    again = f"vnet run {shlex.quote(str(scenario))}"
    return VnetError(f"{text}: it is on, or was killed, which leaves no tables; {again} makes the run again")


@dataclass
class LeftOut:
    """Files and folders of a vehicle that were not kept: how many, and the first of them with the reason."""

    count: int = 0
    which: list[str] = field(default_factory=list)

    def add(self, name: str, reason: str) -> None:
        """Count one."""
        self.count += 1
        if self.count <= MOST_NAMED:
            self.which.append(f"{name[:100]}: {reason}".encode(errors="replace").decode())


def collect(folder: RunFolder, nodes: Iterable[str], most_mb: float) -> dict[str, LeftOut]:
    """Move the files of the disks to `files/` and remove the disks; return what was left out, by vehicle.

    Of each vehicle `most_mb` megabytes are kept.
    """
    left_out = {}
    for node in nodes:
        disk = folder.disks / node
        if disk.is_dir() and not disk.is_symlink():
            kept = _Collection(folder.path / FILES / node, round(most_mb * BYTES_PER_MB))
            kept.take(disk)
            if kept.left_out.count:
                left_out[node] = kept.left_out
    with suppress(RecursionError):  # folders a thousand deep
        shutil.rmtree(folder.disks, ignore_errors=True)
    return left_out


class _Collection:
    """Files of one vehicle on their way from its disk to `target`."""

    def __init__(self, target: Path, most_bytes: int) -> None:
        self.left_out = LeftOut()
        self._target = target
        self._bytes_left = most_bytes
        self._files_left = MOST_FILES

    def take(self, disk: Path) -> None:
        """Copy in the order of the names, folder by folder, what there is room for."""
        for name, depth, entry in self._entries(disk):
            if entry.is_symlink():
                self.left_out.add(name, "a link")
            elif entry.is_dir(follow_symlinks=False):
                if depth == DEEPEST:
                    self.left_out.add(name, f"more than {DEEPEST} folders deep")
            elif not entry.is_file(follow_symlinks=False):
                self.left_out.add(name, "no regular file")
            elif not self._files_left:
                self.left_out.add(name, f"more than {MOST_FILES} files")
            else:
                self._copy(name, Path(entry.path))

    def _entries(self, disk: Path) -> Iterator[tuple[str, int, os.DirEntry[str]]]:
        """Everything on a disk: its path there, the number of folders around it, and the entry."""
        folders = [("", 0, disk)]
        while folders:
            before, depth, folder = folders.pop()
            try:
                with os.scandir(folder) as found:
                    entries = sorted(found, key=lambda entry: entry.name)
            except OSError as error:
                self.left_out.add(before or ".", error.strerror or "cannot be read")
                continue
            for entry in entries:
                name = f"{before}{entry.name}"
                yield name, depth, entry
                if depth < DEEPEST and entry.is_dir(follow_symlinks=False):
                    folders.append((f"{name}/", depth + 1, Path(entry.path)))

    def _copy(self, name: str, source: Path) -> None:
        """Copy a file, as long as it is one and there is room."""
        try:
            number = os.open(source, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            self.left_out.add(name, error.strerror or "cannot be read")
            return
        with os.fdopen(number, "rb") as file:
            found = os.fstat(number)
            if not stat.S_ISREG(found.st_mode):
                self.left_out.add(name, "no regular file")
            elif found.st_size > self._bytes_left:
                self.left_out.add(name, f"{found.st_size:,} bytes, and there is room for {self._bytes_left:,}")
            else:
                target = self._target / name
                try:
                    target.parent.mkdir(parents=True, exist_ok=True)
                    with target.open("xb") as copy:
                        shutil.copyfileobj(file, copy)
                except OSError as error:  # a full disk: the run is kept all the same
                    target.unlink(missing_ok=True)
                    self.left_out.add(name, error.strerror or "cannot be written")
                    return
                self._bytes_left -= found.st_size
                self._files_left -= 1
