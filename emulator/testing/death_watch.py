"""A line that names the vehicle whose program ran when pytest's process ended in its midst, as by a fatal signal.

Another process prints it: a small one, which waits for that end.
"""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import nullcontext

import pytest

from vnet.runtime import running_node
from vnet.runtime.running_node import LONGEST_ID, RunningNode

_WATCHER = f"""
import os, select, sys
process, name = map(int, sys.argv[1:])
select.select([process], [], [])
if node := os.pread(name, {LONGEST_ID}, 0).strip(bytes(1)).decode():
    sys.stderr.write(f"\\nvnet: pytest's process ended while the program of {{node}} ran\\n")
"""
_begun: dict[int, subprocess.Popen[bytes]] = {}
"""The watcher of this process, by its id: that of a parent watches the parent."""


def watch(config: pytest.Config) -> None:
    """Have a process print the line on pytest's own standard error if a program ends this one."""
    if os.getpid() in _begun or sys.platform != "linux":
        return
    capture = config.pluginmanager.getplugin("capturemanager")
    name, process = os.memfd_create("vnet-running-node"), os.pidfd_open(os.getpid())
    try:
        os.ftruncate(name, LONGEST_ID + 1)
        running_node.running = RunningNode(name)
        with capture.global_and_fixture_disabled() if capture else nullcontext():
            _begun[os.getpid()] = subprocess.Popen(
                [sys.executable, "-I", "-S", "-c", _WATCHER, str(process), str(name)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[process, name],
                start_new_session=True,  # Ctrl-C is for pytest
            )
    finally:
        os.close(name)
        os.close(process)


def end() -> None:
    """End the watch of this process, if it has one: pytest ends as it should."""
    if watcher := _begun.pop(os.getpid(), None):
        watcher.kill()
        watcher.wait()
