"""Cleaning of recorded trips, and the motion: standing, held positions, jumps, gaps, headings."""

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from emulator.world.trips.motion import ImpossibleTripError, Motion, Rules, Selection, Trip, clean, motion_of
from vnet.errors import ScenarioError

RULES = Rules(fastest_mps=70.0, longest_gap_s=10.0)
TENTH_NS = 100_000_000


def trip(
    time_s: npt.ArrayLike, x_m: npt.ArrayLike, y_m: npt.ArrayLike = 0.0, name: str = "a", **known: np.ndarray
) -> Trip:
    time = np.asarray(time_s, dtype=float)
    position_m = np.column_stack([np.broadcast_to(x_m, time.shape), np.broadcast_to(y_m, time.shape)])
    return Trip(name, time, position_m.astype(float), **known)


def drive(*trips: Trip, seconds: float = 10.0, start_s: float = 0.0, **frame: object) -> Motion:
    periods = round(seconds * 10) + 1
    return motion_of(list(trips), Selection(start_s, periods, TENTH_NS, **frame), RULES)  # type: ignore[arg-type]


def x_of(course: Motion, vehicle: int = 0) -> np.ndarray:
    return course.position_m[:, vehicle, 0]


def there(course: Motion, vehicle: int = 0) -> tuple[float, float]:
    """Return the first and the last time, in seconds, at which a vehicle is present."""
    periods = np.flatnonzero(np.isfinite(x_of(course, vehicle)))
    assert len(periods) == periods[-1] - periods[0] + 1, "without a break"
    return periods[0] / 10, periods[-1] / 10


# Held samples, and stands.


def test_samples_that_are_repeated_to_reach_a_rate_are_not_stands() -> None:
    time_s = np.arange(0, 10, 0.1)
    true_m = 20 * time_s
    held_m = np.repeat(true_m[::2], 2)  # 5 Hz, written at 10 Hz
    assert x_of(drive(trip(time_s, held_m)))[:98] == pytest.approx(true_m[:98])


def test_a_receiver_that_held_its_position_is_bridged_and_the_jump_at_its_end_is_a_drive() -> None:
    """Like an Ann Arbor trip: 5.7 s at one position, and 130 m further on within the next 0.3 s."""
    time_s = np.arange(0, 20, 0.1)
    true_m = 22 * time_s
    said_m = np.where((time_s > 5) & (time_s < 10.75), 22 * 5.0, true_m)
    said_m[107:110] = np.linspace(110, true_m[110], 5)[1:-1]  # a filter smooths the jump
    x_m = x_of(drive(trip(time_s, said_m), seconds=20))
    assert x_m[:199] == pytest.approx(true_m[:199], abs=0.1)


def test_a_stand_is_a_stand_if_the_vehicle_then_starts_as_vehicles_do() -> None:
    time_s = np.arange(0, 30, 0.1)
    moving_s = np.maximum(time_s - 20, 0)
    said_m = np.where(time_s < 5, 10 * time_s, 50 + 1.5 * moving_s**2)  # 3 m/s²
    x_m = x_of(drive(trip(time_s, said_m), seconds=29))
    assert x_m[60:200] == pytest.approx(np.full(140, 50.0), abs=1e-9)


def test_a_position_held_for_longer_than_a_gap_is_believed() -> None:
    time_s = np.arange(0, 40, 0.1)
    said_m = np.where(time_s < 5, 10 * time_s, np.where(time_s < 25, 50.0, 50 + 10 * (time_s - 25)))
    x_m = x_of(drive(trip(time_s, said_m), seconds=39))
    assert x_m[60:249] == pytest.approx(np.full(189, 50.0))


# Jumps.


def test_an_outlier_is_left_out_wherever_it_is() -> None:
    time_s = np.arange(0, 10, 0.1)
    for place in (0, 1, 50, 98, 99):
        said_m = 15 * time_s
        said_m[place] += 500
        course = drive(trip(time_s, said_m))
        first, last = there(course)
        assert (first, last) == (0.1 if place == 0 else 0.0, 9.8 if place == 99 else 9.9)
        known = slice(round(first * 10), round(last * 10) + 1)
        assert x_of(course)[known] == pytest.approx(15 * time_s[known])


