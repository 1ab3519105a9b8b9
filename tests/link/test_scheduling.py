"""Time slices: what is asked for is set, and nothing else of a thread changes."""

import os
import threading

import pytest

from vnet.link import scheduling
from vnet.link.scheduling import COMPUTING_SLICE_NS, PROMPT_SLICE_NS, set_time_slice


def in_a_thread(what: list[object], nice: int) -> None:
    os.setpriority(os.PRIO_PROCESS, 0, nice)
    what.append(set_time_slice(PROMPT_SLICE_NS))
    what.append((os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)))
    what.append(set_time_slice(COMPUTING_SLICE_NS))


@pytest.mark.parametrize("above", [0, 3])
def test_niceness_and_policy_stay(above: int) -> None:
    nice = min(os.getpriority(os.PRIO_PROCESS, 0) + above, 19)
    seen: list[object] = []
    thread = threading.Thread(target=in_a_thread, args=(seen, nice))
    thread.start()
    thread.join()
    ordinary = os.sched_getscheduler(0) == os.SCHED_OTHER
    assert seen == [ordinary, (os.sched_getscheduler(0), nice), ordinary]


def test_elsewhere_it_does_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduling.platform, "machine", lambda: "abacus")
    assert not set_time_slice(PROMPT_SLICE_NS)
