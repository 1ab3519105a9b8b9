"""The cooperative program's frame and options."""

import math
from collections.abc import Callable

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
from vnet import Fix, Packet
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
        draw(st.tuples(reals, reals, st.floats(1, 1e9))),
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
    packets = [packet("v2", 2), packet("v2", 1), packet("v3", 50), packet("v4", -5), Packet("v5", 0, 0, b"beep")]
    read = subject.read(packets, now_ns, period_ns)
    assert list(read) == [short_name("v2")]
    assert read[short_name("v2")].fix_time_ns == now_ns - period_ns, "the newest of each"
    assert subject.rejected == {"stale": 2, "length": 1}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fusoin": "none"}, "program.options.fusoin: unknown; allowed: common_sigma_m"),
        ({"fusion": "magic"}, "program.options.fusion = 'magic': allowed: optimized, random, none"),
        ({"consensus": "exact"}, "program.options.consensus = 'exact': allowed: ratio, metropolis, max-degree"),
        ({"common_sigma_m": float("inf")}, "program.options.common_sigma_m = inf: 0 to 327.0 allowed"),
        ({"self_floor": 1.5}, "program.options.self_floor = 1.5: 0 to 1 allowed"),
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


PERIOD_NS = 100_000_000
ONE = np.array([1.0, 1.0])


def said(
    fix_time_ns: int,
    epoch: int = 0,
    running_sum: tuple[float, float, float] = (0.0, 0.0, 0.0),
    heard: dict[str, bool] | None = None,
    heading_rad: float | None = 0.0,
) -> CooperativeFrame:
    cloud = np.zeros((5, 2))
    return CooperativeFrame(fix_time_ns, ONE, heading_rad, ONE, np.eye(2), epoch, running_sum, heard or {}, cloud)


def drive(subject: Estimator, periods: int, packets: Callable[[int], list[Packet]]) -> None:
    """Let a vehicle work `periods` long on what `packets` brings at each time."""
    previous: Fix | None = None
    for period in range(periods):
        fix = Fix(period * PERIOD_NS, ONE, np.eye(2), 0.0)
        read = subject.read(packets(fix.time_ns), fix.time_ns, PERIOD_NS)
        if previous is not None:
            subject.step(0.1, previous, read)
        subject.frame(fix, 1400)
        previous = fix


def test_a_vehicle_late_with_its_work_uses_the_frames_of_this_very_period_in_the_next() -> None:
    """In real time: the neighbours' newest frames are already there when this vehicle looks."""
    subject = estimator()
    drive(subject, 5, lambda now_ns: [Packet("v2", now_ns, now_ns, encode(said(now_ns)))])
    assert short_name("v2") in subject.rbpf.vehicles
    assert not subject.rejected


@pytest.mark.parametrize("heading_rad", [2 * math.pi, -0.01, 2 * math.pi - 1e-12, 7.0])
def test_any_heading_can_be_said(heading_rad: float) -> None:
    again = decode(encode(said(0, heading_rad=heading_rad))).heading_rad
    assert again is not None
    turn = math.remainder(again - heading_rad, 2 * math.pi)
    assert abs(turn) < 1e-3


def test_an_absurd_epoch_is_refused_and_does_not_spread() -> None:
    """It would be taken over by all, and one more could not be written into a frame."""
    subject = estimator()
    heard = {subject.name: True}

    def liar(now_ns: int) -> list[Packet]:
        frame = said(now_ns - PERIOD_NS, epoch=2**32 - 1, heard=heard)
        return [Packet("v2", now_ns, now_ns, encode(frame))] if 20 <= now_ns // PERIOD_NS < 30 else []

    drive(subject, 60, liar)
    assert subject.rejected == {"absurd": 10}
    assert decode(subject.frame(Fix(0, ONE, np.eye(2), 0.0), 1400)).epoch < 10


@pytest.mark.parametrize("running_sum", [(1e308, 0.0, 1.0), (0.0, -400.0, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)])
def test_running_sums_whose_ratio_is_no_common_error_are_absurd(running_sum: tuple[float, float, float]) -> None:
    with pytest.raises(FrameError, match="absurd"):
        decode(encode(said(0, epoch=1, running_sum=running_sum)))


def town(count: int, seed: int) -> tuple[LaneMap, np.ndarray]:
    """Lanes of `count` vehicles and where they are, on roads of all directions."""
    rng = np.random.default_rng(seed)
    point, heading = rng.uniform(0, 3000, (count, 2)), rng.uniform(0, 2 * np.pi, count)
    lanes = LaneMap(point, heading, 0.85)
    return lanes, point + rng.uniform(-0.6, 0.6, (count, 1)) * lanes.normal


def cooperate(options: Options, seconds: float = 15.0, loss: float = 0.2, seed: int = 4) -> np.ndarray:
    """Errors (N,) of the common error in a line of 8 vehicles that hear two neighbours a side, after `seconds`."""
    lanes, place = town(8, 11)
    ids = [f"v{i}" for i in range(8)]
    rng = np.random.default_rng(seed)
    common = np.array([3.0, -2.0])
    vehicles = [Estimator(name, options, lanes, np.random.default_rng(i)) for i, name in enumerate(ids)]
    air: list[Packet] = []
    previous: list[Fix] | None = None
    for period in range(int(seconds * 10)):
        now_ns = period * PERIOD_NS
        noisy = place + common + rng.normal(size=place.shape)
        fixes = [Fix(now_ns, noisy[i], np.eye(2), float(lanes.heading_rad[i])) for i in range(8)]
        for i, vehicle in enumerate(vehicles):
            heard = [p for j, p in enumerate(air) if 0 < abs(i - j) <= 2 and rng.random() >= loss]
            frames = vehicle.read(heard, now_ns, PERIOD_NS)
            if previous is not None:
                vehicle.step(0.1, previous[i], frames)
        air = [Packet(ids[i], now_ns, now_ns, vehicles[i].frame(fixes[i], 1400)) for i in range(8)]
        assert all(len(packet.payload) <= 1400 for packet in air)
        previous = fixes
    assert all(not vehicle.rejected for vehicle in vehicles)
    return np.array([np.linalg.norm(vehicle.rbpf.estimate_m - common) for vehicle in vehicles])


@pytest.mark.parametrize("consensus", ["ratio", "metropolis", "max-degree"])
def test_together_they_find_the_common_error_whatever_the_consensus(consensus: str) -> None:
    errors = cooperate(Options(particles=100, consensus=consensus))
    assert errors.max() < 1.0, "the prior's deviation is 3 m an axis"


def test_fusion_brings_estimates_closer_than_none() -> None:
    fused, alone = (
        np.sqrt(np.mean([cooperate(Options(particles=100, fusion=f), seed=s) ** 2 for s in (4, 5)]))
        for f in ("optimized", "none")
    )
    assert fused < alone
