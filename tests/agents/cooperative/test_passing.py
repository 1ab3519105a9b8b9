"""Increments that are passed on: which are new, and who lists them."""

from __future__ import annotations

import pytest

from agents.cooperative.information_estimator import Passing
from agents.cooperative.information_frame import passed_increment, passed_record


def _record(code: int, value: float = 1.0) -> bytes:
    return passed_record(code, (value, 0.0, value, 0.0, 0.0))


OWN, FIRST, SECOND, FAR, FURTHER = (_record(code) for code in (1, 2, 3, 300, 70_000))


def _passing() -> Passing:
    passing = Passing(OWN)
    passing.use([OWN, FIRST, SECOND], [OWN, FIRST, SECOND])
    return passing


def test_what_is_not_used_yet_is_new() -> None:
    listed = [(FIRST, OWN, FAR), (SECOND, FAR, FURTHER)]
    listers, forged = _passing().new(listed, True)
    assert listers == {FAR: [0, 1], FURTHER: [1]}
    assert list(listers) == [FAR, FURTHER], "the order is that of the frames, and not that of hashes of bytes"
    assert not forged
    assert [passed_increment(record) for record in listers] == [
        (code, (1.0, 0.0, 1.0, 0.0, 0.0)) for code in (300, 70_000)
    ]
    assert _passing().new([(OWN,)], True) == ({}, 0)


@pytest.mark.parametrize("defence", [True, False])
def test_who_changes_most_that_is_known_first_hand_is_not_counted(defence: bool) -> None:
    """A record that it lists first is not used either; without the defence the first record counts for all."""
    false = (_record(2, 9.0), _record(3, 9.0), OWN, _record(300, 9.0))
    honest = (FIRST, FAR, FURTHER)
    listers, forged = _passing().new([false, honest], defence)
    assert forged == int(defence)
    assert listers == ({FURTHER: [1]} if defence else {_record(300, 9.0): [0, 1], FURTHER: [1]})


def test_a_frame_that_differs_in_one_of_two_is_not_forged() -> None:
    listed = [(FIRST, _record(3, 9.0), FAR), (SECOND, FAR)]
    assert _passing().new(listed, True) == ({FAR: [0, 1]}, 0)


def test_others_are_sent_in_turns() -> None:
    passing = Passing(OWN)
    passing.use([OWN, FIRST, SECOND, _record(4)], [OWN, FIRST, SECOND, _record(4)])
    assert [passing.to_send(2, period)["name"].tolist() for period in range(3)] == [[1, 2], [1, 4], [1, 3]]
    assert [len(passing.to_send(limit, 7)) for limit in (0, 1, 3, 4, 9)] == [0, 1, 3, 4, 4]


def _codes(passing: Passing, limit: int, period: int = 0) -> list[int]:
    return [int(code) for code in passing.to_send(limit, period)["name"]]


def test_what_others_passed_on_is_used_once_as_long_as_a_vehicle_remembers_it() -> None:
    passing, listed = Passing(OWN, 3), [(FIRST, FAR)]
    passing.use([OWN, FIRST], [OWN, FIRST])
    assert passing.new(listed, True) == ({FAR: [0]}, 0)
    passing.use([OWN, SECOND], [OWN, SECOND], [FAR])
    assert _codes(passing, 9) == [1, 3, 300]
    for _ in range(3):
        assert passing.new(listed, True) == ({}, 0)
        passing.use([OWN], [OWN])
        assert _codes(passing, 9) == [1]
    for _ in range(3):
        passing.use([OWN], [OWN])
    assert FAR in passing.new(listed, True)[0], "it has forgotten"


def test_what_was_heard_is_sent_before_what_others_have_passed_on() -> None:
    """An increment that says too little for that is known as well."""
    passing = Passing(OWN, 3)
    passing.use([OWN, FIRST, _record(4), SECOND], [OWN, FIRST, SECOND], [FAR, FURTHER])
    assert _codes(passing, 9) == [1, 2, 3, 300, 70_000]
    assert _codes(passing, 4) == [1, 2, 3, 300]
    assert [_codes(passing, 2, period) for period in range(2)] == [[1, 2], [1, 2]]
    assert passing.new([(_record(4), OWN)], True) == ({}, 0)


def test_an_older_increment_of_who_is_heard_is_no_forgery_if_it_is_known() -> None:
    passing, false = Passing(OWN, 3), _record(2, 9.0)
    passing.use([OWN, FIRST], [OWN, FIRST])
    passing.use([OWN, _record(2, 2.0)], [OWN, _record(2, 2.0)])
    assert passing.new([(FIRST, false, FAR)], True) == ({FAR: [0]}, 0)
    assert passing.new([(false, FAR)], True) == ({}, 1)


def test_a_known_increment_does_not_hide_a_new_one_of_the_same_origin() -> None:
    passing, newer = Passing(OWN, 3), _record(300, 2.0)
    passing.use([OWN, FIRST], [OWN, FIRST], [FAR])
    assert passing.new([(FAR,)], True) == ({FAR: [0]}, 0)
    passing.use([OWN, FIRST], [OWN, FIRST], [FAR])
    assert passing.new([(FAR,), (newer, _record(2, 3.0))], False) == ({newer: [1]}, 0)
