"""Waiting for processes that are not this process's children."""

import os
import select


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
