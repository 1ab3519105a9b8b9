"""Information about the common error: its algebra, and what a vehicle believes of others'."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from agents.cooperative.cmm.information import (
    Five,
    Information,
    gained,
    inverse,
    new_at_mean,
    plain_moments,
    square_root,
    transport,
)
from agents.cooperative.cmm.plausibility import (
    FAR,
    INCREMENT_GATE,
    MANY,
    PRIOR_GATE,
    SUM_GATE,
    Belief,
    Origins,
    all_of,
    cut_to,
    median_belief,
    moved,
    prior_shares,
    relative_to_most,
    scaled_down,
    spread_limit_m,
)
from vnet.types import Array


@st.composite
def covariances(draw: st.DrawFn) -> Array:
    """Draw a positive definite matrix with deviations of 1 cm to 10 m, in any direction."""
    sigma = [draw(st.floats(0.01, 10)) for _ in range(2)]
    angle = draw(st.floats(0, np.pi))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.asarray(turn @ np.diag(np.square(sigma)) @ turn.T)


@pytest.mark.slow
@given(covariances())
def test_inverse_and_square_root_are_those_of_the_matrix(matrix: Array) -> None:
    assert_allclose(inverse(matrix) @ matrix, np.eye(2), atol=1e-6)
    assert_allclose(square_root(matrix) @ square_root(matrix), matrix, rtol=1e-9, atol=1e-9)


@st.composite
def said(draw: st.DrawFn) -> Five:
    """Draw a piece of information."""
    (a, b), (_, d) = draw(covariances()).tolist()
    return a, b, d, draw(st.floats(-9, 9)), draw(st.floats(-9, 9))


@pytest.mark.slow
@given(said())
def test_plain_moments_are_those_of_arrays(information: Five) -> None:
    mean_m, covariance_m2 = Information(information).moments()
    plain = *mean_m, covariance_m2[0, 0], covariance_m2[0, 1], covariance_m2[1, 1]
    assert_allclose(plain_moments(*information), plain, rtol=1e-12)
    x, y, *_ = plain_moments(*moved(information, 0.5, -2.0))
    assert_allclose((x - 0.5, y + 2.0), mean_m, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
@given(said(), covariances(), st.tuples(st.floats(-9, 9), st.floats(-9, 9)))
def test_a_deviation_is_that_of_matrices(
    information: Five, covariance_m2: Array, mean: tuple[float, float]
) -> None:
    matrix, vector = Information(information).matrix, Information(information).vector
    total = matrix + matrix @ covariance_m2 @ matrix
    total += (1e-4 * np.trace(total) + 1e-9) * np.eye(2)
    off = vector - matrix @ np.array(mean)
    share = _share_of_first(information, (mean, _entries(covariance_m2)))
    assert share == pytest.approx(_share_at(off @ np.linalg.solve(total, off)), rel=1e-5)


@pytest.mark.slow
@given(covariances(), covariances())
def test_a_cloud_that_is_transported_has_the_new_covariance(old: Array, new: Array) -> None:
    moves = transport(old, new)
    assert_allclose(moves @ old @ moves.T, new, rtol=1e-4, atol=1e-7)
    assert_allclose(moves, moves.T, rtol=1e-5, atol=1e-8)  # symmetric and positive: nothing is turned needlessly
    assert np.linalg.eigvalsh(moves)[0] > 0


@pytest.mark.slow
@given(covariances(), covariances(), st.tuples(st.floats(-9, 9), st.floats(-9, 9)))
def test_what_is_gained_is_what_was_added(prior: Array, noise: Array, fix: tuple[float, float]) -> None:
    before = Information.of(np.array([1.0, -2.0]), prior)
    added = Information.of(np.array(fix), noise)
    got = gained(before, before.plus(added))
    assert_allclose(got.matrix, added.matrix, rtol=1e-6, atol=1e-6 * np.abs(before.matrix).max())
    assert_allclose(got.vector, added.vector, rtol=1e-5, atol=1e-5 * np.abs(before.matrix).max())
    lost = gained(before.plus(added), before)  # nothing was gained: less is known in every direction
    assert_allclose(lost.matrix, 0, atol=1e-9)
    assert_allclose(lost.vector, 0, atol=1e-9)


def test_moments_come_back() -> None:
    mean_m, covariance_m2 = np.array([3.0, -1.0]), np.array([[2.0, 0.5], [0.5, 1.0]])
    for got, expected in zip(Information.of(mean_m, covariance_m2).moments(), (mean_m, covariance_m2), strict=True):
        assert_allclose(got, expected)


def _entries(matrix: Array) -> tuple[float, float, float]:
    """Return (xx, xy, yy) of a symmetric matrix."""
    (a, b), (_, d) = matrix.tolist()
    return a, b, d


def _information(mean_m: tuple[float, float], variance_m2: float) -> Five:
    return 1 / variance_m2, 0.0, 1 / variance_m2, mean_m[0] / variance_m2, mean_m[1] / variance_m2


def test_what_says_too_much_is_scaled_and_keeps_its_mean() -> None:
    loud, quiet = _information((4.0, 2.0), 0.01), _information((1.0, 1.0), 10.0)
    scaled = scaled_down([loud, quiet], 1.0)
    assert scaled[1] == quiet
    assert scaled[0][0] + scaled[0][2] == pytest.approx(1.0)
    assert_allclose(plain_moments(*scaled[0])[:2], [4.0, 2.0])


def _share_of_first(increment: Five, belief: Belief) -> float:
    """Return the share of an origin's first increment that is used."""
    return Origins().shares([1], [increment], belief, 0.0)[0]


