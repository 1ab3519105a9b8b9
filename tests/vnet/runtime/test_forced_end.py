"""A process that is over ends, whatever keeps it, and says where it stood."""

import subprocess
import sys

import pytest

from tests.support.paths import ROOT

pytestmark = pytest.mark.slow

PROGRAM = """
import threading

from vnet.runtime.outside_loop import end_within

end_within(0.1)
threading.Event().wait()
"""


def test_a_process_that_something_keeps_ends_with_its_stacks() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert "in wait" in done.stderr and "Timeout" in done.stderr
