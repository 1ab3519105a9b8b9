"""Scheduling: what is asked for is set, and nothing else of a thread changes."""

import os
import threading

import pytest

from vnet.transport import scheduling
from vnet.transport.scheduling import COMPUTING_SLICE_NS, PROMPT_SLICE_NS, preempting_nobody, set_time_slice


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
    assert seen[1] == (os.sched_getscheduler(0), nice)
    assert seen[0] == seen[2], "refused once, refused always"


def test_what_is_started_meanwhile_has_the_default() -> None:
    seen: list[object] = []

    def start() -> None:
        set_time_slice(PROMPT_SLICE_NS)
        with scheduling.default_time_slice():
            seen.append(getattr(scheduling._this_thread, "slice_ns", scheduling.DEFAULT_SLICE))
        seen.append(getattr(scheduling._this_thread, "slice_ns", PROMPT_SLICE_NS))

    thread = threading.Thread(target=start)
    thread.start()
    thread.join()
    assert seen == [scheduling.DEFAULT_SLICE, PROMPT_SLICE_NS]


def test_elsewhere_it_does_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "abacus")
    assert not set_time_slice(PROMPT_SLICE_NS)


@pytest.mark.skipif(not hasattr(os, "SCHED_BATCH"), reason="a policy of Linux")
def test_no_thread_preempts_others_meanwhile_not_even_those_started_then() -> None:
    before = os.sched_getscheduler(0)
    seen: list[int] = []
    ask, end = threading.Event(), threading.Event()

    def earlier() -> None:
        ask.wait()
        seen.append(os.sched_getscheduler(0))
        end.wait()
        seen.append(os.sched_getscheduler(0))

    thread = threading.Thread(target=earlier)
    thread.start()
    with preempting_nobody():
        later = threading.Thread(target=lambda: seen.append(os.sched_getscheduler(0)))
        later.start()
        later.join()
        ask.set()
        while len(seen) < 2:
            os.sched_yield()
        assert seen == [os.SCHED_BATCH, os.SCHED_BATCH]
        assert os.sched_getscheduler(0) == os.SCHED_BATCH
    end.set()
    thread.join()
    assert seen[2] == before == os.sched_getscheduler(0)


def test_a_policy_of_the_users_own_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr("os.sched_getscheduler", lambda thread: os.SCHED_IDLE)
    monkeypatch.setattr("os.sched_setscheduler", lambda thread, policy, param: asked.append(policy))
    with preempting_nobody():
        pass
    assert asked == []