def _share_at(deviation: float) -> float:
    """Return the same for its squared deviation, which is also that of the sum of one."""
    gate = INCREMENT_GATE + (SUM_GATE - INCREMENT_GATE) / MANY
    if deviation < gate:
        return 1.0
    return min(1.0, INCREMENT_GATE / deviation, (gate / deviation) ** 0.5, FAR * gate / deviation)


def test_deviation_is_the_mahalanobis_distance_of_a_fix() -> None:
    """An increment of a vehicle that knows where it is: a measurement of c with noise R."""
    mean_m, covariance_m2, noise_m2 = np.array([1.0, 2.0]), np.diag([0.5, 0.2]), 4.0
    increment = _information((23.0, -9.0), noise_m2)
    off = np.array([22.0, -11.0])
    expected = _share_at(float(off @ np.linalg.solve(covariance_m2 + noise_m2 * np.eye(2), off)))
    assert expected < 0.5
    found = _share_of_first(increment, (mean_m.tolist(), _entries(covariance_m2)))
    assert found == pytest.approx(expected, rel=1e-3)


def test_a_lane_that_says_nothing_along_itself_may_not_move_c_along_it() -> None:
    belief = (0.0, 0.0), (0.1, 0.0, 0.1)
    assert _share_of_first((0.5, 0.0, 0.0, 0.2, 0.0), belief) == 1
    assert _share_of_first((0.5, 0.0, 0.0, 0.2, 0.5), belief) < _share_at(1000)
    assert _share_of_first((0.0, 0.0, 0.0, 0.0, 0.0), belief) == 1


def test_a_small_lie_is_found_in_the_sum_counts_for_less_and_is_forgiven_later() -> None:
    origins, belief = Origins(), ((0.0, 0.0), (0.01, 0.0, 0.01))
    honest, liar = _information((0.3, 0.0), 2.0), _information((3.0, 0.0), 2.0)
    believed = [origins.shares([1, 2], [honest, liar], belief, 0.1 * k) for k in range(50)]
    assert all(good for good, _ in believed)
    assert believed[0][1]  # by itself it is what noise may do
    assert max(lie for _, lie in believed[15:]) < 0.5
    assert origins.shares([2], [honest], belief, 240.0) == [True]


