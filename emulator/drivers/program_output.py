"""Output of simulated programs: it goes to the terminal, and to `logs/NODE.log` as in a run of many processes."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from emulator.records.node_files import NodeLogs
from vnet.node import Node
from vnet.runtime.outside_loop import present_node

_lock = threading.Lock()
_simulations: list[tuple[Callable[[Node], bool], NodeLogs]] = []


@contextmanager
def output_kept(is_its_own: Callable[[Node], bool], logs: NodeLogs) -> Iterator[None]:
    """Write to `logs`, too, what is printed on behalf of the nodes that are a simulation's own within the block.

    What is printed on nobody's behalf, as by a module that is imported, goes to the terminal alone.
    """
    simulation = (is_its_own, logs)
    with _lock:
        _simulations.append(simulation)
        if not isinstance(sys.stdout, _Branched):
            sys.stdout = _Branched(sys.stdout)
        if not isinstance(sys.stderr, _Branched):
            sys.stderr = _Branched(sys.stderr)
    try:
        yield
    finally:
        with _lock:
            _simulations.remove(simulation)
            if not _simulations:
                sys.stdout, sys.stderr = _trunk(sys.stdout), _trunk(sys.stderr)
        logs.end_lines()


class _Branched:
    """Stands for stdout or stderr while programs run; all but what it also writes to logs is that of `stream`."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write to the stream, and to the log of the node on whose behalf the present code runs."""
        written: int = self.stream.write(text)
        node = present_node()
        if node is not None:
            for is_its_own, logs in tuple(_simulations):
                if is_its_own(node):
                    logs.add(node.id, text)
        return written

    def writelines(self, lines: Iterable[str]) -> None:
        """Write each of these texts."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def _trunk(stream: Any) -> Any:
    return stream.stream if isinstance(stream, _Branched) else stream
