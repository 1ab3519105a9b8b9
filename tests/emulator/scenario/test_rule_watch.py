"""Nothing is left of an interrupted call that disturbs what the process does next."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

PROGRAM = """
import sys
from emulator.scenario import own_functions

own_functions.LIMIT_S = own_functions.LOOK_EVERY_S = 0.01

def loops():
    while True:
        pass

for _ in range(3):
    try:
        own_functions.call_bounded(loops)
    except own_functions.NoAnswerError:
        print("interrupted")

def trace(frame, event, argument):
    return trace

async def awaits():
    return 1

sys.settrace(trace)
try:
    awaits().send(None)
except StopIteration as end:
    print("traced", end.value)
"""


def test_a_coroutine_can_be_traced_after_a_call_was_interrupted() -> None:
    """A process of its own, as Python 3.11 would loop within itself if an exception were still to come."""
    done = subprocess.run([sys.executable, "-P", "-c", PROGRAM], capture_output=True, text=True, timeout=60)
    assert done.stdout.split("\n") == ["interrupted"] * 3 + ["traced 1", ""], done.stderr
