"""The end of a forked process: what a program would lose if it simply stopped."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

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
