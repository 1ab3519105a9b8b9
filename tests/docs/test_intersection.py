"""Tests of the worked example of an intersection: whom its unit grants the crossing, and collisions."""

from __future__ import annotations

import numpy as np
import pytest

from docs.examples.intersection.crossing import PAST_M, Book, Request
from docs.examples.intersection.figure import CRUISE_M_S, cross, measured

pytestmark = pytest.mark.slow


def decided(book: Book, now_s: float, *notes: tuple[str, int, float, float]) -> list[str]:
    """Return who has a grant now; a note is a vehicle, its road, its place there, and when this was said."""
    for vehicle, road, along_m, noted_s in notes:
        book.note(vehicle, Request(road, along_m), noted_s)
    book.decide(now_s)
    return list(book.granted)


def test_one_road_at_a_time_has_the_crossing() -> None:
    book = Book(patience_s=8.0)
    assert decided(book, 0.1, ("a", 0, -100.0, 0.0), ("b", 1, -100.0, 0.1)) == ["a"]
    assert decided(book, 5.0, ("a", 0, PAST_M + 1, 5.0)) == ["b"]


def test_whoever_is_past_gets_no_second_grant() -> None:
    assert decided(Book(patience_s=8.0), 0.1, ("a", 0, PAST_M + 1, 0.0), ("a", 0, -100.0, 0.1)) == []


def test_a_stream_of_vehicles_ends_when_the_other_road_is_out_of_patience() -> None:
    book = Book(patience_s=8.0)
    decided(book, 0.0, ("a", 0, -100.0, 0.0))
    assert decided(book, 2.0, ("b", 1, -100.0, 1.0), ("c", 0, -100.0, 2.0)) == ["a", "c"]
    assert decided(book, 9.5, ("d", 0, -100.0, 9.5)) == ["a", "c"]


def test_a_vehicle_in_the_way_of_one_with_a_grant_gets_one() -> None:
    book = Book(patience_s=0.0)
    decided(book, 0.0, ("behind", 0, -100.0, 0.0))
    notes = ("other", 1, -100.0, 1.0), ("behind", 0, -30.0, 8.9), ("ahead", 0, -20.0, 9.0)
    assert decided(book, 9.0, *notes) == ["behind", "ahead"]


def test_the_newest_positions_say_who_is_in_the_way() -> None:
    book = Book(patience_s=1.0)
    decided(book, 0.0, ("late", 0, -50.0, 0.0))
    assert decided(book, 3.0, ("early", 0, -130.0, 0.1), ("other", 1, -100.0, 0.0)) == ["late"]
    assert decided(book, 4.0, ("early", 0, -20.0, 4.0)) == ["late", "early"]


def test_who_never_comes_past_is_late_until_the_end() -> None:
    time_s = np.array([0.0, 10.0, 20.0])
    at_m = np.array([[-140.0, -140.0, -150.0], [0.0, 2.0, -10.0], [140.0, 140.0, 40.0]])
    crossing = measured(time_s, at_m, 0)
    assert crossing.not_past == 1
    assert crossing.delay_s == pytest.approx(20 - (140 + 140 + 150 + 3 * 50) / CRUISE_M_S / 3)


def test_vehicles_that_would_meet_take_turns_despite_packet_loss() -> None:
    places = [1360.0, 1350.0]
    small = {"network.vehicles": 2, "run.duration_s": 35.0, "radio.loss": 0.8}
    assert cross({**small, "program.options.waits": False}, 1, places).collisions == 1
    granted = cross({**small, "program.options.waits": True}, 1, places)
    assert (granted.collisions, granted.not_past) == (0, 0)
