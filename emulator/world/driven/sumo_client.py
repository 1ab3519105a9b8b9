"""The emulator's end of the pipes to the process in which SUMO runs: requests, answers, and its end."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import select
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from pathlib import Path
from typing import IO, TypeVar

import msgspec

from emulator.scenario.network import LIBSUMO
from emulator.world.driven.sumo_messages import LENGTH_BYTES, TIED, Answer, Failure, Request, decode_answer, write
from vnet.errors import ScenarioError, VnetError, printable

CHILD = "emulator.world.driven.sumo_process"
CLOSE_S = 5.0
"""Wall-clock seconds for which SUMO may write its files at the end of a run."""
EXPLAIN_LINES = 3
"""Lines of SUMO's errors that are shown."""
LARGEST_ERRORS = 1 << 16
"""Bytes at the end of SUMO's output that are searched for them."""
A = TypeVar("A", bound=msgspec.Struct)


def require_libsumo(path: Path) -> None:
    """Raise ScenarioError unless libsumo is installed; `path` is the configuration that needs it."""
    if importlib.util.find_spec(LIBSUMO) is None:
        raise ScenarioError(
            f"{path}: network.step = true: libsumo is not installed: pip install 'vnet-emulator[sumo]'"
        )


class SumoProcess:
    """A process with one simulation of SUMO. It ends with this object, and with this process, however that ends.

    `path` is the configuration, which errors name. Answers take `timeout_s` of wall-clock time at most.
    """

    def __init__(self, path: Path, timeout_s: float) -> None:
        self._path, self.timeout_s = path, timeout_s
        # The kernel tells the end of the thread that has started a process, not that of its process.
        tied = [TIED] if threading.current_thread() is threading.main_thread() else []
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 (closed with the process)
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", CHILD, *tied],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            bufsize=0,
            start_new_session=True,  # Ctrl-C is for the emulator, which then ends it
        )
        self.has_failed = False
        self._end = weakref.finalize(self, _kill, self._process, self._errors, os.getpid())

    @property
    def pid(self) -> int:
        """Id of the process."""
        return self._process.pid

    def ask(self, request: Request, kind: type[A]) -> A:
        """Return the answer to a request, of this kind. Raise VnetError, in one line, if SUMO fails, and end it."""
        assert self._process.stdin is not None
        try:
            write(self._process.stdin, request)  # type: ignore[arg-type]
            answer = self._read()
        except TimeoutError:  # an OSError, too
            answer = Failure(f"no answer for {self.timeout_s:g} s")
        except (OSError, EOFError):
            answer = Failure(self._reason_of_end())
        except msgspec.MsgspecError as error:
            answer = Failure(f"an answer that is none: {error}")
        except BaseException:  # Ctrl-C in between: the next answer would be that to this request
            self.has_failed = True
            self._end()
            raise
        if isinstance(answer, Failure):
            raise self._failed(answer.reason)
        assert isinstance(answer, kind), (answer, kind)
        return answer

    def close(self) -> None:
        """End SUMO, which may write its files first."""
        if self._end.alive and self._process.stdin is not None:
            self._process.stdin.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(CLOSE_S)
            self._end()

    def kill(self) -> None:
        """End SUMO at once."""
        self._end()

    def _read(self) -> Answer:
        """Return the next answer. Raise EOFError if the process has ended, TimeoutError if it takes too long."""
        deadline_s = time.monotonic() + self.timeout_s
        length = int.from_bytes(self._bytes(LENGTH_BYTES, deadline_s), "big")
        return decode_answer(self._bytes(length, deadline_s))

    def _bytes(self, count: int, deadline_s: float) -> bytes:
        assert self._process.stdout is not None
        pipe, read = self._process.stdout.fileno(), bytearray()
        while len(read) < count:
            ready, _, _ = select.select([pipe], [], [], max(0.0, deadline_s - time.monotonic()))
            if not ready:
                raise TimeoutError
            part = os.read(pipe, count - len(read))
            if not part:
                raise EOFError
            read += part
        return bytes(read)

    def _failed(self, reason: str) -> VnetError:
        """Return the error of a simulation that goes no further, which ends with it."""
        self.has_failed = True
        said = self._said()
        self._end()
        return VnetError(f"{self._path}: SUMO: {' '.join(said) or printable(reason, 300)}")

    def _reason_of_end(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            status = self._process.wait(CLOSE_S)
            return f"it was ended by signal {-status}" if status < 0 else f"it ended with exit status {status}"
        return "its pipe is closed"

    def _said(self) -> list[str]:
        """Return the first errors that SUMO has printed."""
        size = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, size - LARGEST_ERRORS))
        lines = self._errors.read().decode(errors="replace").splitlines()
        return [line.strip() for line in lines if line.startswith("Error")][:EXPLAIN_LINES]


def _kill(process: subprocess.Popen[bytes], errors: IO[bytes], owner: int) -> None:
    """End a process, at the latest when the one that started it ends; not when a fork of that does."""
    if os.getpid() == owner:
        process.kill()
        process.wait()
    for file in (process.stdin, process.stdout, errors):
        if file is not None:
            with contextlib.suppress(OSError):
                file.close()
