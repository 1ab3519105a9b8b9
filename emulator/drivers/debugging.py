"""The user's terminal for the debugger of a live run, whose vehicle is another process.

The vehicle connects to a Unix socket in a folder that is its user's alone, and what it asks is asked here
(`vnet/runtime/debugger.py`). The emulator's loop is blocked meanwhile: in lockstep all wait for that
vehicle anyway.
"""

from __future__ import annotations

import asyncio
import json
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import IO, NoReturn

from emulator.drivers.signals import signals_handled
from vnet.runtime.debug_target import DebugTarget

Ask = Callable[[str], str]
"""Asks the user for a line, with a prompt. Raises EOFError when there is no user any more."""


@dataclass(frozen=True)
class DebugPoint:
    """The debugger of a live run: its target, and the socket at which its user answers."""

    target: DebugTarget
    socket: Path


class _Terminated(BaseException):
    """SIGTERM has come while the user was asked."""


@contextmanager
def debug_point(target: DebugTarget | None, ask: Ask = input) -> Iterator[DebugPoint | None]:
    """Answer, on the running loop and within the block, what the debugger of `target` asks; None needs none."""
    if target is None:
        yield None
        return
    with TemporaryDirectory(prefix="vnet-debug-") as folder, socket.socket(socket.AF_UNIX) as listener:
        path = Path(folder) / "terminal"
        listener.bind(str(path))
        listener.listen()
        loop = asyncio.get_running_loop()
        loop.add_reader(listener, _answer, listener, ask)
        try:
            yield DebugPoint(target, path)
        finally:
            loop.remove_reader(listener)


def _answer(listener: socket.socket, ask: Ask) -> None:
    """Talk to a debugger that has connected, until it goes on; then do what a signal meanwhile has asked for."""
    connection, _ = listener.accept()
    ends: signal.Signals | None = None
    with connection, connection.makefile("rw", encoding="utf-8") as stream:
        try:
            with (
                signals_handled(signal.default_int_handler, signal.SIGINT),
                signals_handled(_terminate, signal.SIGTERM),
            ):
                ends = signal.SIGINT if _talk(stream, ask) else None
        except KeyboardInterrupt:
            ends = signal.SIGINT
        except _Terminated:
            ends = signal.SIGTERM
        except OSError:  # the vehicle has gone
            pass
        with suppress(OSError):
            stream.close()
    if ends is not None:
        signal.raise_signal(ends)


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    raise _Terminated


def _talk(stream: IO[str], ask: Ask) -> bool:
    """Show what the debugger says and answer what it asks; returns whether the run is to end."""
    for line in stream:
        message = json.loads(line)
        print(message["text"], end="", flush=True)
        if message.get("quit"):
            return True
        if "prompt" in message:
            stream.write(json.dumps({"line": _asked(message["prompt"], ask)}) + "\n")
            stream.flush()
    return False


def _asked(prompt: str, ask: Ask) -> str:
    """Return the line that the user enters, "" at the end of input. Ctrl-C drops what was typed, as in pdb."""
    while True:
        try:
            return ask(prompt) + "\n"
        except EOFError:
            print()
            return ""
        except KeyboardInterrupt:
            print("\n--KeyboardInterrupt--")
