"""The user's terminal, for a debugger in another process: lines of JSON over a Unix socket.

The process connects for as long as it asks, and sends `{"text": …, "prompt": …}`; each is answered with
`{"line": …}`, which is empty when the user has gone. `{"text": …, "quit": true}` ends the run.
"""

from __future__ import annotations

import io
import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any


class RemoteTerminal(io.TextIOBase):
    """Standard input and output of a debugger. The user answers at the socket `path`, within `open`."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._text: list[str] = []
        self._stream: IO[str] | None = None

    @contextmanager
    def open(self) -> Iterator[None]:
        """Connect to the user. Without a connection nobody answers."""
        with socket.socket(socket.AF_UNIX) as connection:
            with suppress(OSError):
                connection.connect(str(self._path))
                self._stream = connection.makefile("rw", encoding="utf-8")
            try:
                yield
            finally:
                self._say()
                self._stream = None

    def quit(self) -> None:
        """Tell that the user wants the run to end."""
        with self.open():
            self._say(quit=True)

    def write(self, text: str) -> int:
        """Keep text until something is asked, or the connection ends."""
        self._text.append(text)
        return len(text)

    def readline(self, size: int | None = -1, /) -> str:  # type: ignore[override]
        """Return the line that the user enters; "" when nobody answers."""
        text, newline, prompt = "".join(self._text).rpartition("\n")
        self._text = [text + newline]
        self._say(prompt=prompt)
        with suppress(OSError, ValueError):
            if self._stream is not None and (answer := self._stream.readline()):
                return str(json.loads(answer)["line"])
        return ""

    def _say(self, **message: Any) -> None:
        text, self._text = "".join(self._text), []
        if self._stream is not None and (text or message):
            with suppress(OSError):
                self._stream.write(json.dumps({"text": text, **message}) + "\n")
                self._stream.flush()
