"""CPU time and memory of the processes of a live run."""

import os
import subprocess
import sys
import time
from itertools import pairwise
from math import floor

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.drivers import usage
from emulator.drivers.usage import KB_PER_MB, LEAST_NS, CpuWatch, MemoryWatch, cpu_time_ns, first_over


def test_a_process_that_is_started_again_adds_to_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks: dict[int, int | None] = {}
    monkeypatch.setattr(usage, "cpu_time_ns", clocks.get)
    watch = CpuWatch()
    clocks |= {7: 100, 8: 1000}
    watch.look({"v01": 7, "v02": 8})
    clocks |= {7: 150, 8: 1001}
    watch.look({"v01": 7, "v02": 8})
    clocks |= {7: None, 9: 500}
    watch.look({"v01": 7, "v02": 8})  # it has just been killed
    watch.look({"v01": 9, "v02": 8})
    clocks |= {9: 520}
    watch.look({"v01": 9, "v02": 8})
    assert watch.cpu_ns == {"v01": 50 + 20, "v02": 1}


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells the CPU time of another process")
def test_the_clock_of_a_process_is_read() -> None:
    before, seen, after = time.process_time_ns(), cpu_time_ns(os.getpid()), time.process_time_ns()
    assert seen is not None
    assert before <= seen <= after
    assert cpu_time_ns(2**22 + 1) is None, "there is no such process"


@given(st.integers(1, 10**6), st.integers(1, 10**6))
def test_what_is_over_the_limit_is_told_as_more(limit_tenths: int, over_kb: int) -> None:
    limit_mb = limit_tenths / 10
    with pytest.MonkeyPatch.context() as patch:
        for size_kb in ("resident_kb", "private_kb"):
            patch.setattr(usage, size_kb, lambda pid: floor(limit_mb * KB_PER_MB) + over_kb)
        over = first_over(limit_mb, {"v01": 7})
    assert over is not None and over[1] > limit_mb


FORKED = """
import os, sys
shared = bytearray(b"x") * (16 << 20)
if os.fork():
    os.wait()
else:
    for lap in range(4):
        print(os.getpid(), flush=True)
        sys.stdin.readline()
        for place in range(lap << 22, lap + 1 << 22, 4096):
            shared[place] = 1
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells the memory of another process")
def test_what_a_forked_process_makes_its_own_is_growth_though_it_was_resident_before() -> None:
    watch = MemoryWatch(duration_ns=0)
    with subprocess.Popen(
        [sys.executable, "-c", FORKED], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin and process.stdout
        for lap in range(4):
            watch.look(lap * LEAST_NS, {"v01": int(process.stdout.readline())})
            print(file=process.stdin, flush=True)
    ((_, _, sizes_kb),) = watch.series()
    assert all(after - before >= 4096 for before, after in pairwise(sizes_kb)), sizes_kb
