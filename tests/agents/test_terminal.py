"""Agents that an emulator has started have no terminal: who asked there would be stopped for good."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

CHILD = """
import os, sys
from agents.cli import _leave_terminal
_leave_terminal()
try:
    os.close(os.open("/dev/tty", os.O_RDWR | os.O_NOCTTY))
    print("has a terminal")
except OSError:
    print("has none")
"""
PARENT = """
import fcntl, subprocess, sys, termios
fcntl.ioctl(int(sys.argv[2]), termios.TIOCSCTTY, 0)
background = {"process_group": 0} if sys.argv[3] == "background" else {}
child = [sys.executable, "-c", sys.argv[1]]
sys.exit(subprocess.run(child, stdin=subprocess.DEVNULL, **background).returncode)
"""


@pytest.mark.parametrize(("where", "told"), [("background", "has none"), ("foreground", "has a terminal")])
def test_a_process_in_a_background_of_its_own_leaves_the_terminal(where: str, told: str) -> None:
    master, slave = os.openpty()
    try:
        parent = [sys.executable, "-c", PARENT, CHILD, str(slave), where]
        done = subprocess.run(
            parent, start_new_session=True, pass_fds=(slave,), capture_output=True, text=True, timeout=60
        )
    finally:
        os.close(slave)
        os.close(master)
    assert (done.stdout.strip(), done.returncode) == (told, 0), done.stderr
