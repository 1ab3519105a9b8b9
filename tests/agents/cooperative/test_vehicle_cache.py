"""Caches of frames: sized by the vehicles of the process, with the same results."""

import gc
from functools import partial

import pytest

from agents.cooperative import frame, information_frame
from agents.cooperative.frame import ENTRIES_PER_VEHICLE, LEAST_ENTRIES, Admission, VehicleCache


@pytest.fixture(autouse=True)
def _few_vehicles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Start as a new process does, whatever other tests have hosted in this one."""
    gc.collect()
    monkeypatch.setattr(frame, "_vehicles", type(frame._vehicles)())
    monkeypatch.setattr(frame, "_entries", LEAST_ENTRIES)
    for cache in frame._caches:
        cache.resize()


def test_one_vehicle_a_process_keeps_few_frames() -> None:
    admission = Admission("00000000", 100_000_000, information_frame.decode)
    assert information_frame.decode.entries == frame.decode.entries == LEAST_ENTRIES
    assert admission is not None


def test_all_frames_of_a_period_fit_whatever_the_number_of_vehicles() -> None:
    vehicles = []
    for count in range(1, 300):
        vehicles.append(Admission("00000000", 100_000_000, information_frame.decode))
        needed = LEAST_ENTRIES + ENTRIES_PER_VEHICLE * (count - 1)
        assert needed <= information_frame.decode.entries <= 2 * needed


def test_vehicles_that_are_gone_do_not_count() -> None:
    for _ in range(1000):
        Admission("00000000", 100_000_000, information_frame.decode)
    assert information_frame.decode.entries <= 2 * LEAST_ENTRIES


def test_results_are_kept_and_the_oldest_forgotten() -> None:
    calls: list[int] = []
    cached = VehicleCache(partial(lambda seen, value: seen.append(value) or -value, calls))
    frame._caches.pop()
    numbers = [*range(LEAST_ENTRIES), *range(LEAST_ENTRIES), LEAST_ENTRIES, 0]
    assert [cached(number) for number in numbers] == [-number for number in numbers]
    assert calls == [*range(LEAST_ENTRIES + 1), 0]