def test_after_a_jump_to_stay_the_vehicle_gets_there_as_fast_as_the_fastest() -> None:
    time_s = np.arange(0, 10, 0.1)
    said_m = np.where(time_s < 4.95, 10 * time_s, 10 * time_s + 140)
    x_m = x_of(drive(trip(time_s, said_m)))
    assert x_m[:50] == pytest.approx(said_m[:50])
    assert x_m[80:100] == pytest.approx(said_m[80:100])
    assert np.nanmax(np.abs(np.diff(x_m))) <= 7.0 + 1e-9, "70 m/s"


def test_a_jump_too_far_for_the_longest_gap_is_leaving_and_entering() -> None:
    time_s = np.arange(0, 40, 0.1)
    said_m = np.where(time_s < 9.95, 10 * time_s, 10 * time_s + 1000)
    x_m = x_of(drive(trip(time_s, said_m), seconds=39))
    gone = np.flatnonzero(np.isnan(x_m[:390])) / 10
    assert gone[0] == pytest.approx(10.0)
    assert gone[-1] == pytest.approx(19.9, abs=0.11), "it is away for the longest gap"


def test_a_trip_of_mostly_jumps_is_refused() -> None:
    rng = np.random.default_rng(1)
    with pytest.raises(ScenarioError, match=r"a: .* of 99 steps are faster than 70 m/s: check units"):
        drive(trip(np.arange(100) / 10, rng.uniform(0, 1e4, 100)))


def test_one_impossible_trip_is_left_out_and_told() -> None:
    time_s = np.arange(0, 10, 0.1)
    wild_m = 1000.0 * (np.arange(100) % 2)
    course = drive(trip(time_s, 15 * time_s, name="a"), trip(time_s, wild_m, name="b"))
    assert course.node_ids == ("a",)
    assert course.notes == ("1 of 2 vehicles left out as impossible: b: 99 of 99 steps are faster than 70 m/s",)


@pytest.mark.parametrize("samples", [2, 11])
def test_a_trip_of_which_jumps_leave_nothing_is_told_however_short(samples: int) -> None:
    time_s = np.arange(11.0)
    course = drive(trip(time_s, 15 * time_s, name="a"), trip(time_s[:samples], 72 * time_s[:samples], name="b"))
    steps = f"{samples - 1} of {samples - 1} steps are faster than 70 m/s"
    assert course.notes == (f"1 of 2 vehicles left out as impossible: b: {steps}",)


def test_impossible_trips_are_refused_if_wanted_or_if_most_are() -> None:
    time_s = np.arange(0, 10, 0.1)
    good, *wild = [trip(time_s, 15 * time_s), *(trip(time_s, 1000.0 * (np.arange(100) % 2), name=n) for n in "bcd")]
    with pytest.raises(ScenarioError, match="check units"):
        drive(good, *wild)
    with pytest.raises(ScenarioError, match="check units"):
        motion_of([good, wild[0]], Selection(0.0, 101, TENTH_NS), Rules(70.0, 10.0, leaves_out=False))


CUT = replace(RULES, hardest_mps2=10.0)


def test_what_needs_an_impossible_acceleration_is_cut_and_counted() -> None:
    time_s = np.arange(0, 30, 0.1)
    jumping = trip(time_s, 12 * time_s + np.where(time_s < 15, 0.0, 17.0), name="jumps")
    braking = trip(
        time_s, np.minimum(12 * time_s - 4.5 * np.clip(time_s - 10, 0, 12 / 9) ** 2, 128.0), name="brakes"
    )
    selection = Selection(0.0, 301, TENTH_NS)
    course = motion_of([jumping, braking], selection, CUT)
    assert course.notes == ("1 of 2 vehicles cut at 2 places where they would need over 10 m/s²",)
    gone = np.flatnonzero(np.isnan(x_of(course)[:299])) / 10
    assert gone[0] == pytest.approx(14.5, abs=1.0)
    assert 1.0 < gone[-1] - gone[0] < 3.0, "where it comes up to speed, and where it slows down again"
    assert there(course, 1) == (0.0, 29.9), "hard braking is possible"
    assert not np.isnan(x_of(motion_of([jumping], selection, RULES))[:299]).any(), "driven if not asked for"