def shares_after(offsets_m: list[float], is_about_lanes: bool = False) -> list[float]:
    """Return the shares of origins that have been off by these for 30 s."""
    origins, belief = Origins(), ((0.0, 0.0), (0.01, 0.0, 0.01))
    codes, said = range(len(offsets_m)), [_information((off_m, 0.0), 2.0) for off_m in offsets_m]
    for k in range(300):
        shares = origins.shares(codes, said, belief, 0.1 * k, is_about_lanes)
    return shares


def test_outliers_are_weighed_by_how_far_they_are_beyond_the_gates() -> None:
    """An honest vehicle among few may contradict for long: it counts less and less, and a liar's pull vanishes."""
    shares = shares_after([0.2, 0.4, 50.0])
    assert shares[0] == 1
    assert 0.2 < shares[1] < 1
    assert 0 < shares[2] < 1e-3 * shares[1]


@pytest.mark.parametrize("is_about_lanes", [False, True])
def test_among_many_a_lie_pulls_the_less_the_larger_it_is(is_about_lanes: bool) -> None:
    """A pull that lasts adds up: c returns slowly."""
    lies_m = [0.3, 0.4, 0.8, 50.0]
    *honest, _, _, _, _ = shares = shares_after([0.0] * 8 + lies_m, is_about_lanes)
    assert honest == [1.0] * 8
    pulls_m = [share * lie_m for share, lie_m in zip(shares[8:], lies_m, strict=True)]
    assert pulls_m == sorted(pulls_m, reverse=True)
    assert pulls_m[0] < lies_m[0] and pulls_m[-1] < 1e-3


@pytest.mark.parametrize("claim", [1.0, 100.0, 1e5])
def test_a_liar_that_claims_much_is_not_what_most_deviate_by(claim: float) -> None:
    origins, belief = Origins(), ((0.0, 0.0), (0.01, 0.0, 0.01))
    said = [_information((0.0, 0.0), 2.0)] * 9 + [_information((5.0, 5.0), 2.0 / claim)]
    for k in range(300):
        *honest, liar = origins.shares(range(10), said, belief, 0.1 * k)
    assert honest == [1.0] * 9
    assert liar < 0.01


@pytest.mark.parametrize("period_s", [0.1, 0.5, 1.0, 2.0])
def test_what_is_passed_on_counts_among_what_most_deviate_by(period_s: float) -> None:
    origins, belief = Origins(), ((0.0, 0.0), (0.01, 0.0, 0.01))
    said = _information((0.6, 0.0), 0.5)
    for k in range(300):
        shares = origins.shares(range(3), [said] * 3, belief, period_s * k)
        shares += origins.shares(range(3, 20), [said] * 17, belief, period_s * k)
    assert shares == [1.0] * 20


def test_increments_passed_on_by_others_do_not_hide_what_most_are_off_by() -> None:
    """A period's relayed increments are few, and are compared with the same belief."""
    origins, belief = Origins(), ((0.0, 0.0), (0.01, 0.0, 0.01))
    said = _information((0.3, 0.0), 2.0)
    for k in range(300):
        shares = origins.shares(range(10), [said] * 10, belief, 0.1 * k)
        origins.shares([99], [said], belief, 0.1 * k)
    assert shares == [1.0] * 10


def test_what_is_not_vouched_for_does_not_say_what_most_are_off_by() -> None:
    """Thirty that are off by a metre, of whom one sender has told, are judged by ten that are heard."""
    origins, belief = Origins(), ((0.0, 0.0), (0.01, 0.0, 0.01))
    honest, off = [_information((0.0, 0.0), 2.0)] * 10, [_information((1.0, 0.0), 2.0)] * 30
    for k in range(100):
        assert origins.shares(range(10), honest, belief, 0.1 * k) == [1.0] * 10
        codes, said = [*range(10, 40), all_of(3)], [*off, _information((1.0, 0.0), 2.0 / 30)]
        shares = origins.shares(codes, said, belief, 0.1 * k, unvouched=set(range(10, 40)))
    assert max(shares) < 0.1


