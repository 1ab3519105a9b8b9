"""Waiting for processes, and for what they do."""

import os
import select
import subprocess
import time
from collections.abc import Callable
from typing import Any

TIMEOUT_S = 300
"""Only against hanging for ever; nothing is judged by how long it takes."""


def wait_until(is_so: Callable[[], bool], process: subprocess.Popen[Any] | None = None) -> None:
    """Wait until something is so, which must be as long as `process` runs."""
    deadline = time.monotonic() + TIMEOUT_S
    while not is_so():
        assert process is None or process.poll() is None, process.communicate(timeout=TIMEOUT_S)
        assert time.monotonic() < deadline
        time.sleep(0.02)


def has_ended(pid: int, timeout_s: float) -> bool:
    """Return True if a process has ended, or ends within `timeout_s`."""
    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        poll = select.poll()  # not select(), which knows no descriptor above 1023
        poll.register(descriptor, select.POLLIN)
        return bool(poll.poll(timeout_s * 1000))
    finally:
        os.close(descriptor)