@pytest.mark.slow
@settings(max_examples=30)
@given(st.lists(st.floats(-30, 30), min_size=30, max_size=120))
def test_nothing_that_is_driven_needs_more_than_allowed(steps_m: list[float]) -> None:
    x_m = np.cumsum(steps_m)
    try:
        course = motion_of([trip(np.arange(len(x_m)) / 10, x_m)], Selection(0.0, len(x_m), TENTH_NS), CUT)
    except ScenarioError:
        return
    speed_mps = (course.position_m[5:, 0, 0] - course.position_m[:-5, 0, 0]) / 0.5
    change_mps2 = np.abs(speed_mps[5:] - speed_mps[:-5]) / 0.5
    unbroken = np.lib.stride_tricks.sliding_window_view(np.isfinite(course.position_m[:, 0, 0]), 11).all(axis=1)
    assert not (change_mps2[unbroken] > 10 + 1e-6).any()


@pytest.mark.parametrize("speed_mps", [0.0, 12.0])
@pytest.mark.parametrize("jump_m", [8.0, 17.0, 60.0])
def test_a_jump_is_driven_as_fast_as_the_vehicle_drives_around_it(speed_mps: float, jump_m: float) -> None:
    """Receivers correct themselves by some metres at once; nothing drives aside at 50 m/s."""
    time_s = np.arange(0, 30, 0.1)
    said_m = np.where(time_s < 15, 0.0, jump_m)
    noise_m = np.random.default_rng(1).normal(0, 0.05, len(time_s))
    course = drive(trip(time_s, speed_mps * time_s + noise_m, said_m), seconds=29)
    aside_mps = np.abs(np.diff(course.position_m[:, 0, 1])) * 10
    assert np.isfinite(aside_mps).all() or jump_m == 60.0, "it stays, unless it would drive too long"
    assert np.nanmax(aside_mps) <= 1.5 * speed_mps + 7.0
    assert course.position_m[100, 0, 1] == 0.0
    assert course.position_m[-1, 0, 1] == jump_m


def test_real_driving_is_not_taken_for_jumps() -> None:
    """Full acceleration, hard braking, a stand with noise, and positions rounded to a metre."""
    time_s = np.arange(0, 60, 0.1)
    speed_mps = np.interp(time_s, [0, 10, 15, 25, 29, 45, 60], [0, 0, 45, 45, 0, 0, 10])
    true_m = np.cumsum(speed_mps) / 10
    noisy_m = true_m + np.random.default_rng(1).normal(0, 0.3, len(time_s))
    for said_m in (true_m, noisy_m, np.round(true_m)):
        (rows,) = clean(trip(time_s, said_m), RULES)
        assert x_of(drive(trip(time_s, said_m), seconds=59)) == pytest.approx(said_m[:591], abs=2.0)
        assert len(rows) > 100


@pytest.mark.slow
@given(
    st.lists(st.tuples(st.floats(0.05, 3.0), st.floats(-300, 300)), min_size=2, max_size=40),
    st.floats(5, 100),
    st.floats(0.5, 20),
)
def test_what_is_believed_has_no_jump_and_no_gap(
    steps: list[tuple[float, float]], fastest_mps: float, gap_s: float
) -> None:
    rules = Rules(fastest_mps, gap_s)
    time_s, x_m = np.cumsum(np.array(steps), axis=0).T
    one = trip(time_s, x_m)
    jumps = np.sum(np.abs(np.diff(x_m)) > fastest_mps * np.diff(time_s))
    assume(jumps <= 10)
    try:
        parts = clean(one, rules)
    except ImpossibleTripError:
        assert jumps > 0, "jumps leave nothing of it"
        return
    for part in parts:
        assert len(part) > 1 and (np.diff(part) > 0).all()
        assert (np.diff(time_s[part]) <= gap_s).all()
        assert (np.abs(np.diff(x_m[part])) <= fastest_mps * np.diff(time_s[part]) + 1e-9).all()
    if jumps == 0 and (np.diff(time_s) <= gap_s).all() and (np.diff(x_m) != 0).all():
        assert np.concatenate(parts).tolist() == list(range(len(time_s))), "nothing is wrong with it"


