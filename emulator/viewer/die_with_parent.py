"""`python -m emulator.viewer.die_with_parent COMMAND …`: becomes COMMAND, and ends when its parent does.

So that nothing is left behind by a process that is killed. Linux only; elsewhere COMMAND just runs.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = 1


def main(command: list[str]) -> None:
    """Become `command`."""
    parent = os.getppid()
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:  # it has ended meanwhile
            return
    for number in (signal.SIGTERM, signal.SIGINT):  # whatever it was that started this may ignore them
        signal.signal(number, signal.SIG_DFL)
    os.execv(command[0], command)


if __name__ == "__main__":
    main(sys.argv[1:])
