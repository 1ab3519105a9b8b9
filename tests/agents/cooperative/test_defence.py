"""The cooperative program against attackers, copies, replays, floods, restarts and partitions."""

import copy
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from agents.cooperative.attacker import Attack, Attacker
from agents.cooperative.estimator import CAPACITY, Estimator, FixTable, usable
from agents.cooperative.frame import (
    FORGET_PERIODS,
    MAX_SENDERS,
    RELAYED,
    Admission,
    CooperativeFrame,
    decode,
    encode,
    short_name,
)
from agents.cooperative.options import Options
from emulator.drivers.simulate import simulate
from emulator.scenario.scenario import Scenario
from tests.support.recorded import prepared
from vnet import Fix, Packet
from vnet.roads.lanes import LaneMap

pytestmark = pytest.mark.slow

PERIOD_NS = 100_000_000
COMMON = np.array([3.0, -2.0])
OPTIONS = Options(particles=60)
Air = Callable[[int, list[Packet]], list[Packet]]


class Town:
    """Vehicles v0, v1, … on roads of all directions that all hear each other, in lockstep; nothing is lost.

    `hears(i, j)` may say who hears whom; `air` may change what is sent in each period.
    """

    def __init__(self, count: int = 8, seed: int = 11, attack: Attack | None = None) -> None:
        rng = np.random.default_rng(seed)
        point, heading = rng.uniform(0, 3000, (count, 2)), rng.uniform(0, 2 * np.pi, count)
        self.lanes = LaneMap(point, heading, 0.85)
        self.place = point + rng.uniform(-0.6, 0.6, (count, 1)) * self.lanes.normal
        self.ids = [f"v{i}" for i in range(count)]
        self.vehicles = [self.fresh(i) for i in range(count)]
        if attack:
            self.vehicles[0] = Attacker("v0", OPTIONS, self.lanes, np.random.default_rng(0), PERIOD_NS)
            self.vehicles[0].attack = attack  # type: ignore[attr-defined]
        self.hears: Callable[[int, int], bool] = lambda i, j: True
        self.air: Air = lambda period, packets: packets
        self.bend = np.zeros((count, 2))
        self.period = 0
        self._rng = rng

    def fresh(self, number: int, incarnation: int = 0) -> Estimator:
        rng = np.random.default_rng([number, incarnation])
        return Estimator(self.ids[number], OPTIONS, self.lanes, rng, PERIOD_NS)

    def run(self, periods: int) -> None:
        for _ in range(periods):
            now_ns = self.period * PERIOD_NS
            noisy = self.place + COMMON + self.bend + self._rng.normal(size=self.place.shape)
            fixes = [
                Fix(now_ns, p, np.eye(2), float(h)) for p, h in zip(noisy, self.lanes.heading_rad, strict=True)
            ]
            sent = [
                Packet(v, now_ns, now_ns, e.frame(f, 1400))
                for v, e, f in zip(self.ids, self.vehicles, fixes, strict=True)
            ]
            sent = self.air(self.period, sent)
            for i, vehicle in enumerate(self.vehicles):
                mine = [p for p in sent if p.sender != self.ids[i] and self.hears(i, self.number(p.sender))]
                vehicle.read(mine, now_ns)
                vehicle.filter(fixes[i])
                vehicle.agree()
            self.period += 1

    def number(self, node: str) -> int:
        return self.ids.index(node.partition("~")[0])

    def errors(self) -> np.ndarray:
        return np.array([np.linalg.norm(v.rbpf.estimate_m - COMMON) for v in self.vehicles])

    def means(self) -> np.ndarray:
        return np.array(
            [(np.nan, np.nan) if v.consensus.mean_m is None else v.consensus.mean_m for v in self.vehicles]
        )

    def estimates(self) -> np.ndarray:
        return np.array([v.rbpf.estimate_m for v in self.vehicles])

    def rejected(self, first: int = 1) -> set[str]:
        """Reasons for which any vehicle from the number `first` on has rejected anything."""
        return {reason for vehicle in self.vehicles[first:] for reason in vehicle.rejected}


@cache
def town_after(periods: int) -> Town:
    """A town of honest vehicles after some periods: for reading, and to be copied."""
    town = Town()
    town.run(periods)
    return town


