"""Capacity of the channel: what is measured, and where loss begins."""

import gc

import pytest

from emulator.radio.dot11p import airtime_ns
from emulator.radio.engine import Engine
from emulator.radio.frames import Frame
from studies import capacity
from studies.capacity import RATE_HZ, VARIANTS, Point, measure, onset, reach_m

HERE, ROAD, ETSI, _ = VARIANTS


def points(*delivered: float) -> list[Point]:
    return [Point("road", 300, 10 * (n + 1), share, 0.5) for n, share in enumerate(delivered)]


def test_loss_begins_between_the_points_around_nine_tenths() -> None:
    assert onset(points(1.0, 0.95, 0.85)) == pytest.approx(25.0)
    assert onset(points(1.0, 0.95)) is None
    assert onset(points(0.5)) == 10.0, "too many from the first on"
    assert onset(points(1.0, 0.9, 0.8)) == pytest.approx(20.0)


def test_within_reach_means_that_a_frame_is_just_detected() -> None:
    assert reach_m() == pytest.approx(10 ** ((20 - 47.86 + 82) / 20))


def test_few_in_one_place_hear_all_and_find_the_air_as_busy_as_they_make_it() -> None:
    point = measure(HERE, 300, 4, seconds=0.5, seed=1)
    assert point.delivered == 1.0
    assert point.busy == pytest.approx(5 * RATE_HZ * airtime_ns(300, 6.0) / 1e9, rel=0.02)


@pytest.mark.slow
def test_frames_that_have_been_sent_are_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else memory would grow with the length of the run: the engine may keep a hundred, of 250 sent."""

    def frames() -> int:
        gc.collect()
        return sum(isinstance(thing, Frame) for thing in gc.get_objects())

    kept: list[int] = []
    others = frames()  # those of earlier tests

    class Watched(Engine):
        def drain(self) -> None:
            kept.append(frames() - others)
            super().drain()

    monkeypatch.setattr(capacity, "Engine", Watched)
    measure(HERE, 300, 4, seconds=2.0, seed=1)
    assert kept[0] <= 100


@pytest.mark.slow
def test_a_road_has_hidden_terminals_and_a_control_that_gives_way() -> None:
    free, open_, held = (measure(variant, 1400, 30, seconds=0.5, seed=1) for variant in (HERE, ROAD, ETSI))
    assert free.delivered > open_.delivered + 0.1
    assert held.busy < open_.busy - 0.1
