"""Commands of the documentation that go on while the reader types others, each in a terminal of its own."""

import fcntl
import re
import shlex
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tests.docs.commands import DocsError
from tests.support.forked_commands import AGENT, VNET, Command

TIMEOUT_S = 120.0
"""Seconds of wall clock until a command must have printed what it should, or ended."""
INTERRUPTED = 130
"""Exit status by which a comment says that the reader ends the command with Ctrl-C."""
_PORT = re.compile(r"127\.0\.0\.1:(\d+)")


class Terminals:
    """Starts commands, and sees to it that all have ended as they should when it is closed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stack = ExitStack()
        self._started: list[tuple[str, subprocess.Popen[Any], Path, int]] = []
        self._ports: set[str] = set()

    def start(self, words: Sequence[str], process: Sequence[str], status: int, place: str) -> None:
        """Start the command that the page writes as `words` at `place`; it is to end with `status`."""
        for port in _PORT.findall(shlex.join(words)):
            self._reserve(port)
        printed = self._folder.parent / f"{self._folder.name}.terminal-{len(self._started)}.log"
        with printed.open("wb") as log:
            start = Command if list(process[: len(VNET)]) in (VNET, AGENT) else subprocess.Popen
            started = start(process, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT)
        self._stack.callback(started.wait)
        self._stack.callback(started.kill)
        self._started.append((f"{place}: {shlex.join(words)}", started, printed, status))

    def wait_for(self, is_shown: Callable[[str], bool]) -> None:
        """Wait until the newest command has printed what its page shows. Raises DocsError."""
        command, started, printed, _ = self._started[-1]
        until_s = time.monotonic() + TIMEOUT_S
        while not is_shown(text := printed.read_text(encoding="utf-8")):
            if started.poll() is not None or time.monotonic() > until_s:
                raise DocsError(f"{command}: this is not what it prints:\n{text}")
            time.sleep(0.05)

    def end(self) -> None:
        """Wait for all commands, and end those that the page ends with Ctrl-C. Raises DocsError."""
        for command, started, printed, status in reversed(self._started):
            if status == INTERRUPTED:
                started.send_signal(signal.SIGINT)
            try:
                ended = started.wait(TIMEOUT_S)
            except subprocess.TimeoutExpired:
                raise DocsError(f"{command}: does not end:\n{printed.read_text()}") from None
            if ended != status:
                raise DocsError(f"{command}: exit status {ended}, and not {status}:\n{printed.read_text()}")

    def close(self) -> None:
        """Kill what is left."""
        self._stack.close()

    def _reserve(self, port: str) -> None:
        """Have other tests, of this session or another, wait for a port that a page names."""
        if port not in self._ports:
            self._ports.add(port)
            path = Path(tempfile.gettempdir()) / f"vnet-docs-port-{port}.lock"
            lock = self._stack.enter_context(path.open("w"))
            fcntl.flock(lock, fcntl.LOCK_EX)