def rejected_copies(copies: Callable[[Packet], list[Packet]]) -> list[Counter[str]]:
    """Counts of what each other vehicle has rejected, if for 20 periods these follow each frame of v3 in vain."""
    town = Town()
    town.air = lambda _, packets: [
        each for packet in packets for each in ([packet, *copies(packet)] if packet.sender == "v3" else [packet])
    ]
    town.run(20)
    assert np.array_equal(town.estimates(), town_after(20).estimates()), "it changes nothing"
    return [vehicle.rejected for i, vehicle in enumerate(town.vehicles) if i != 3]


def test_among_honest_vehicles_nothing_is_rejected() -> None:
    assert town_after(100).rejected(0) == set()
    assert town_after(100).errors().max() < 0.7


@pytest.mark.parametrize(
    ("lie", "reasons"),
    [
        ("offset", {"outlier"}),
        ("overconfident", {"outlier"}),
        ("sums", {"implausible_mass", "banned"}),
        ("relay", {"forged"}),
        ("epoch", {"banned", "absurd"}),
        ("non_finite", {"not_finite"}),
        ("absurd", {"absurd", "covariance"}),
        ("random", {"length", "version"}),
    ],
)
def test_each_lie_is_counted_by_its_reason_and_moves_nobody(lie: Any, reasons: set[str]) -> None:
    town = Town(attack=Attack(lie=lie))
    town.run({"epoch": 100, "sums": 60}.get(lie, 40))  # after a ban it takes longer to agree
    assert town.rejected() - {"length"} == reasons - {"length"}
    assert town.errors()[1:].max() < 0.7
    means = town.means()[1:]
    mean = town.estimates()[1:].mean(axis=0)
    assert np.linalg.norm(means.mean(axis=0) - mean) < 0.3, "the honest agree on their own mean, not on a lie"
    assert np.linalg.norm(means - mean, axis=1).max() < 0.6, "as close as 60 particles can follow each other"


def test_a_lie_that_begins_late_does_not_poison_the_mean_of_before() -> None:
    town = Town(attack=Attack(lie="sums", from_s=6.0))
    town.run(60)
    for _ in range(40):
        town.run(1)
        assert np.linalg.norm(town.means()[1:] - town.estimates()[1:].mean(axis=0), axis=1).max() < 0.9


def test_the_attackers_options_are_its_own_and_those_of_the_program_that_it_extends() -> None:
    attack, options = Attack.split({"lie": "sums", "offset_m": [1, 2], "particles": 30})
    assert attack == Attack(lie="sums", offset_m=(1.0, 2.0))
    assert options == Options(particles=30)


@pytest.mark.parametrize("bend", [(50.0, 0.0), (3.0, -3.0), "random"])
def test_a_receiver_that_fails_bends_nobody_elses_estimate_and_breaks_nothing(
    bend: tuple[float, float] | str,
) -> None:
    town = Town()
    rng = np.random.default_rng(1)
    for _ in range(40):
        town.bend[0] = rng.uniform(-2000, 2000, 2) if bend == "random" else bend
        town.run(1)
        position_m, covariance_m2 = town.vehicles[0].position(Fix(0, np.zeros(2), np.eye(2), None))
        assert np.isfinite(position_m).all() and np.isfinite(covariance_m2).all()
    assert town.errors().max() < 1.2, "not even its own"


def test_fixes_that_are_no_numbers_are_not_used_and_not_said() -> None:
    here = np.zeros(2)
    assert usable(Fix(0, here, np.eye(2), None))
    for fix in (
        Fix(0, np.array([np.nan, 0.0]), np.eye(2), None),
        Fix(0, np.array([1e9, 0.0]), np.eye(2), None),
        Fix(0, here, np.full((2, 2), np.inf), None),
        Fix(0, here, np.eye(2), float("nan")),
    ):
        assert not usable(fix)
        subject = Town().vehicles[0]
        subject.filter(fix)
        subject.agree()
        subject.filter(replace(fix, time_ns=-5 * PERIOD_NS))
        assert np.isfinite(subject.rbpf.estimate_m).all()
        assert subject.rbpf.vehicles == []


def test_a_flood_is_read_once() -> None:
    assert rejected_copies(lambda packet: [packet] * 9) == [{"duplicate": 9 * 20}] * 7


