"""The cooperative program's frame and options."""

import math
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.cooperative.estimator import CAPACITY, Estimator, FixTable
from agents.cooperative.frame import RELAYED, CooperativeFrame, FrameError, decode, encode, room, short_name
from agents.cooperative.options import Options
from agents.cooperative.program import listening_share
from vnet import Fix, Packet
from vnet.errors import ProgramError
from vnet.roads.lanes import LaneMap

pytestmark = pytest.mark.slow

PERIOD_NS = 100_000_000
ONE = np.array([1.0, 1.0])
reals = st.floats(-300, 300)
names = st.integers(0, 10_000).map(lambda number: short_name(f"v{number}"))


@st.composite
def frames(draw: st.DrawFn) -> CooperativeFrame:
    a, b = draw(st.floats(0.01, 10)), draw(st.floats(0.01, 10))
    cross = draw(st.floats(-0.9, 0.9)) * math.sqrt(a * b)
    cloud = draw(st.lists(st.tuples(reals, reals), max_size=20))
    centimetres = st.integers(-(2**31), 2**31 - 1)
    relay = st.tuples(
        st.integers(0, 2**32 - 1), st.integers(0, 255), st.integers(0, 65535), centimetres, centimetres
    )
    return CooperativeFrame(
        draw(st.integers(0, 2**63)),
        np.array(draw(st.tuples(st.floats(-1e7, 1e7), st.floats(-1e7, 1e7)))),
        draw(st.none() | st.floats(0, 6.28)),
        np.array(draw(st.tuples(reals, reals))),
        np.array([[a, cross], [cross, b]]),
        draw(st.integers(0, 2**32 - 1)),
        draw(st.tuples(reals, reals, st.floats(1, 1e9))),
        draw(st.dictionaries(names, st.booleans(), max_size=30)),
        np.array(cloud).reshape(-1, 2),
        np.array(draw(st.lists(relay, max_size=20)), dtype=RELAYED),
        draw(st.integers(0, 255)),
        draw(names),
    )


@given(frames())
def test_a_frame_comes_back_within_its_steps(frame: CooperativeFrame) -> None:
    again = decode(encode(frame))
    assert again.fix_time_ns == frame.fix_time_ns
    assert again.fix_m == pytest.approx(frame.fix_m, abs=0.0051)
    assert again.cloud_m == pytest.approx(frame.cloud_m, abs=0.0051)
    assert again.estimate_m == pytest.approx(frame.estimate_m, rel=1e-6, abs=1e-6)
    assert again.covariance_m2 == pytest.approx(frame.covariance_m2, rel=1e-6, abs=1e-6)
    assert (again.epoch, again.running_sum, again.heard) == (frame.epoch, frame.running_sum, frame.heard)
    assert np.array_equal(again.relayed, frame.relayed)
    assert (again.largest_degree, again.name) == (frame.largest_degree, frame.name)
    assert (again.heading_rad is None) == (frame.heading_rad is None)
    if frame.heading_rad is not None:
        assert again.heading_rad == pytest.approx(frame.heading_rad, abs=1e-4)


@settings(max_examples=80, deadline=None)
@given(st.binary(max_size=300))
def test_arbitrary_bytes_are_refused_with_a_reason(payload: bytes) -> None:
    try:
        decode(payload)
    except FrameError as error:
        assert str(error) in {"length", "version", "checksum"}


@settings(max_examples=80, deadline=None)
@given(frames(), st.data())
def test_damaged_frames_are_refused_or_still_sane(frame: CooperativeFrame, data: st.DataObject) -> None:
    payload = bytearray(encode(frame))
    for _ in range(data.draw(st.integers(1, 5))):
        payload[data.draw(st.integers(0, len(payload) - 1))] ^= data.draw(st.integers(1, 255))
    if bytes(payload) != encode(frame):
        with pytest.raises(FrameError, match=r"length|version|checksum"):
            decode(bytes(payload))
    payload[-4:] = struct.pack("<I", zlib.crc32(payload[:-4]))  # as by somebody who means it
    try:
        again = decode(bytes(payload))
    except FrameError:
        return
    assert np.isfinite(again.estimate_m).all()
    assert np.isfinite(again.cloud_m).all()
    assert np.linalg.det(again.covariance_m2.astype(float)) > 0


def test_two_hundred_particles_and_thirty_neighbours_fit_into_a_frame() -> None:
    assert room(30, 1400) >= 200 * 4
    assert room(0, 10) == 0


def estimator() -> Estimator:
    lanes = LaneMap(np.zeros((1, 2)), np.zeros(1), 0.85)
    return Estimator("v1", Options(particles=20), lanes, np.random.default_rng(0), PERIOD_NS)


