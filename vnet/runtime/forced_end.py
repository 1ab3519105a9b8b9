"""The end of a process that is over, should closing its connections or threads of a program keep it."""

from __future__ import annotations

import faulthandler
import sys

ENDING_S = 60.0
"""Seconds for an agent, or a separate router, to end: Zenoh gives a connection up after ten."""


def end_within(seconds: float = ENDING_S) -> None:
    """Have this process end after so many seconds at the latest, with status 1 and its stacks on standard error."""
    if sys.__stderr__ is not None:
        faulthandler.dump_traceback_later(seconds, exit=True, file=sys.__stderr__)