@pytest.mark.parametrize("liar_m", [-0.4, 1.0, 50.0])
def test_what_most_are_off_by_in_common_is_an_error_of_the_belief(liar_m: float) -> None:
    assert all(share < 1 for share in shares_after([0.3] * 9 + [liar_m], is_about_lanes=True))
    *honest, liar = shares_after([0.3] * 9 + [liar_m])
    assert honest == [1.0] * 9
    assert liar < 0.5


def test_sums_are_of_what_was_believed_when_it_was_said() -> None:
    """The common error moves by half a metre in the memory of a sum: that contradicts nobody."""
    origins = Origins()
    for k in range(200):
        moving_m = np.array([0.01 * k, 0.0])
        increment = Information.of(moving_m, 2.0 * np.eye(2))
        said = [(0.5, 0.0, 0.5, *increment.numbers[3:])]
        assert origins.shares([1], said, (moving_m.tolist(), (0.01, 0.0, 0.01)), 0.1 * k) == [True]


@pytest.mark.parametrize(("variance_m2", "limit_m"), [(0.02, 0.02), (2.0, 0.2)])
def test_a_lean_to_one_side_is_taken_off_beyond_what_is_claimed(variance_m2: float, limit_m: float) -> None:
    """One stays 0.5 m off, one as far to either side in turns; what is left is a tenth of a claimed deviation."""
    origins, own = Origins(), (0.0, 0.0, variance_m2, 0.0, 0.5 * variance_m2)
    for k in range(600):
        priors = [(1 + off_m, 2.0, variance_m2, 0.0, 0.5 * variance_m2) for off_m in (0.5, 0.5 * (-1) ** k)]
        less_m, leans = origins.without_lean([1, 2], priors, own, (1.0, 2.0), 0.1 * k)
    assert_allclose(less_m[0], [limit_m, 0.0], atol=0.01)
    assert_allclose(less_m[1], [priors[1][0] - 1, 0.0], atol=1e-9)
    assert leans == [True, False]
    assert Origins().without_lean([1, 2], priors, own, (1.0, 2.0), 0.0)[1] is None


def test_a_lean_is_measured_by_deviations_in_all_directions() -> None:
    """Along the wide axis of a slanted ellipse more is allowed than across it, whatever the axes of the map."""
    claimed, left_m = (0.5, 0.45, 0.5), []
    for mean_m in ((0.3, 0.3), (0.3, -0.3)):
        origins = Origins()
        for k in range(600):
            less_m, _ = origins.without_lean([1], [mean_m + claimed], (0.0, 0.0, *claimed), (0.0, 0.0), 0.1 * k)
        left_m.append(float(np.hypot(*less_m[0])))
    assert left_m[0] == pytest.approx(0.1 * np.sqrt(1.9), rel=0.03)
    assert left_m[1] == pytest.approx(0.1 * np.sqrt(0.1), rel=0.05)


def test_offsets_are_cut_to_a_length() -> None:
    off_m = [(0.3, 0.4), (0.0, 0.0), (3.0, 4.0)]
    assert_allclose(cut_to(off_m, 1.0), [[0.3, 0.4], [0.0, 0.0], [0.6, 0.8]])
    assert cut_to(off_m, np.inf) is off_m


def test_only_so_many_origins_are_kept() -> None:
    origins, belief = Origins(), ((0.0, 0.0), (1.0, 0.0, 1.0))
    increment = _information((0.0, 0.0), 1.0)
    for first in range(0, 20_000, 500):
        origins.shares(list(range(first, first + 500)), [increment] * 500, belief, first / 100)
    assert len(origins) <= 1024