def test_frames_of_the_past_are_old_or_stale() -> None:
    kept: list[Packet] = []

    def replay(packet: Packet) -> list[Packet]:
        kept.append(packet)
        return [kept[-3], kept[0]] if len(kept) >= 10 else []

    assert rejected_copies(replay) == [{"duplicate": 11, "stale": 11}] * 7


def test_ghosts_are_copies() -> None:
    """Be it that they send the same bytes or put their own names to them."""

    def ghosts(packet: Packet) -> list[Packet]:
        own = replace(decode(packet.payload), name=short_name("v3~2"))
        return [structs.replace(packet, sender="v3~1"), structs.replace(packet, sender="v3~2", payload=encode(own))]

    assert rejected_copies(ghosts) == [{"replayed": 40}] * 7


def test_corrupt_frames_are_no_frames() -> None:
    town = Town()
    rng = np.random.default_rng(2)

    def corrupt(period: int, packets: list[Packet]) -> list[Packet]:
        broken = bytearray(packets[3].payload)
        broken[rng.integers(len(broken))] ^= 1 << rng.integers(8)
        return [*packets[:3], structs.replace(packets[3], payload=bytes(broken)), *packets[4:]]

    town.air = corrupt
    town.run(30)
    assert town.rejected(4) <= {"checksum", "version", "length"}
    assert all(v.rejected.total() == 30 for i, v in enumerate(town.vehicles) if i != 3)


def frame_of(name: str, period: int, place_cm: int = 0, relayed: np.ndarray | None = None) -> CooperativeFrame:
    fix_m = np.array([place_cm / 100, 0.0])
    nothing = np.empty(0, dtype=RELAYED)
    return CooperativeFrame(
        period * PERIOD_NS,
        fix_m,
        0.0,
        np.zeros(2),
        np.eye(2),
        0,
        (0.0, 0.0, 0.0),
        {},
        np.zeros((0, 2)),
        nothing if relayed is None else relayed,
        name=name,
    )


def test_ten_thousand_names_leave_the_memory_as_it_was() -> None:
    """And those who were known before are still heard among them."""
    admission = Admission("00000000", PERIOD_NS, decode)
    read = 0
    for period in range(40):
        now_ns = period * PERIOD_NS
        flood = [f"ghost{period}-{number}" for number in range(250)]
        packets = [
            Packet(node, now_ns, now_ns, encode(frame_of(short_name(node), period + early, number)))
            for number, node in enumerate(["v1", *flood])
            for early in (0, 1)
        ]
        read += sum(sender == short_name("v1") for sender, _ in admission.admit(packets, now_ns))
        sizes = [len(held) for held in (admission.ids, admission._newest_ns, admission._early)]
        assert max(sizes) <= 2 * MAX_SENDERS
        assert len(admission._first_sender) <= 2 * FORGET_PERIODS * MAX_SENDERS
    assert read == 40
    assert set(admission.rejected) <= {"too_many_senders", "duplicate", "replayed"}
    assert admission.rejected["too_many_senders"] > 5000


def test_own_words_have_a_place_where_invented_names_have_filled_the_memory() -> None:
    table = FixTable(0, PERIOD_NS)
    for start in range(0, 2 * CAPACITY, 250):
        relayed = np.array([(1000 + start + i, 0, 0, 0, 0) for i in range(250)], dtype=RELAYED)
        table.learn([(7, frame_of("00000007", 0, 0, relayed))])
    table.learn([(8, frame_of("00000008", 0, 100))])
    assert "00000008" in dict(table.observations(0, np.eye(2)))


def test_what_a_vehicle_says_itself_goes_before_what_is_said_of_it() -> None:
    table = FixTable(0, PERIOD_NS)
    false = np.array([(8, 0, 0, 5000, 0), (9, 0, 0, 5000, 0)], dtype=RELAYED)
    assert table.learn([(7, frame_of("00000007", 3, 0, false))]) == [], "nobody knows better yet"
    assert table.learn([(8, frame_of("00000008", 3, 100))]) == []
    assert dict(table.observations(3 * PERIOD_NS, np.eye(2)))["00000008"].position_m.tolist() == [1.0, 0.0]
    later = np.array([(8, 1, 0, 5000, 0), (9, 0, 0, 7000, 0)], dtype=RELAYED)
    assert table.learn([(7, frame_of("00000007", 4, 0, later))]) == [7]
    seen = dict(table.observations(4 * PERIOD_NS, np.eye(2)))
    assert seen["00000009"].position_m.tolist() == [50.0, 0.0], "of who forges one word none is taken"
    assert seen["00000007"].age_s == pytest.approx(0.1)