def test_old_foreign_and_future_frames_are_counted_and_left_out() -> None:
    now_ns = 100 * PERIOD_NS

    def packet(sender: str, age_periods: int) -> Packet:
        time_ns = now_ns - age_periods * PERIOD_NS
        return Packet(sender, time_ns, now_ns, encode(replace(said(time_ns), name=short_name(sender))))

    subject = estimator()
    packets = [packet("v2", 2), packet("v2", 1), packet("v3", 50), packet("v4", -5), Packet("v5", 0, 0, b"beep")]
    subject.filter(Fix(now_ns - 2 * PERIOD_NS, ONE, np.eye(2), 0.0))
    subject.filter(Fix(now_ns - PERIOD_NS, ONE, np.eye(2), 0.0))
    subject.read(packets, now_ns)
    subject.filter(Fix(now_ns, ONE, np.eye(2), 0.0))
    assert sorted(subject.rbpf.vehicles) == sorted([subject.name, short_name("v2")])
    assert subject.rejected == {"stale": 2, "length": 1}


def test_the_papers_profile_sets_its_constants_and_what_is_set_besides_counts() -> None:
    options = Options.parse({"profile": "paper", "particles": 70})
    assert (options.particles, options.exchange, options.separate_map_update) == (70, "particles", True)
    config = options.filter_config()
    assert config.common_walk_m == pytest.approx(0.5 / math.sqrt(3) / math.sqrt(0.1))
    assert config.min_map_log_likelihood == -math.inf
    assert Options().filter_config().min_map_log_likelihood == -6.0


def test_the_covariance_in_a_frame_of_zeros_is_refused() -> None:
    with pytest.raises(FrameError, match="covariance"):
        decode(encode(replace(said(0), covariance_m2=np.zeros((2, 2)))))


def said(
    fix_time_ns: int,
    epoch: int = 0,
    running_sum: tuple[float, float, float] = (0.0, 0.0, 0.0),
    heard: dict[str, bool] | None = None,
    heading_rad: float | None = 0.0,
) -> CooperativeFrame:
    """A frame of v2."""
    cloud = np.zeros((5, 2))
    frame = CooperativeFrame(fix_time_ns, ONE, heading_rad, ONE, np.eye(2), epoch, running_sum, heard or {}, cloud)
    return replace(frame, name=short_name("v2"))


def drive(subject: Estimator, periods: int, packets: Callable[[int], list[Packet]]) -> None:
    """Let a vehicle work `periods` long on what `packets` brings at each time."""
    for period in range(periods):
        fix = Fix(period * PERIOD_NS, ONE, np.eye(2), 0.0)
        subject.frame(fix, 1400)
        subject.read(packets(fix.time_ns), fix.time_ns)
        subject.filter(fix)
        subject.agree()


def test_a_vehicle_late_with_its_work_uses_the_frames_of_the_next_period_then() -> None:
    """In real time: the neighbours' newest frames are already there when this vehicle looks."""
    subject = estimator()
    drive(subject, 5, lambda now_ns: [Packet("v2", now_ns, now_ns, encode(said(now_ns + PERIOD_NS)))])
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
    assert decode(subject.frame(Fix(60 * PERIOD_NS, ONE, np.eye(2), 0.0), 1400)).epoch < 10


@pytest.mark.parametrize("running_sum", [(1e308, 0.0, 1.0), (0.0, -400.0, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)])
def test_running_sums_whose_ratio_is_no_common_error_are_absurd(running_sum: tuple[float, float, float]) -> None:
    with pytest.raises(FrameError, match="absurd"):
        decode(encode(said(0, epoch=1, running_sum=running_sum)))


COMMON_M = np.array([3.0, -2.0])


def cooperate(options: Options, seconds: float = 15.0, loss: float = 0.2, seed: int = 4) -> list[Estimator]:
    """8 vehicles, on roads of all directions, that hear two neighbours a side as in a line, after `seconds`."""
    rng = np.random.default_rng(11)
    point, heading = rng.uniform(0, 3000, (8, 2)), rng.uniform(0, 2 * np.pi, 8)
    lanes = LaneMap(point, heading, 0.85)
    place = point + rng.uniform(-0.6, 0.6, (8, 1)) * lanes.normal
    ids, rng = [f"v{i}" for i in range(8)], np.random.default_rng(seed)
    vehicles = [Estimator(name, options, lanes, np.random.default_rng(i), PERIOD_NS) for i, name in enumerate(ids)]
    for period in range(int(seconds * 10)):
        now_ns = period * PERIOD_NS
        noisy = place + COMMON_M + rng.normal(size=place.shape)
        fixes = [Fix(now_ns, noisy[i], np.eye(2), float(heading[i])) for i in range(8)]
        air = [Packet(ids[i], now_ns, now_ns, vehicles[i].frame(fixes[i], 1400)) for i in range(8)]
        assert all(len(packet.payload) <= 1400 for packet in air)
        for i, vehicle in enumerate(vehicles):
            vehicle.read([p for j, p in enumerate(air) if 0 < abs(i - j) <= 2 and rng.random() >= loss], now_ns)
            vehicle.filter(fixes[i])
            vehicle.agree()
    assert all(not vehicle.rejected for vehicle in vehicles)
    return vehicles


