"""`vnet-agent` until it has joined: what it is asked to wait, and how it is ended meanwhile."""

import math
import os
import signal
import socket
import subprocess
import sys

import pytest

from agents.cli import _check_timeout
from vnet.errors import VnetError


@pytest.mark.parametrize("timeout_s", [math.nan, math.inf, -math.inf, -1.0, 0.0, 86_401.0])
def test_a_time_that_cannot_be_waited_is_refused_in_one_line(timeout_s: float) -> None:
    with pytest.raises(
        VnetError, match=r"^--connect-timeout-s \S+: a time above 0 s, and up to 86400 s, is needed$"
    ):
        _check_timeout("--connect-timeout-s", timeout_s)
    _check_timeout("--connect-timeout-s", 600.0)


@pytest.mark.slow
def test_an_agent_that_still_connects_is_ended_at_once() -> None:
    """Here to something that accepts its connection and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(60)
        arguments = ["--run", "r", "--node", "v01", "--connect-timeout-s", "600"]
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        command = [sys.executable, "-P", "-m", "agents.cli", "--connect", endpoint, *arguments]
        agent = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            connection, _ = server.accept()
            with connection:
                agent.send_signal(signal.SIGTERM)
                assert agent.communicate(timeout=30)[1] == "" and agent.returncode == -signal.SIGTERM
        finally:
            agent.kill()


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


@pytest.mark.slow
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
