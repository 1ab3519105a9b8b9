"""The filter against textbook filters and closed forms."""

import numpy as np
import numpy.typing as npt
import pytest

from agents.cooperative.cmm.map_matching import log_on_lane
from agents.cooperative.cmm.rbpf import REST_SPEED_M_S, Observation, Rbpf, RbpfConfig
from vnet.errors import VnetError
from vnet.roads.lanes import LaneMap

DT_S = 0.1
NOWHERE = LaneMap(np.empty((0, 2)), np.empty(0), 0.85)


def observation(position: npt.ArrayLike, heading: float = 0.3) -> Observation:
    return Observation(np.asarray(position, dtype=float), np.eye(2), heading)


def moving(t: float, heading: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition and process noise over `t`: white acceleration 1 m²/s⁴ along the lane, 0.01 across."""
    along, across = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    acceleration = np.outer(along, along) + 0.01 * np.outer(across, across)
    process = np.block(
        [[t**4 / 4 * acceleration, t**3 / 2 * acceleration], [t**3 / 2 * acceleration, t**2 * acceleration]]
    )
    return np.block([[np.eye(2), t * np.eye(2)], [np.zeros((2, 2)), np.eye(2)]]), process


def textbook(fixes: np.ndarray, heading: float) -> tuple[np.ndarray, np.ndarray]:
    """A Kalman filter on [x, y, ẋ, ẏ], written out; where fixes are missing it moves further in one step."""
    elapsed_s = 0.0
    observe = np.hstack([np.eye(2), np.zeros((2, 2))])
    state = np.concatenate([fixes[0], [0, 0]])
    covariance = np.diag([1.0, 1.0, REST_SPEED_M_S**2, REST_SPEED_M_S**2])
    for fix in fixes[1:]:
        elapsed_s += DT_S
        if np.isnan(fix).any():
            continue
        transition, process = moving(elapsed_s, heading)
        elapsed_s = 0.0
        state, covariance = transition @ state, transition @ covariance @ transition.T + process
        gain = covariance @ observe.T @ np.linalg.inv(observe @ covariance @ observe.T + np.eye(2))
        state = state + gain @ (fix - observe @ state)
        covariance = (np.eye(4) - gain @ observe) @ covariance
    return state, covariance


def known_error(common_m: tuple[float, float], particles: int = 2) -> Rbpf:
    """A filter that knows the common error: all particles on it, and it never moves."""
    config = RbpfConfig(particles=particles, common_sigma_m=0.0, common_tau_s=1e12)
    rbpf = Rbpf(config, NOWHERE, np.random.default_rng(0))
    rbpf.common_m[:] = np.array(common_m)[:, None]
    return rbpf


@pytest.mark.parametrize("missing", [[], [5, 6, 12]])
def test_with_a_known_common_error_it_is_the_textbook_kalman_filter(missing: list[int]) -> None:
    rng = np.random.default_rng(3)
    common = np.array([2.0, -1.0])
    fixes = np.cumsum(rng.normal(0, 0.2, (30, 2)), axis=0) + rng.normal(size=(30, 2))
    fixes[missing] = np.nan
    rbpf = known_error((2.0, -1.0))
    for fix in fixes:
        rbpf.step(DT_S, {} if np.isnan(fix).any() else {"v": observation(fix + common)})
    state, covariance = textbook(fixes, 0.3)
    position, position_covariance = rbpf.position_m("v")
    assert position == pytest.approx(state[:2], abs=1e-9)
    assert rbpf.velocity_m_s("v") == pytest.approx(state[2:], abs=1e-9)
    assert position_covariance == pytest.approx(covariance[:2, :2], abs=1e-9)


def test_an_exact_receiver_gives_finite_estimates() -> None:
    lane = LaneMap(np.zeros((1, 2)), np.zeros(1), 0.85)
    rbpf = Rbpf(RbpfConfig(particles=50), lane, np.random.default_rng(1))
    for at_m in (5.0, 5.01, 5.02):
        rbpf.step(DT_S, {"v": Observation(np.array([at_m, 1.0]), np.zeros((2, 2)), 0.0)})
    assert np.isfinite(rbpf.estimate_covariance_m2).all()
    position_m, covariance_m2 = rbpf.position_m("v")
    assert position_m + rbpf.estimate_m == pytest.approx([5.02, 1.0], abs=0.05)
    assert np.isfinite(covariance_m2).all()


def test_one_gain_serves_all_particles() -> None:
    rbpf = Rbpf(RbpfConfig(particles=50), NOWHERE, np.random.default_rng(1))
    rng = np.random.default_rng(2)
    for _ in range(10):
        rbpf.step(DT_S, {"v": observation(rng.normal(size=2)), "w": observation(rng.normal(size=2), 1.2)})
    assert rbpf.tracks.mean.shape == (2, 4, 50)
    assert rbpf.tracks.covariance.shape == (2, 4, 4)


def test_an_outlier_is_left_out() -> None:
    with_outlier, without = known_error((0.0, 0.0)), known_error((0.0, 0.0))
    for _ in range(20):
        for rbpf in (with_outlier, without):
            rbpf.step(DT_S, {"v": observation([0.0, 0.0])})
    with_outlier.step(DT_S, {"v": observation([60.0, 0.0])})
    without.step(DT_S, {})
    assert with_outlier.position_m("v")[0] == pytest.approx(without.position_m("v")[0])


@pytest.mark.parametrize(("spread_m", "taken"), [(0.0, False), (4.0, True)])
def test_a_fix_that_is_far_off_may_be_explained_by_an_uncertain_common_error(spread_m: float, taken: bool) -> None:
    """10 m from the mean are 7 deviations of the fix alone, and 2.4 with 4 m of uncertainty about c."""
    rbpf = known_error((0.0, 0.0), particles=100)
    rbpf.step(DT_S, {"v": observation([0.0, 0.0])})
    rbpf.common_m[:] = spread_m * np.random.default_rng(2).standard_normal(rbpf.common_m.shape)
    before = rbpf.tracks.covariance.copy()
    rbpf.step(DT_S, {"v": observation([10.0, 0.0])})
    assert (np.trace(rbpf.tracks.covariance[0, :2, :2]) < np.trace(before[0, :2, :2])) == taken


def test_vehicles_on_no_lane_on_one_and_between_two_are_weighed_each_by_its_own() -> None:
    lanes = LaneMap(np.array([[0.0, 0.0], [0.0, 3.5], [900.0, 0.0]]), np.array([0.0, 0.0, np.pi / 2]), 0.85)
    rbpf = Rbpf(RbpfConfig(particles=50), lanes, np.random.default_rng(1))
    places: dict[str, tuple[list[float], float]] = {
        "a": ([0.0, 1.75], 0.0),
        "b": ([500.0, 500.0], 0.0),
        "c": ([900.0, 9.0], np.pi / 2),
    }
    rbpf.step(DT_S, {name: observation(place, heading) for name, (place, heading) in places.items()})
    across = np.sqrt(rbpf.tracks.covariance[:, 0, 0])[:, None]
    two = [log_on_lane(rbpf.tracks.mean[:1, 1] - north, across[:1], 0.85) for north in (0.0, 3.5)]
    one = log_on_lane(rbpf.tracks.mean[2:, 0] - 900.0, across[2:], 0.85)
    score = rbpf.map_evidence.log_likelihood(rbpf.tracks, rbpf.tracks.mean)
    assert score == pytest.approx(np.concatenate([np.logaddexp(*two), np.zeros(one.shape), one]), abs=1e-9)
    some = rbpf.map_evidence.log_likelihood(rbpf.tracks, rbpf.tracks.mean, np.array([0, 2]))
    assert np.array_equal(some, score[[0, 2]])


def test_a_vehicle_not_heard_for_a_while_is_forgotten_and_may_come_back() -> None:
    rbpf = Rbpf(RbpfConfig(particles=10, forget_s=1.0), NOWHERE, np.random.default_rng(1))
    rbpf.step(DT_S, {"v": observation([0, 0]), "w": observation([5, 5])})
    for _ in range(15):
        rbpf.step(DT_S, {"v": observation([0, 0])})
    assert rbpf.vehicles == ["v"]
    rbpf.step(DT_S, {"w": observation([5, 5])})
    assert rbpf.vehicles == ["v", "w"]
    assert np.isfinite(rbpf.tracks.mean).all()


def test_an_old_fix_is_held_against_the_common_error_of_its_own_time() -> None:
    """The error jumps; who knows when a fix was taken is not misled by it."""
    rbpf = known_error((0.0, 0.0))
    here = np.array([5.0, 5.0])
    for step in range(40):
        if step == 20:
            rbpf.common_m[:] = np.array([100.0, 0.0])[:, None]
        rbpf.step(DT_S, {"v": Observation(here + ([100.0, 0.0] if step >= 23 else 0.0), np.eye(2), 0.3, age_s=0.3)})
    assert rbpf.position_m("v")[0] == pytest.approx(here, abs=1e-6)


@pytest.mark.parametrize("dt_s", [0.1, 0.25, 0.1 / 3])
def test_the_common_error_is_remembered_for_its_time_and_no_longer(dt_s: float) -> None:
    """c goes up by one a step, and a fix of so many steps ago is held against that of its time."""
    rbpf = known_error((0.0, 0.0))
    for step in range(1, 60):
        rbpf.common_m[:] = step
        steps_ago = min(step - 1, int(1.4 / dt_s))
        fix = np.full(2, float(step - steps_ago))
        rbpf.step(dt_s, {f"v{step}": Observation(fix, np.eye(2), 0.3, age_s=steps_ago * dt_s)})
        row = rbpf.vehicles.index(f"v{step}")
        assert np.abs(rbpf.tracks.mean[row, :2]).max() < 1e-6
    rbpf.step(dt_s, {"late": Observation(np.zeros(2), np.eye(2), 0.3, age_s=1.5 + dt_s)})
    assert "late" not in rbpf.vehicles


def test_a_fix_that_is_not_new_or_too_old_changes_nothing() -> None:
    rbpf = known_error((0.0, 0.0))
    for _ in range(10):
        rbpf.step(DT_S, {"v": observation([0.0, 0.0])})
    before = rbpf.tracks.covariance.copy()
    rbpf.step(DT_S, {"v": Observation(np.zeros(2), np.eye(2), 0.3, age_s=0.1)})
    rbpf.step(DT_S, {"v": Observation(np.zeros(2), np.eye(2), 0.3, age_s=0.5)})
    rbpf.step(DT_S, {"w": Observation(np.zeros(2), np.eye(2), 0.3, age_s=100.0)})
    assert np.array_equal(rbpf.tracks.covariance, before)
    assert rbpf.vehicles == ["v"]


def test_lanes_bounded_on_one_side_let_a_vehicle_walk_off_on_the_other() -> None:
    """The paper's half-plane: on the right of the lane a vehicle is caught, on the left it is not."""
    lane = LaneMap(np.zeros((1, 2)), np.zeros(1), 0.85)  # heading east: the right is south
    for one_sided, north_m, expected in ((True, 5.0, True), (True, -5.0, False), (False, 5.0, False)):
        rbpf = Rbpf(RbpfConfig(2, one_sided=one_sided, start_sigma_m=0.0), lane, np.random.default_rng(0))
        rbpf.step(DT_S, {"v": Observation(np.array([0.0, north_m]), 0.01 * np.eye(2), 0.0)})
        likely = float(rbpf.tracks.map_log_likelihood.max()) > -1.0
        assert likely == expected


def crossing_error(vehicles: int, parallel: bool, seed: int) -> float:
    """Squared error of the common error after 3 s with `vehicles` on roads of random or one direction."""
    rng = np.random.default_rng(seed)
    heading = np.zeros(vehicles) if parallel else rng.uniform(0, 2 * np.pi, vehicles)
    point = rng.uniform(0, 3000, (vehicles, 2))
    lanes = LaneMap(point, heading, 0.85)
    normal = lanes.normal
    place = point + rng.uniform(-0.85, 0.85, (vehicles, 1)) * normal
    common = rng.normal(0, 3, 2)
    rbpf = Rbpf(RbpfConfig(particles=400), lanes, np.random.default_rng(seed + 1))
    for _ in range(30):
        fixes = place + common + rng.normal(0, 0.3, place.shape)
        noise = 0.09 * np.eye(2)
        rbpf.step(DT_S, {f"v{j}": Observation(fixes[j], noise, float(heading[j])) for j in range(vehicles)})
    return float(np.sum((rbpf.estimate_m - common) ** 2))


@pytest.mark.slow
def test_more_road_directions_make_a_smaller_error() -> None:
    """MODEL 8: the squared error falls with the number of vehicles; parallel roads leave one direction open."""
    few, many = (np.mean([crossing_error(n, False, seed) for seed in range(6)]) for n in (3, 24))
    assert many < few / 3
    parallel = np.mean([crossing_error(24, True, seed) for seed in range(6)])
    assert parallel > 10 * many


def test_without_a_map_nothing_separates_a_vehicle_from_the_error() -> None:
    """The fixes alone say where vehicle plus error is: the spread of c stays that of its prior."""
    rbpf = Rbpf(RbpfConfig(particles=2000, common_tau_s=1e9), NOWHERE, np.random.default_rng(0))
    rng = np.random.default_rng(1)
    for _ in range(50):
        rbpf.step(DT_S, {f"v{j}": observation(rng.normal(size=2)) for j in range(5)})
    assert np.sqrt(np.diag(rbpf.estimate_covariance_m2)) == pytest.approx([3.0, 3.0], rel=0.2)


def test_the_variance_of_a_mean_of_independent_fixes() -> None:
    """A vehicle at rest, known error: after n fixes of variance 1 the variance is 1/n (no process noise)."""
    config = RbpfConfig(particles=2, common_sigma_m=0.0, common_tau_s=1e12, acceleration_m2_s4=0.0)
    rbpf = Rbpf(config, NOWHERE, np.random.default_rng(0))
    for _ in range(25):
        rbpf.step(1e-6, {"v": observation([1.0, 1.0])})
    assert rbpf.position_m("v")[1] == pytest.approx(np.eye(2) / 25, rel=1e-3, abs=1e-6)


@pytest.mark.parametrize(("walk_m", "variance_m2"), [(None, 9.0), (0.5 / np.sqrt(0.1), 9.0 + 10 * 0.25)])
def test_the_common_error_is_a_gauss_markov_process_or_a_random_walk(
    walk_m: float | None, variance_m2: float
) -> None:
    """Ten steps: the Gauss-Markov process keeps its variance, a walk of 0.5 m a step gains 0.25 m² each."""
    config = RbpfConfig(particles=40_000, common_walk_m=walk_m, common_tau_s=1.0, start_sigma_m=3.0)
    rbpf = Rbpf(config, NOWHERE, np.random.default_rng(0))
    start = rbpf.common_m.copy()
    for _ in range(10):
        rbpf.step(DT_S, {})
    assert np.diag(rbpf.estimate_covariance_m2) == pytest.approx([variance_m2] * 2, rel=0.03)
    kept = 1.0 if walk_m else np.exp(-1.0)
    assert np.mean(start * rbpf.common_m) / 9.0 == pytest.approx(kept, abs=0.03)


def test_a_filter_needs_particles() -> None:
    with pytest.raises(VnetError, match="particles = 0: at least 1"):
        RbpfConfig(particles=0)


def test_one_particle_is_enough_to_run() -> None:
    rbpf = Rbpf(RbpfConfig(particles=1), NOWHERE, np.random.default_rng(0))
    for _ in range(20):
        rbpf.step(DT_S, {"v": observation([1.0, 1.0])})
    assert np.isfinite(rbpf.estimate_m).all()
    assert rbpf.common_m.shape == (2, 1)