def test_priors_count_in_full_within_what_both_claim_and_a_liars_pull_vanishes() -> None:
    priors = [(off_m, 0.0, 0.5, 0.0, 0.5) for off_m in (0.0, 1.5, 4.0, 40.0)]
    shares = prior_shares(priors, priors[0])
    assert shares == pytest.approx([1.0, 1.0, 4 / 4.0**2, 4 / 40.0**2])
    pulls_m = [share * off_m for share, (off_m, *_) in zip(shares, priors, strict=True)]
    assert pulls_m[3] < pulls_m[2] < pulls_m[1], "the further off, the less it draws"


def test_priors_are_weighed_by_the_distance_of_mahalanobis() -> None:
    rng = np.random.default_rng(1)
    roots, means = rng.normal(size=(200, 2, 2)), 2 * rng.normal(size=(200, 2))
    covariances_m2 = roots @ roots.transpose(0, 2, 1)
    own_m, own_m2 = np.array([0.3, -0.2]), np.array([[0.2, 0.1], [0.1, 0.3]])
    off_m = means - own_m
    squared = np.einsum("ni,nij,nj->n", off_m, np.linalg.inv(covariances_m2 + own_m2), off_m)
    priors = [tuple(row) for row in np.hstack([means, covariances_m2.reshape(-1, 4)[:, [0, 1, 3]]]).tolist()]
    shares = prior_shares(priors, (0.3, -0.2, 0.2, 0.1, 0.3))
    assert_allclose(shares, np.minimum(1.0, PRIOR_GATE / squared))
    assert min(shares) < 1 == max(shares)


def test_the_median_belief_is_not_moved_by_one_liar() -> None:
    priors = [_information((1.0, 1.0), 0.2), _information((1.2, 0.8), 0.1), _information((99.0, -99.0), 1e-6)]
    mean_m, covariance_m2 = median_belief(priors).moments()
    assert_allclose(mean_m, [1.2, 0.8])
    assert_allclose(covariance_m2, 0.4 * np.eye(2))


def test_a_prior_far_from_the_spread_of_all_is_an_outlier() -> None:
    rng = np.random.default_rng(3)
    means_m = 0.05 * rng.standard_normal((20, 2)) + [2.0, 1.0]
    means_m[4] += [0.4, 0.0]
    median_m, limit_m = spread_limit_m([(x, y, 1.0, 0.0, 1.0) for x, y in means_m.tolist()])
    distances_m = np.hypot(*(means_m - median_m).T)
    assert np.flatnonzero(distances_m > limit_m).tolist() == [4]
    assert limit_m == pytest.approx(0.05 + 3.5 * 0.05, rel=0.4)


def test_of_three_no_majority_can_be_told() -> None:
    assert spread_limit_m([(x, 0.0, 1.0, 0.0, 1.0) for x in (0.0, 0.0, 9.0)])[1] == np.inf


@pytest.mark.parametrize(
    ("shares", "expected"),
    [
        ([1.0, 1.0, 0.0], [1.0, 1.0, 0.0]),
        ([1.0, 0.2, 0.1], [1.0, 1.0, 0.5]),
        ([0.2, 0.2, 0.0], [1.0, 1.0, 0.0]),
        ([0.0, 0.0], [0.0, 0.0]),
    ],
)
def test_where_most_disagree_the_belief_is_wrong(shares: list[float], expected: list[float]) -> None:
    assert relative_to_most(shares) == expected


@given(covariances(), covariances(), st.floats(-5, 5), st.floats(-5, 5))
def test_what_is_new_is_never_less_than_nothing_and_at_the_mean(
    before: Array, after: Array, x: float, y: float
) -> None:
    mean_m = np.array([x, y])
    new = new_at_mean(Information.of(np.zeros(2), before), Information.of(mean_m, after))
    scale = np.trace(inverse(before)) + np.trace(inverse(after))
    assert np.linalg.eigvalsh(new.matrix)[0] >= -1e-9 * scale
    assert np.linalg.eigvalsh(new.matrix - inverse(after) + inverse(before))[0] >= -1e-9 * scale
    assert_allclose(new.vector, new.matrix @ mean_m, atol=1e-6 * scale)