def test_who_has_been_deceived_about_one_is_believed_about_the_others() -> None:
    table = FixTable(0, PERIOD_NS)
    table.learn([(code, frame_of(f"{code:08x}", 3, code)) for code in (8, 9, 10)])
    mixed = np.array([(8, 1, 0, 5000, 0), (9, 1, 0, 9, 0), (10, 1, 0, 10, 0), (11, 0, 0, 1, 0)], dtype=RELAYED)
    assert table.learn([(7, frame_of("00000007", 4, 0, mixed))]) == []
    assert "0000000b" in dict(table.observations(4 * PERIOD_NS, np.eye(2)))


def test_a_restarted_vehicle_is_taken_in_at_once_and_the_mean_recovers() -> None:
    town = copy.deepcopy(town_after(100))
    town.vehicles[3] = town.fresh(3, incarnation=1)
    town.run(1)
    assert all(short_name("v3") in v._frames or short_name("v3") in v._share.heard for v in town.vehicles[4:])
    town.run(19)
    assert town.errors()[3] < 0.7, "back within two seconds"
    town.run(40)
    assert town.rejected(0) == set()
    assert np.linalg.norm(town.means().mean(axis=0) - town.estimates().mean(axis=0)) < 0.2
    assert np.linalg.norm(town.means() - town.estimates().mean(axis=0), axis=1).max() < 0.5


def test_a_vehicle_that_stood_still_does_not_use_what_it_heard_before() -> None:
    town = Town(count=3)
    town.run(5)
    vehicle, now_ns = town.vehicles[1], 5 * PERIOD_NS
    fix = Fix(now_ns, town.place[0] + COMMON, np.eye(2), None)
    vehicle.read([Packet("v0", now_ns, now_ns, town.vehicles[0].frame(fix, 1400))], now_ns)
    later_ns = now_ns + 30 * PERIOD_NS
    vehicle.read([], later_ns)
    vehicle.filter(Fix(later_ns, town.place[1] + COMMON, np.eye(2), None))
    estimate = vehicle.rbpf.estimate_m
    vehicle.agree()
    assert np.array_equal(vehicle.rbpf.estimate_m, estimate)


def test_after_a_partition_heals_the_halves_agree_within_ten_seconds() -> None:
    town = Town()
    town.run(30)
    town.hears = lambda i, j: (i < 4) == (j < 4)
    town.run(60)
    halves = [town.means()[half].mean(axis=0) for half in (slice(0, 4), slice(4, 8))]
    assert np.linalg.norm(halves[0] - town.estimates()[:4].mean(axis=0)) < 0.2, "each has a mean of its own"
    town.hears = lambda i, j: True
    town.run(100)
    assert np.linalg.norm(town.means().mean(axis=0) - town.estimates().mean(axis=0)) < 0.2
    assert np.linalg.norm(town.means() - town.estimates().mean(axis=0), axis=1).max() < 0.5
    assert np.linalg.norm(town.estimates() - town.estimates().mean(axis=0), axis=1).max() < 0.5
    assert town.rejected(0) == set()


@pytest.mark.parametrize(("exchange", "reason"), [("particles", "outlier"), ("information", "prior")])
def test_a_scenario_may_have_a_liar_and_what_is_rejected_is_reported(
    tmp_path: Path, exchange: str, reason: str
) -> None:
    options = {"particles": 30, "exchange": exchange}
    liar = {"nodes": ["v01"], "entry": "agents.cooperative.attacker:main", "options": {"lie": "offset", **options}}
    program = {"entry": "agents.cooperative:main", "options": options, "exceptions": [liar]}
    network = {"vehicles": 6, "layout": "dense"}
    scenario = Scenario.model_validate({"run": {"duration_s": 2.5}, "network": network, "program": program})
    emulation = prepared(scenario, tmp_path / "run")
    simulate(emulation)
    states = emulation.metrics.states_table().to_pylist()
    last = {row["node"]: row for row in states if row["period"] == 20}
    assert all(row[f"rejected.{reason}"] >= 15 for node, row in last.items() if node != "v01")
    assert not any(value for name, value in last["v01"].items() if name.startswith("rejected."))
    assert all(row["rejected"] >= 15 for node, row in last.items() if node != "v01")
