"""The cooperative program's frame and options."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.cooperative import Estimator, Options
from agents.cooperative_frame import (
    CooperativeFrame,
    FrameError,
    decode,
    encode,
    room_for_particles,
    short_name,
)
from vnet import Packet
from vnet.errors import ProgramError
from vnet.roads.lanes import LaneMap

reals = st.floats(-300, 300)
names = st.integers(0, 10_000).map(lambda number: short_name(f"v{number}"))


@st.composite
def frames(draw: st.DrawFn) -> CooperativeFrame:
    a, b = draw(st.floats(0.01, 10)), draw(st.floats(0.01, 10))
    cross = draw(st.floats(-0.9, 0.9)) * math.sqrt(a * b)
    cloud = draw(st.lists(st.tuples(reals, reals), min_size=1, max_size=20))
    return CooperativeFrame(
        draw(st.integers(0, 2**63)),
        np.array(draw(st.tuples(st.floats(-2e7, 2e7), st.floats(-2e7, 2e7)))),
        draw(st.none() | st.floats(0, 6.28)),
        np.array(draw(st.tuples(reals, reals))),
        np.array([[a, cross], [cross, b]]),
        draw(st.integers(0, 2**32 - 1)),
        draw(st.tuples(reals, reals, st.floats(0, 1e9))),
        draw(st.dictionaries(names, st.booleans(), max_size=30)),
        np.array(cloud),
    )


@settings(max_examples=100, deadline=None)
@given(frames())
def test_a_frame_comes_back_within_its_steps(frame: CooperativeFrame) -> None:
    again = decode(encode(frame))
    assert again.fix_time_ns == frame.fix_time_ns
    assert again.fix_m == pytest.approx(frame.fix_m, abs=0.0051)
    assert again.cloud_m == pytest.approx(frame.cloud_m, abs=0.0051)
    assert again.estimate_m == pytest.approx(frame.estimate_m, rel=1e-6, abs=1e-6)
    assert again.covariance_m2 == pytest.approx(frame.covariance_m2, rel=1e-6, abs=1e-6)
    assert (again.epoch, again.running_sum, again.heard) == (frame.epoch, frame.running_sum, frame.heard)
    assert (again.heading_rad is None) == (frame.heading_rad is None)
    if frame.heading_rad is not None:
        assert again.heading_rad == pytest.approx(frame.heading_rad, abs=1e-4)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=300))
def test_arbitrary_bytes_are_refused_with_a_reason(payload: bytes) -> None:
    try:
        decode(payload)
    except FrameError as error:
        assert str(error) in {"length", "version", "not_finite", "absurd", "covariance"}


@settings(max_examples=200, deadline=None)
@given(frames(), st.data())
def test_damaged_frames_are_refused_or_still_sane(frame: CooperativeFrame, data: st.DataObject) -> None:
    payload = bytearray(encode(frame))
    for _ in range(data.draw(st.integers(1, 5))):
        payload[data.draw(st.integers(0, len(payload) - 1))] ^= data.draw(st.integers(1, 255))
    try:
        again = decode(bytes(payload))
    except FrameError:
        return
    assert np.isfinite(again.estimate_m).all()
    assert np.isfinite(again.cloud_m).all()
    assert np.linalg.det(again.covariance_m2.astype(float)) > 0


def test_two_hundred_particles_and_thirty_neighbours_fit_into_a_frame() -> None:
    assert room_for_particles(30, 1400) >= 200
    assert room_for_particles(0, 10) == 0


def estimator() -> Estimator:
    lanes = LaneMap(np.zeros((1, 2)), np.zeros(1), 0.85)
    return Estimator("v1", Options(particles=20), lanes, np.random.default_rng(0))


def test_old_foreign_and_future_frames_are_counted_and_left_out() -> None:
    period_ns = 100_000_000
    now_ns = 100 * period_ns

    def packet(sender: str, age_periods: int) -> Packet:
        time_ns = now_ns - age_periods * period_ns
        one = np.array([1.0, 1.0])
        frame = CooperativeFrame(time_ns, one, 0.0, one, np.eye(2), 0, (0.0, 0.0, 0.0), {}, np.zeros((5, 2)))
        return Packet(sender, time_ns, now_ns, encode(frame))

    subject = estimator()
    packets = [packet("v2", 2), packet("v2", 1), packet("v3", 50), packet("v4", -1), Packet("v5", 0, 0, b"beep")]
    read = subject.read(packets, now_ns, period_ns)
    assert list(read) == [short_name("v2")]
    assert read[short_name("v2")].fix_time_ns == now_ns - period_ns, "the newest of each"
    assert subject.rejected == {"stale": 2, "length": 1}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fusoin": "none"}, "program.options.fusoin: unknown; allowed: common_sigma_m"),
        ({"fusion": "magic"}, "program.options.fusion = 'magic': allowed: optimized, random, none"),
        ({"particles": "many"}, "program.options.particles = 'many': int expected"),
        ({"particles": 1}, "program.options.particles = 1: 2 to 100000 allowed"),
        ({"lateral_tau_s": 0.0}, "program.options.lateral_tau_s = 0.0: must be positive"),
        ({"common_tau_s": float("nan")}, "program.options.common_tau_s = nan: must be positive"),
    ],
)
def test_a_wrong_option_is_one_line(options: dict[str, object], message: str) -> None:
    with pytest.raises(ProgramError) as caught:
        Options.parse(options)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_covariance_in_a_frame_of_zeros_is_refused() -> None:
    one = np.array([1.0, 1.0])
    frame = CooperativeFrame(0, one, 0.0, one, np.zeros((2, 2)), 0, (0.0, 0.0, 0.0), {}, np.zeros((1, 2)))
    with pytest.raises(FrameError, match="covariance"):
        decode(encode(frame))
