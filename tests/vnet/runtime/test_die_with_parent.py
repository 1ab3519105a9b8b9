"""Processes started with `die_with_parent` end with their parent, even if it is killed and signals are ignored."""

import subprocess
import sys

import pytest

from tests.support.processes import has_ended

pytestmark = pytest.mark.slow

CHILD = "import os, sys, time; print(os.getpid(), flush=True); time.sleep(600)"
PARENT = f"""
import signal, subprocess, sys
from vnet.runtime.die_with_parent import TIED
signal.signal(signal.SIGTERM, signal.SIG_IGN)
subprocess.Popen([*TIED, sys.executable, "-c", {CHILD!r}])
sys.stdin.read()
"""


def test_a_command_ends_when_its_parent_is_killed() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PARENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        assert not has_ended(pid, 0)
        parent.kill()
        assert has_ended(pid, 60)
