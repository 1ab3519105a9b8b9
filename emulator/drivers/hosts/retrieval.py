"""Logs and files of the agents of a host, on their way into the run's folder.

A host hands in the end of each log and what a run's folder would keep of each disk; the emulator writes only below
the folders of the host's own vehicles, and no more than that.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

from emulator.drivers.hosts.messages import PART_BYTES, Item, LeftOut, Part
from emulator.drivers.processes import ProtocolError
from emulator.records.events import EventKind
from emulator.records.node_files import DEEPEST, MOST_FILES, collect
from emulator.records.run_folder import FILES, RunFolder
from vnet.errors import printable
from vnet.units import BYTES_PER_MB

MOST_LOG_BYTES = 16 * 2**20
"""Bytes of the end of a process's log that are handed in."""


def hand_in(path: Path, processes: Sequence[Sequence[str]], files_max_mb: float) -> Iterator[Item]:
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
                yield Part("file", node, str(file.relative_to(root)), data)
        if node in left_out:
            yield LeftOut("file", node, left_out[node].count, left_out[node].which)


def _log(folder: RunFolder, process_id: str) -> Iterator[Item]:
    log = folder.logs / f"{process_id}.log"
    if not log.exists():
        return
    start = max(log.stat().st_size - MOST_LOG_BYTES, 0)
    if start:
        yield LeftOut("log", process_id, start)
    for data in _parts(log, start):
        yield Part("log", process_id, "", data)


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

    def take(self, part: Part) -> None:
        """Write the next bytes of a log or a file. Raises ProtocolError for what does not belong there."""
        path = self._path(part)
        self._taken_bytes[part.kind, part.owner] += len(part.data)
        if self._taken_bytes[part.kind, part.owner] > self._most_bytes[part.kind]:
            raise ProtocolError(f"more bytes of {part.owner} than are kept")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("ab") as file:
                file.write(part.data)
        except OSError as error:
            raise ProtocolError(f"{part.kind} of {part.owner}: {error.strerror}") from None

    def tell_left_out(self, time_ns: int, left_out: LeftOut) -> None:
        """Write an event about what a host could not hand in. Raises ProtocolError for another's."""
        self._check_owner(left_out.kind, left_out.owner)
        if left_out.kind == "log":
            self._folder.event(time_ns, EventKind.log_left_out, left_out.owner, bytes=left_out.count)
        else:
            which = [printable(each, 300) for each in left_out.which[:3]]
            self._folder.event(time_ns, EventKind.files_left_out, left_out.owner, count=left_out.count, which=which)

    def _check_owner(self, kind: str, owner: str) -> None:
        if owner not in (self._logs if kind == "log" else self._nodes):
            raise ProtocolError(f"{kind} of {owner!r}, which is not on this host")

    def _path(self, part: Part) -> Path:
        """Return where a part belongs: in the logs, or on a disk, from which the run's folder takes its files."""
        self._check_owner(part.kind, part.owner)
        if part.kind == "log":
            return self._folder.logs / f"{part.owner}.log"
        path = PurePosixPath(part.path)
        self._files.add((part.owner, part.path))
        if path.is_absolute() or not path.parts or ".." in path.parts or "\0" in part.path:
            raise ProtocolError(f"file {part.path[:100]!r} of {part.owner}: not below its folder")
        if len(path.parts) > DEEPEST + 1 or len(self._files) > MOST_FILES * len(self._nodes):
            raise ProtocolError(f"file {part.path[:100]!r} of {part.owner}: too deep, or one too many")
        return self._folder.disks / part.owner / path
