"""Probes of `--check-determinism`: the lines of programs that send and report, and another layout of addresses.

Both are asked for by variables of the environment, which processes of programs inherit however they are started.
"""

from __future__ import annotations

import os
import random
import sys
import zlib
from pathlib import Path
from types import FrameType

from vnet.node import Action
from vnet.radio import SentFrame
from vnet.reports import Report
from vnet.runtime.error_text import NOT_THE_PROGRAM
from vnet.transport.wire import SentMessage

CALLS_VARIABLE = "VNET_CALLS"
"""Folder to which each node writes its calls, a file a node."""
SCATTER_VARIABLE = "VNET_SCATTER"
"""Seed of addresses that programs would not have otherwise."""
_CALLS: dict[type, str] = {SentFrame: "frame", SentMessage: "message", Report: "report", Action: "action"}
_SIZES = range(32, 513, 16)
"""Sizes in bytes of the blocks that Python's allocator keeps in pools, beyond the least."""
_BYTES_HEADER = 33
"""Bytes of an object of type bytes beside its contents."""
_MOST_BLOCKS = 64
"""Blocks of one size that are held at once: 0.5 MB in all."""


class CallLog:
    """The calls of nodes in a folder, a line each: time in ns, kind, digest, and the line of the program."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def add(self, node: str, time_ns: int, item: object) -> None:
        """Write down a call of a node; at once, because the process may be killed."""
        self._folder.mkdir(parents=True, exist_ok=True)
        content = item.payload if isinstance(item, SentFrame | SentMessage) else repr(item).encode()
        line = f"{time_ns}\t{_CALLS[type(item)]}\t{zlib.crc32(content):08x}\t{_program_line(sys._getframe(2))}\n"
        with (self._folder / node).open("a") as file:
            file.write(line)


def _program_line(frame: FrameType | None) -> str:
    """Return file and line of the innermost frame of the program; a program of vnet's own is one, too."""
    outside = ""
    while frame is not None:
        name = frame.f_code.co_filename
        if not name.startswith(NOT_THE_PROGRAM):
            return f"{Path(name).name}:{frame.f_lineno}"
        if not outside and not name.startswith(NOT_THE_PROGRAM[0]):
            outside = f"{Path(name).name}:{frame.f_lineno}"
        frame = frame.f_back
    return outside


class ScatteredHeap:
    """Blocks of all small sizes that come and go, so that objects of programs get other addresses."""

    def __init__(self, seed: str) -> None:
        self._random = random.Random(seed)
        self._blocks: list[list[object]] = [[] for _ in (16, *_SIZES)]

    def scatter(self) -> None:
        """Hold some more blocks of each size and give back some others, which the next objects then get."""
        choose = self._random
        for size, blocks in zip((16, *_SIZES), self._blocks, strict=True):
            for _ in range(choose.randrange(1, 16)):
                blocks.append(_block(size))
            choose.shuffle(blocks)
            del blocks[choose.randrange(_MOST_BLOCKS) :]


def _block(size: int) -> object:
    """Return a new object of so many bytes that the collector does not count."""
    if size < 48:
        return object() if size == 16 else 2**40 + size
    return bytes(size - _BYTES_HEADER)


def call_log() -> CallLog | None:
    """Return the log of calls, if one is asked for."""
    folder = os.environ.get(CALLS_VARIABLE)
    return CallLog(Path(folder)) if folder else None


def scattered_heap() -> ScatteredHeap | None:
    """Return the blocks that scatter addresses, if they are asked for."""
    seed = os.environ.get(SCATTER_VARIABLE)
    return ScatteredHeap(seed) if seed else None
