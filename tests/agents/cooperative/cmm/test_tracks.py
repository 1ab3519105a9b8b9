"""Tracks against a dictionary of vehicles, and motion against its closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from agents.cooperative.cmm.tracks import Tracks, predicted_covariance, transition, white_acceleration
from vnet.types import Array

K = 3
FORGET_S = 1.0


class Vehicle:
    """The expected record of one vehicle; `mark` is a number of its own in each of its fields."""

    def __init__(self, mark: float, lanes: list[int], particles: int) -> None:
        self.mark = mark
        self.lanes = lanes
        self.mean: Array = np.full((4, particles), float(mark)) + np.arange(particles, dtype=float)
        self.map_log_likelihood = np.zeros(particles)
        self.age_s = self.unseen_s = mark / 1000
        self.anchor_rad = np.nan


class TracksMachine(RuleBasedStateMachine):
    """Add, see, forget, resample and seek lanes in any order: ids and rows stay together."""

    def __init__(self) -> None:
        super().__init__()
        self.tracks = Tracks(K)
        self.particles = K
        self.vehicles: dict[str, Vehicle] = {}
        self.count = 0

    @rule(lanes=st.lists(st.integers(0, 9), max_size=3))
    def add(self, lanes: list[int]) -> None:
        self.count += 1
        vehicle = Vehicle(float(self.count), lanes, self.particles)
        name = f"v{self.count}"
        self.vehicles[name] = vehicle
        self.tracks.add(
            name,
            mean=vehicle.mean,
            covariance=np.eye(4) * vehicle.mark,
            acceleration_m2_s4=np.eye(2) * vehicle.mark,
            age_s=vehicle.age_s,
            heading_rad=None if self.count % 2 else vehicle.mark,
            lanes=lanes,
        )

    @precondition(lambda self: self.vehicles)
    @rule(data=st.data())
    def see(self, data: st.DataObject) -> None:
        row = data.draw(st.integers(0, len(self.vehicles) - 1))
        vehicle = list(self.vehicles.values())[row]
        vehicle.age_s = vehicle.unseen_s = 0.0
        vehicle.anchor_rad = vehicle.mark
        vehicle.map_log_likelihood = np.full(self.particles, -vehicle.mark) + np.arange(self.particles)
        self.tracks.table["age_s"][row] = self.tracks.table["unseen_s"][row] = 0.0
        self.tracks.table["anchor_rad"][row] = vehicle.mark
        self.tracks.map_log_likelihood[row] = vehicle.map_log_likelihood

    @rule(dt_s=st.floats(0, 0.6))
    def advance(self, dt_s: float) -> None:
        self.tracks.advance(dt_s)
        for vehicle in self.vehicles.values():
            vehicle.age_s += dt_s
            vehicle.unseen_s += dt_s

    @rule()
    def forget(self) -> None:
        self.tracks.drop_unseen(FORGET_S)
        self.vehicles = {name: v for name, v in self.vehicles.items() if v.unseen_s <= FORGET_S}

    @rule(data=st.data(), count=st.integers(1, 4))
    def resample(self, data: st.DataObject, count: int) -> None:
        index = data.draw(st.lists(st.integers(0, self.particles - 1), min_size=count, max_size=count))
        self.particles = count
        self.tracks.take_particles(np.array(index))
        for vehicle in self.vehicles.values():
            vehicle.mean = vehicle.mean[:, index]
            vehicle.map_log_likelihood = vehicle.map_log_likelihood[index]

    @rule(data=st.data())
    def seek(self, data: st.DataObject) -> None:
        every = range(len(self.vehicles))
        rows = [row for row in every if data.draw(st.booleans())]
        lanes = {row: data.draw(st.lists(st.integers(0, 9), max_size=3)) for row in rows}
        pairs = np.array([(row, lane) for row in rows for lane in lanes[row]], dtype=np.intp).reshape(-1, 2)
        self.tracks.set_candidates(np.array(rows, dtype=np.intp), pairs[:, 0], pairs[:, 1])
        for row, vehicle in enumerate(self.vehicles.values()):
            vehicle.lanes = lanes.get(row, vehicle.lanes)

    @invariant()
    def everything_is_in_its_row(self) -> None:
        tracks, vehicles = self.tracks, list(self.vehicles.values())
        assert tracks.names == list(self.vehicles)
        assert len(tracks) == len(tracks.table) == len(tracks.mean) == len(tracks.map_log_likelihood)
        for row, vehicle in enumerate(vehicles):
            record = tracks.table[row]
            assert np.array_equal(tracks.mean[row], vehicle.mean)
            assert np.array_equal(tracks.map_log_likelihood[row], vehicle.map_log_likelihood)
            assert np.array_equal(tracks.covariance[row], np.eye(4) * vehicle.mark)
            assert np.array_equal(tracks.acceleration_m2_s4[row], np.tile(np.eye(2) * vehicle.mark, (2, 2)))
            assert (record["age_s"], record["unseen_s"]) == (vehicle.age_s, vehicle.unseen_s)
            assert np.array_equal(record["anchor_rad"], vehicle.anchor_rad, equal_nan=True)
            assert np.isnan(record["heading_rad"]) if vehicle.mark % 2 else record["heading_rad"] == vehicle.mark
            assert tracks.candidates(np.array([row]))[1].tolist() == vehicle.lanes
        assert tracks.candidate_row.tolist() == [row for row, v in enumerate(vehicles) for _ in v.lanes]
        assert tracks.without_candidate().tolist() == [not vehicle.lanes for vehicle in vehicles]


TestTracks = TracksMachine.TestCase
TestTracks.settings = settings(max_examples=30, stateful_step_count=30, deadline=None)


@pytest.mark.slow
@given(st.floats(0.01, 5), st.floats(0.01, 5))
def test_two_transitions_are_one_over_both_times(first_s: float, second_s: float) -> None:
    both = transition(np.array([second_s])) @ transition(np.array([first_s]))
    assert both == pytest.approx(transition(np.array([first_s + second_s])))
    state = transition(np.array([first_s]))[0] @ [1.0, 2.0, 3.0, 4.0]
    assert state == pytest.approx([1 + 3 * first_s, 2 + 4 * first_s, 3, 4])


def test_a_constant_acceleration_adds_half_a_t_squared_to_the_position() -> None:
    """Known at first; after 2 s the variances are (t²/2)² and t² times that of the acceleration."""
    elapsed_s = np.array([2.0])
    acceleration = np.tile(np.diag([3.0, 0.0]), (1, 2, 2))
    found = predicted_covariance(np.zeros((1, 4, 4)), transition(elapsed_s), acceleration, elapsed_s)[0]
    assert found[np.ix_([0, 2], [0, 2])] == pytest.approx(3.0 * np.array([[4.0, 4.0], [4.0, 4.0]]))
    assert not found[[1, 3]].any()


def test_acceleration_is_along_the_heading_or_in_all_directions() -> None:
    along = np.array([np.cos(0.4), np.sin(0.4)])
    acceleration = white_acceleration(0.4, (16.0, 4.0))
    assert acceleration @ along == pytest.approx(16.0 * along)
    assert np.linalg.eigvalsh(acceleration) == pytest.approx([4.0, 16.0])
    assert np.array_equal(white_acceleration(None, (16.0, 4.0)), 16.0 * np.eye(2))
