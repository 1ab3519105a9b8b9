"""A played run keeps the wall clock's pace, without a clock in sight."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.stream.playback import Message, play, schedule

PERIOD_NS = 100_000_000


def run_of(periods: int) -> list[Message]:
    told: list[Message] = [("period", {"period": k, "time_ns": k * PERIOD_NS}) for k in range(periods)]
    return [("scene", {}), *told, ("end", {"events": ["ended"]})]


def shown(scheduled: Any) -> list[tuple[float, int]]:
    return [(due_s, message["period"]) for due_s, (stream, message) in scheduled if stream == "period"]


def test_each_period_is_due_at_its_time() -> None:
    assert shown(schedule(run_of(4), 1.0)) == [(0.0, 0), (0.1, 1), (0.2, 2), pytest.approx((0.3, 3))]


def test_twice_as_fast_is_due_at_half_the_time() -> None:
    assert shown(schedule(run_of(4), 2.0)) == [(0.0, 0), (0.05, 1), (0.1, 2), pytest.approx((0.15, 3))]


def test_a_part_of_a_run_starts_at_once_and_keeps_its_scene() -> None:
    part = list(schedule(run_of(20), 1.0, 5 * PERIOD_NS, 8 * PERIOD_NS))
    assert [stream for _, (stream, _) in part] == ["scene", "period", "period", "period", "end"]
    assert shown(part) == [(0.0, 5), (0.1, 6), (0.2, 7)]
    assert part[-1][1] == ("end", {"events": []}), "what ended the run is not of this part"


def test_a_part_may_begin_and_end_within_periods() -> None:
    part = schedule(run_of(20), 1.0, 5 * PERIOD_NS - 50_000_000, 7 * PERIOD_NS + 1)
    assert shown(part) == [(0.05, 5), pytest.approx((0.15, 6)), pytest.approx((0.25, 7))]


class Clock:
    """A clock that goes only while one sleeps, or is told to."""

    def __init__(self) -> None:
        self.time_s = 1000.0
        self.slept: list[float] = []

    def now_s(self) -> float:
        return self.time_s

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.time_s += seconds


@pytest.mark.slow
@given(st.lists(st.floats(0, 0.5), min_size=1, max_size=30), st.floats(0.1, 10))
def test_no_message_comes_early_or_later_than_it_must(costs_s: list[float], speed: float) -> None:
    """Whatever showing costs: a message comes when it is due, or right after the one before it."""
    clock = Clock()
    times: list[float] = []
    free_s: list[float] = []

    def show(message: Message) -> None:
        if message[0] == "period":
            times.append(clock.time_s - 1000.0)
            clock.time_s += costs_s[message[1]["period"]]
            free_s.append(clock.time_s - 1000.0)

    assert play(schedule(run_of(len(costs_s)), speed), show, clock.now_s, clock.sleep) == len(costs_s)
    for k, time_s in enumerate(times):
        due_s = k * 0.1 / speed
        assert time_s == pytest.approx(max(due_s, free_s[k - 1] if k else 0.0), abs=1e-6)


def test_the_clock_starts_with_the_first_period() -> None:
    """Finding the start takes time, and so does opening a viewer: playback does not catch up for either."""
    clock = Clock()
    times: list[float] = []

    def show(message: Message) -> None:
        if message[0] == "scene":
            clock.time_s += 7.0
        elif message[0] == "period":
            times.append(clock.time_s)

    play(schedule(run_of(5), 1.0, 2 * PERIOD_NS), show, clock.now_s, clock.sleep)
    assert times == [1007.0, pytest.approx(1007.1), pytest.approx(1007.2)]


def test_nothing_to_play_is_nothing() -> None:
    assert play(schedule(run_of(3), 1.0, 9 * PERIOD_NS), lambda message: None) == 0
