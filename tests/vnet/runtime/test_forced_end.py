"""A process that is over ends, whatever keeps it, and says where it stood."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT
from tests.support.processes import has_ended

pytestmark = pytest.mark.slow


def test_a_process_that_something_keeps_ends_with_its_stacks() -> None:
    program = "import threading; from vnet.runtime.outside_loop import *; end_within(0.1); threading.Event().wait()"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert "in wait" in done.stderr and "Timeout" in done.stderr


PROGRAM = """
import atexit, sys, threading, types
from vnet.runtime.outside_loop import end_forked
shared = frozenset(sys.modules)

own = sys.modules["own"] = types.ModuleType("own")
own.left_open = open("left_open", "w")
own.left_open.write("what was buffered")
sys.modules["odd"] = object()

class Kept:
    def __del__(self):
        print("kept was discarded")

sys.kept = Kept()  # of a shared module: stays
atexit.register(print, "at exit")
job = threading.Thread(target=lambda: (begun.wait(), print("job done")))
begun = threading.Event()
job.start()
begun.set()
end_forked(7, shared)
"""


def test_threads_are_awaited_and_files_written_but_shared_objects_stay(tmp_path: Path) -> None:
    ended = subprocess.run([sys.executable, "-c", PROGRAM], cwd=tmp_path, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (7, "")
    assert ended.stdout.splitlines() == ["job done", "at exit"]
    assert (tmp_path / "left_open").read_text() == "what was buffered"


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