# Gaps, entering and leaving.


def test_short_gaps_are_driven_through_and_long_ones_are_absences() -> None:
    time_s = np.array([0, 1, 2, 9, 10, 25, 26, 27.0])
    x_m = x_of(drive(trip(time_s, 5 * time_s), seconds=27))
    present = np.isfinite(x_m)
    assert present[:101].all() and not present[101:250].any() and present[250:271].all()
    assert x_m[:101] == pytest.approx(np.arange(101) / 2)


def test_vehicles_are_numbered_as_they_enter_and_the_first_ones_take_part() -> None:
    late, early, first = trip([5, 9], [0, 9], name="late"), trip([1, 9], [0, 9], name="early"), trip([0, 9], [0, 9])
    assert drive(late, early, first).node_ids == ("a", "early", "late")
    course = drive(late, early, first, most=2)
    assert course.node_ids == ("a", "early")
    assert there(course, 1) == (1.0, 9.0)


def test_the_run_begins_where_it_is_told_to() -> None:
    course = drive(trip(1e9 + np.arange(101), np.arange(101)), start_s=1e9 + 50)
    assert x_of(course)[:100] == pytest.approx(50 + np.arange(100) / 10)


def test_a_vehicle_present_for_less_than_a_second_takes_no_part() -> None:
    course = drive(trip([0, 10], [0, 10]), trip([4, 4.8], [0, 1], name="b"), trip([9.5, 20], [0, 9], name="c"))
    assert course.node_ids == ("a",)
    with pytest.raises(ScenarioError, match="no vehicle is present for 1 s of the 10 s from 0 s"):
        drive(trip([4, 4.8], [0, 1]))
    with pytest.raises(ScenarioError, match="no vehicle is present"):
        drive(trip([50, 60], [0, 1]))
    assert drive(trip([0, 10], [0, 10]), seconds=0.4).node_ids == ("a",), "a short run is as long as it is"


def test_a_disc_is_entered_and_left_and_short_excursions_do_not_count() -> None:
    through = trip(np.arange(41), -200 + 10 * np.arange(41))
    course = drive(through, seconds=40, disc=(0.0, 0.0, 100.0))
    assert there(course) == (10.0, 30.0)
    time_s = np.arange(0, 40.1, 0.1)
    out_and_back = trip(time_s, np.where(np.abs(time_s - 20) < 4, 110.0 - np.abs(time_s - 20) * 5, 90.0))
    assert there(drive(out_and_back, seconds=40, disc=(0.0, 0.0, 100.0))) == (0.0, 40.0)
    with pytest.raises(ScenarioError, match="no vehicle is present within the disc"):
        drive(through, seconds=40, disc=(0.0, 900.0, 100.0))


def test_what_does_not_fit_into_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("emulator.world.trips.motion.MOST_STATES", 150)
    with pytest.raises(ScenarioError, match="2 vehicles for 101 periods: at most 150 states; set max_vehicles"):
        drive(trip([0, 10], [0, 10]), trip([0, 10], [0, 10], name="b"))


# Headings.


