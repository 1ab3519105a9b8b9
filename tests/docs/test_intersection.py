"""Tests of the worked example of an intersection: whom its unit grants the crossing, and collisions."""

from __future__ import annotations

import numpy as np
import pytest

from docs.examples.intersection.crossing import PAST_M, Book, Request
from docs.examples.intersection.figure import CRUISE_M_S, cross, measured

pytestmark = pytest.mark.slow


def test_one_road_at_a_time_has_the_crossing() -> None:
    book = Book(patience_s=8.0)
    book.note("a", Request(0, -100.0), 0.0)
    book.note("b", Request(1, -100.0), 0.1)
    book.decide(0.1)
    assert list(book.granted) == ["a"]
    book.note("a", Request(0, PAST_M + 1), 5.0)
    book.decide(5.0)
    assert list(book.granted) == ["b"]


def test_whoever_is_past_gets_no_second_grant() -> None:
    book = Book(patience_s=8.0)
    book.note("a", Request(0, PAST_M + 1), 0.0)
    book.note("a", Request(0, -100.0), 0.1)
    book.decide(0.1)
    assert not book.granted


def test_a_stream_of_vehicles_ends_when_the_other_road_is_out_of_patience() -> None:
    book = Book(patience_s=8.0)
    book.note("a", Request(0, -100.0), 0.0)
    book.decide(0.0)
    book.note("b", Request(1, -100.0), 1.0)
    book.note("c", Request(0, -100.0), 2.0)
    book.decide(2.0)
    assert list(book.granted) == ["a", "c"]
    book.note("d", Request(0, -100.0), 9.5)
    book.decide(9.5)
    assert list(book.granted) == ["a", "c"]


def test_a_vehicle_in_the_way_of_one_with_a_grant_gets_one() -> None:
    book = Book(patience_s=0.0)
    book.note("behind", Request(0, -100.0), 0.0)
    book.decide(0.0)
    book.note("other", Request(1, -100.0), 1.0)
    book.note("behind", Request(0, -30.0), 8.9)
    book.note("ahead", Request(0, -20.0), 9.0)
    book.decide(9.0)
    assert list(book.granted) == ["behind", "ahead"]


def test_the_newest_positions_say_who_is_in_the_way() -> None:
    book = Book(patience_s=1.0)
    book.note("late", Request(0, -50.0), 0.0)
    book.decide(0.0)
    book.note("early", Request(0, -130.0), 0.1)
    book.note("other", Request(1, -100.0), 0.0)
    book.decide(3.0)
    assert list(book.granted) == ["late"]
    book.note("early", Request(0, -20.0), 4.0)
    book.decide(4.0)
    assert list(book.granted) == ["late", "early"]


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