def errors(options: Options, seconds: float) -> np.ndarray:
    """Errors (8,) of the common error after `seconds`."""
    return np.array([np.linalg.norm(each.rbpf.estimate_m - COMMON_M) for each in cooperate(options, seconds)])


@pytest.mark.parametrize("consensus", ["ratio", "metropolis", "max-degree"])
def test_together_they_find_the_common_error_whatever_the_consensus(consensus: Any) -> None:
    found = errors(Options(particles=100, consensus=consensus), 10.0)
    assert found.max() < 1.5, "the prior's deviation is 3 m an axis"


@pytest.mark.parametrize("fusion", ["random", "metropolis", "max-degree", "constant"])
def test_every_rule_of_fusion_works(fusion: Any) -> None:
    assert errors(Options(particles=50, fusion=fusion, relay=False), 6.0).max() < 2.0


@pytest.mark.parametrize(("relay", "tracked"), [(True, 8), (False, 5)])
def test_relayed_fixes_reach_vehicles_that_cannot_hear_each_other(relay: bool, tracked: int) -> None:
    """In a line of 8 that hear two a side, everybody comes to track everybody; without relay nobody does."""
    vehicles = cooperate(Options(particles=20, relay=relay), 2.0, loss=0.0)
    assert len(vehicles[3].rbpf.vehicles) == tracked


def test_only_the_newest_word_of_a_vehicle_counts_and_old_word_is_forgotten() -> None:
    table = FixTable(1, PERIOD_NS)

    def word(time_ns: int, age: int, x_cm: int) -> CooperativeFrame:
        relayed = np.array([(7, age, 0, x_cm, 0), (1, 0, 0, 5, 5)], dtype=RELAYED)
        return CooperativeFrame(time_ns, ONE, 0.0, ONE, np.eye(2), 0, (0.0, 0.0, 0.0), {}, ONE[None], relayed)

    now_ns = 10 * PERIOD_NS
    table.learn([(2, word(now_ns, 1, 100)), (3, word(now_ns, 2, 999))])
    seen = dict(table.observations(now_ns, np.eye(2)))
    assert sorted(seen) == ["00000002", "00000003", "00000007"], "its own fix is no news"
    assert seen["00000007"].position_m.tolist() == [1.0, 0.0]
    assert seen["00000007"].age_s == pytest.approx(0.1)
    fresh = table.freshest(now_ns, 2)
    assert fresh["name"].tolist() == [2, 3], "the newest first"
    table.forget(now_ns)
    assert sorted(dict(table.observations(now_ns, np.eye(2)))) == ["00000002", "00000003"]


def test_a_liar_cannot_fill_the_memory() -> None:
    table = FixTable(0, PERIOD_NS)
    for start in range(0, 2 * CAPACITY, 250):
        relayed = np.array([(1 + start + i, 0, 0, 0, 0) for i in range(250)], dtype=RELAYED)
        frame = CooperativeFrame(0, ONE, 0.0, ONE, np.eye(2), 0, (0.0, 0.0, 0.0), {}, ONE[None], relayed)
        table.learn([(2**32 - 1, frame)])
    assert len(dict(table.observations(0, np.eye(2)))) == CAPACITY


def test_fusion_brings_estimates_closer_than_none() -> None:
    fused, alone = (
        np.sqrt(np.mean(errors(Options(particles=50, fusion=f, relay=False), 8.0) ** 2))
        for f in ("optimized", "none")
    )
    assert fused < alone


def test_the_exchange_that_is_gone_is_refused_with_those_that_there_are() -> None:
    with pytest.raises(ProgramError, match=r"exchange = 'estimates': one of information, particles expected$"):
        Options.parse({"exchange": "estimates"})


@pytest.mark.parametrize("slots", [1, 2, 7, 1000])
def test_vehicles_compute_in_turn_after_the_last_slot_and_long_before_the_next_fix(slots: int) -> None:
    options = Options.parse({"slots": slots})
    shares = [listening_share(short_name(f"v{number}"), options) for number in range(200)]
    last_slot_share = 0.7 * (slots - 1) / slots
    assert max(0.7, last_slot_share + 0.15) <= min(shares) < max(shares) <= 0.9
    assert sorted(shares.count(share) for share in set(shares))[0] > 30
    assert len(set(shares)) == 4


def test_vehicles_that_send_what_they_have_computed_compute_at_once() -> None:
    for exchange, shares in (("particles", 1), ("information", 4)):  # with information nothing is left to send
        options = Options.parse({"two_frames": True, "exchange": exchange})
        names = [short_name(f"v{number}") for number in range(20)]
        assert len({listening_share(name, options) for name in names}) == shares
