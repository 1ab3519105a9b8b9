"""Logs and files of the agents of a host, on their way into the run's folder.

A host hands in the end of each log and what a run's folder would keep of each disk; the emulator writes only below
the folders of the host's own vehicles, and no more than that.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

from emulator.drivers.hosts.messages import PART_BYTES, Call
from emulator.drivers.processes import ProtocolError
from emulator.records.events import EventKind
from emulator.records.run_folder import DEEPEST, FILES, MOST_FILES, RunFolder, collect
from vnet.errors import printable
from vnet.units import BYTES_PER_MB

MOST_LOG_BYTES = 16 * 2**20
"""Bytes of the end of a process's log that are handed in."""


def hand_in(path: Path, processes: Sequence[Sequence[str]], files_max_mb: float) -> Iterator[Call]:
    """Yield the logs of processes and the files of their nodes, which are in the host's folder at `path`.

    The folder is laid out as that of a run; its disks are gone afterwards.
    """
    folder = RunFolder(path)
    for nodes in processes:
        yield from _log(folder, nodes[0])
    nodes_here = [node for nodes in processes for node in nodes]
    left_out = collect(folder, nodes_here, files_max_mb)
    for node in nodes_here:
        root = folder.path / FILES / node
        for file in sorted(path for path in root.rglob("*") if path.is_file()):
            for data in _parts(file, 0):
                yield "part", "file", node, str(file.relative_to(root)), data
        if node in left_out:
            yield "left_out", "file", node, left_out[node].count, list(left_out[node].which)


def _log(folder: RunFolder, process_id: str) -> Iterator[Call]:
    log = folder.logs / f"{process_id}.log"
    if not log.exists():
        return
    start = max(log.stat().st_size - MOST_LOG_BYTES, 0)
    if start:
        yield "left_out", "log", process_id, start, []
    for data in _parts(log, start):
        yield "part", "log", process_id, "", data


def _parts(file: Path, start: int) -> Iterator[bytes]:
    """Yield the bytes of a file from `start`, a part at a time; one empty part if there are none."""
    with file.open("rb") as opened:
        opened.seek(start)
        yield opened.read(PART_BYTES)
        while data := opened.read(PART_BYTES):
            yield data


class Retrieval:
    """The emulator's side: writes what a host hands in of its `processes` (their nodes) into the run's folder."""

    def __init__(self, folder: RunFolder, processes: Sequence[Sequence[str]], files_max_mb: float) -> None:
        self._folder = folder
        self._logs = {nodes[0] for nodes in processes}
        self._nodes = {node for nodes in processes for node in nodes}
        self._most_bytes = {"log": MOST_LOG_BYTES, "file": round(files_max_mb * BYTES_PER_MB)}
        self._taken_bytes: Counter[tuple[str, str]] = Counter()
        self._files: set[tuple[str, str]] = set()

    def take(self, kind: str, owner: str, path: str, data: bytes) -> None:
        """Write the next bytes of a log or a file. Raises ProtocolError for what does not belong there."""
        place = self._path(kind, owner, path)
        self._taken_bytes[kind, owner] += len(data)
        if self._taken_bytes[kind, owner] > self._most_bytes[kind]:
            raise ProtocolError(f"more bytes of {owner} than are kept")
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
            with place.open("ab") as file:
                file.write(data)
        except OSError as error:
            raise ProtocolError(f"{kind} of {owner}: {error.strerror}") from None

    def tell_left_out(self, time_ns: int, kind: str, owner: str, count: int, which: Sequence[str]) -> None:
        """Write an event about what a host could not hand in. Raises ProtocolError for another's."""
        self._check_owner(kind, owner)
        if kind == "log":
            self._folder.event(time_ns, EventKind.log_left_out, owner, bytes=count)
        else:
            first = [printable(each, 300) for each in which[:3]]
            self._folder.event(time_ns, EventKind.files_left_out, owner, count=count, which=first)

    def _check_owner(self, kind: str, owner: str) -> None:
        if owner not in (self._logs if kind == "log" else self._nodes):
            raise ProtocolError(f"{kind} of {owner!r}, which is not on this host")

    def _path(self, kind: str, owner: str, name: str) -> Path:
        """Return where a part belongs: in the logs, or on a disk, from which the run's folder takes its files."""
        self._check_owner(kind, owner)
        if kind == "log":
            return self._folder.logs / f"{owner}.log"
        path = PurePosixPath(name)
        self._files.add((owner, name))
        if path.is_absolute() or not path.parts or ".." in path.parts or "\0" in name:
            raise ProtocolError(f"file {name[:100]!r} of {owner}: not below its folder")
        if len(path.parts) > DEEPEST + 1 or len(self._files) > MOST_FILES * len(self._nodes):
            raise ProtocolError(f"file {name[:100]!r} of {owner}: too deep, or one too many")
        return self._folder.disks / owner / path