def test_headings_are_those_of_the_way_and_a_stand_keeps_the_last() -> None:
    """East for 5 s, a stand of 5 s with a receiver that drifts, north for 5 s."""
    time_s = np.arange(0, 15, 0.1)
    drift = np.random.default_rng(1).normal(0, 0.01, (2, len(time_s))) * ((time_s > 5) & (time_s < 10))
    x_m = 10 * np.minimum(time_s, 5) + drift[0]
    y_m = 10 * np.maximum(time_s - 10, 0) + drift[1]
    heading = drive(trip(time_s, x_m, y_m), seconds=14.9).heading_rad[:, 0]
    assert heading[:45] == pytest.approx(np.zeros(45), abs=1e-9)
    assert heading[105:149] == pytest.approx(np.full(44, math.pi / 2), abs=1e-9)
    assert len(np.unique(heading[56:95])) == 1, "it stands"
    assert math.cos(heading[60]) > 0.99, "and looks where it drove last"


def test_before_it_ever_moves_a_vehicle_looks_where_it_will_drive_and_one_that_never_does_nowhere() -> None:
    time_s = np.arange(0, 10, 0.1)
    waits = trip(time_s, 0.0, -10 * np.maximum(time_s - 5, 0), name="waits")
    course = drive(waits, trip(time_s, 0.01 * np.sin(time_s), name="parked"), seconds=9.9)
    assert course.heading_rad[:99, 0] == pytest.approx(np.full(99, 1.5 * math.pi), abs=1e-9)
    assert np.isnan(course.heading_rad[:, 1]).all()


def test_given_headings_are_taken_and_go_the_short_way_round() -> None:
    turning = trip([0, 1, 2], [0, 0, 0], heading_rad=np.array([6.2, 0.1, 0.3]))
    heading = drive(turning, seconds=2.0).heading_rad[:20, 0]
    assert heading[0] == pytest.approx(6.2) and heading[10] == pytest.approx(0.1)
    assert heading[5] == pytest.approx((6.2 + 0.1 + 2 * math.pi) / 2 % (2 * math.pi))


def test_what_is_missing_between_given_headings_and_speeds_is_interpolated() -> None:
    heading_rad = np.array([np.nan, 1.0, np.nan, 2.0])
    stands = trip([0, 1, 2, 3], [0, 0, 0, 0], heading_rad=heading_rad)
    assert drive(stands, seconds=3.0).heading_rad[:30:5, 0] == pytest.approx([1, 1, 1, 1.25, 1.5, 1.75])
    slow = trip([0, 1, 2, 3], [0, 0.4, 0.8, 1.2], speed_mps=np.array([0.6, np.nan, 0.6, np.nan]))
    assert drive(slow, seconds=3.0).heading_rad[:30, 0] == pytest.approx(np.zeros(30))


def test_a_given_speed_says_who_stands() -> None:
    time_s = np.arange(0, 10, 0.1)
    x_m, y_m = 0.4 * time_s, 0.0 * time_s
    stands = drive(trip(time_s, x_m, y_m), seconds=9.9).heading_rad[:99, 0]
    drives = drive(trip(time_s, x_m, y_m, speed_mps=np.full(100, 0.6)), seconds=9.9).heading_rad[:99, 0]
    assert np.isnan(stands).all() and drives == pytest.approx(np.zeros(99))


@pytest.mark.slow
@given(st.floats(0, 2 * math.pi), st.floats(1, 40), st.integers(0, 30), st.integers(40, 90))
def test_a_straight_drive_is_straight_wherever_its_samples_are(
    heading: float, speed_mps: float, first: int, last: int
) -> None:
    rng = np.random.default_rng(first)
    time_s = np.sort(np.concatenate([[first / 10, last / 10], rng.uniform(first / 10, last / 10, 20)]))
    assume((np.diff(time_s) > 1e-6).all())
    course = drive(trip(time_s, speed_mps * time_s * math.cos(heading), speed_mps * time_s * math.sin(heading)))
    assert there(course) == (first / 10, last / 10)
    at_s = np.arange(first, last + 1) / 10
    along = np.hypot(*course.position_m[first : last + 1, 0].T)
    assert along == pytest.approx(speed_mps * at_s, abs=1e-6)
    difference = np.angle(np.exp(1j * (course.heading_rad[first : last + 1, 0] - heading)))
    assert np.abs(difference).max() < 1e-6
