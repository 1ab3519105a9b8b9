"""A separate router as a process of its own (`vnet run --router separate`), which faults may end and start again.

It is Zenoh's own router, run from Python with the configuration that `vnet access` writes for a `zenohd`.
"""

from __future__ import annotations

import contextlib
import shutil
import signal
import socket
import sys
import time
from pathlib import Path

import zenoh

from emulator.drivers.launch import Launcher
from vnet.errors import TransportError
from vnet.runtime.die_with_parent import signal_at_parent_death
from vnet.runtime.outside_loop import end_within
from vnet.transport.access import Access

ROUTER = "router"
START_TIMEOUT_S = 15.0


class SeparateRouter:
    """The router of a run. Its configuration, with the passwords, is in `folder`, which is private."""

    def __init__(self, access: Access, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = int(free.getsockname()[1])
        self.endpoint = f"tcp/127.0.0.1:{self._port}"
        self._config = folder / "zenohd.json5"
        access.save(folder, self.endpoint, folder)

    def start(self, launcher: Launcher) -> None:
        """Start the process and wait until it listens. Raises TransportError if it does not."""
        launcher.start_service(ROUTER, ["-P", "-m", "emulator.drivers.router", str(self._config)])
        deadline = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < deadline:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self._port), 1.0):
                return
            time.sleep(0.02)
        raise TransportError(f"the separate router does not listen at {self.endpoint}: {launcher.log_tail(ROUTER)}")


def main(config: str) -> None:
    """Be the router until SIGTERM, or until the emulator is gone."""
    told = {signal.SIGTERM, signal.SIGINT, signal.SIGHUP}
    signal.pthread_sigmask(signal.SIG_BLOCK, told)  # a handler could interrupt itself: a parent's end tells often
    signal_at_parent_death(signal.SIGHUP)
    with zenoh.open(zenoh.Config.from_file(config)):
        how = signal.sigwait(told)
        end_within()
    if how == signal.SIGHUP:  # nobody else is left to remove the passwords
        shutil.rmtree(Path(config).parent, ignore_errors=True)


if __name__ == "__main__":
    main(sys.argv[1])
