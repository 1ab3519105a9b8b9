"""Increments that are passed on: which are new, and which share of them the pooled priors hold."""

from __future__ import annotations

import pytest

from agents.cooperative.information_estimator import Passing
from agents.cooperative.information_frame import passed_increment, passed_record


def _record(code: int, value: float = 1.0) -> bytes:
    return passed_record(code, (value, 0.0, value, 0.0, 0.0))


OWN, FIRST, SECOND, FAR, FURTHER = (_record(code) for code in (1, 2, 3, 300, 70_000))


def _passing() -> Passing:
    passing = Passing(OWN)
    passing.use([OWN, FIRST, SECOND])
    return passing


def test_what_is_not_used_yet_is_new_and_priors_hold_the_weight_of_who_lists_it() -> None:
    listed = [(FIRST, OWN, FAR), (SECOND, FAR, FURTHER)]
    shares, forged = _passing().shares(listed, [0.25, 0.5], True)
    assert shares == {FAR: 0.75, FURTHER: 0.5}
    assert list(shares) == [FAR, FURTHER], "the order is that of the frames, and not that of hashes of bytes"
    assert not forged
    assert [passed_increment(record) for record in shares] == [
        (code, (1.0, 0.0, 1.0, 0.0, 0.0)) for code in (300, 70_000)
    ]
    assert _passing().shares([(OWN,)], [1.0], True) == ({}, 0)


@pytest.mark.parametrize("defence", [True, False])
def test_who_changes_most_that_is_known_first_hand_is_not_counted(defence: bool) -> None:
    """A record that it lists first is not used either; without the defence the first record counts for all."""
    false = (_record(2, 9.0), _record(3, 9.0), OWN, _record(300, 9.0))
    honest = (FIRST, FAR, FURTHER)
    shares, forged = _passing().shares([false, honest], [0.25, 0.5], defence)
    assert forged == int(defence)
    assert shares == ({FURTHER: 0.5} if defence else {_record(300, 9.0): 0.75, FURTHER: 0.5})


def test_a_frame_that_differs_in_one_of_two_is_not_forged() -> None:
    listed = [(FIRST, _record(3, 9.0), FAR), (SECOND, FAR)]
    assert _passing().shares(listed, [0.25, 0.5], True) == ({FAR: 0.75}, 0)


def test_others_are_sent_in_turns() -> None:
    passing = Passing(OWN)
    passing.use([OWN, FIRST, SECOND, _record(4)])
    assert [passing.to_send(2, period)["name"].tolist() for period in range(3)] == [[1, 2], [1, 4], [1, 3]]
    assert [len(passing.to_send(limit, 7)) for limit in (0, 1, 3, 4, 9)] == [0, 1, 3, 4, 4]
