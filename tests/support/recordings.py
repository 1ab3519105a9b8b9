"""Reading recordings back, for tests."""

import subprocess
import warnings
from collections import defaultdict
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader

from emulator.viewer.drawing import TIMELINE


@dataclass
class Entity:
    """Drawing of one entity: components that are always there, and by time (s)."""

    static: dict[str, Any] = field(default_factory=dict)
    at: dict[str, dict[float, Any]] = field(default_factory=lambda: defaultdict(dict))

    def array(self, component: str, time_s: float) -> np.ndarray:
        """One component at one time."""
        return np.array(self.at[component][time_s], dtype=float)


def read_back(path: Path) -> dict[str, Entity]:
    """All entities of a recording by path, components by `Archetype:field`."""
    entities: dict[str, Entity] = defaultdict(Entity)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a recording has not been closed
        chunks = RrdReader(str(path)).stream()
    for chunk in chunks:
        entity = entities[str(chunk.entity_path)]
        batch = chunk.to_record_batch()
        times = batch.column(TIMELINE).cast("int64").to_pylist() if TIMELINE in batch.schema.names else None
        for name in batch.schema.names:
            if ":" not in name:
                continue
            for row, value in enumerate(batch.column(name).to_pylist()):
                if value is None:
                    continue
                if times is None:
                    entity.static[name] = value
                else:
                    entity.at[name][times[row] / 1e9] = value
    return dict(entities)


RERUN = Path(str(resources.files("rerun_cli"))) / "rerun"
"""The program itself: half a second before it, `python -m rerun` has imported Rerun."""


def rrd(*arguments: str) -> subprocess.CompletedProcess[str]:
    """`rerun rrd …`."""
    return subprocess.run([RERUN, "rrd", *arguments], capture_output=True, text=True)


def listening_addresses(pid: int) -> set[str]:
    """The addresses, as ADDRESS:PORT, that a process listens at, as /proc says it; IPv4 and IPv6."""
    sockets = set()
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        try:
            target = str(descriptor.readlink())
        except OSError:
            continue
        if target.startswith("socket:["):
            sockets.add(target[8:-1])
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            _, local, _, state, *rest = line.split()
            if state == "0A" and rest[5] in sockets:
                address, port = local.split(":")
                if table == "tcp":
                    address = ".".join(str(byte) for byte in bytes.fromhex(address)[::-1])
                found.add(f"{address}:{int(port, 16)}")
    return found


def descendants(pid: int) -> set[int]:
    """A process and all that it, and they, have started."""
    found = {pid}
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        found |= descendants(int(child))
    return found
