"""Running-sum consensus: mass is neither made nor lost, whatever the radio and the vehicles do."""

from collections import Counter
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from agents.cooperative.cmm.consensus import (
    AveragingConsensus,
    ConsensusConfig,
    RatioConsensus,
    Share,
    tracked_mean,
)
from vnet.errors import VnetError

Hears = Callable[[int, int, int], bool]
"""A rule of reception: (round, sender, receiver) to true or false."""


class Net:
    """Nodes that broadcast once a round to those who `hears` says; inputs (N, 2) may be changed in between."""

    def __init__(self, inputs: np.ndarray, hears: Hears, config: ConsensusConfig | None = None) -> None:
        self.inputs = inputs
        self.config = config
        self.hears = hears
        self.nodes: dict[int, RatioConsensus] = {i: self.fresh(i) for i in range(len(inputs))}
        self.said: dict[int, Share] = {}
        self.round = 0

    def fresh(self, node: int) -> RatioConsensus:
        return RatioConsensus(f"n{node:02d}", self.config)

    def run(self, rounds: int) -> None:
        for _ in range(rounds):
            said = {}
            for i, node in self.nodes.items():
                heard = {
                    f"n{j:02d}": one for j, one in self.said.items() if j != i and self.hears(self.round, j, i)
                }
                said[i] = node.round(self.inputs[i], heard)
            self.said = said
            self.round += 1

    def errors(self) -> np.ndarray:
        """Distance of each node's mean from the true mean of those who are there."""
        true = np.mean([self.inputs[i] for i in self.nodes], axis=0)
        means = [node.mean_m for node in self.nodes.values()]
        assert all(mean is not None for mean in means)
        return np.linalg.norm(np.array(means) - true, axis=1)

    def epochs(self) -> set[int]:
        return {node.epoch for node in self.nodes.values()}

    def total(self) -> np.ndarray:
        """All mass: held, and on its way to those who have not heard the last running sum."""
        total = sum((node.mass for node in self.nodes.values()), np.zeros(3))
        for i, node in self.nodes.items():
            share = self.said[i]
            for receiver in share.out_neighbours:
                seen = self.nodes[int(receiver[1:])]._seen.get(f"n{i:02d}", 0.0)
                total = total + np.array(share.running_sum) - seen
            assert node.epoch == share.epoch
        return total


def graph(count: int, seed: int, reach: float = 0.25) -> np.ndarray:
    """A connected random geometric graph on the unit square, (N, N)."""
    rng = np.random.default_rng(seed)
    while True:
        place = rng.uniform(size=(count, 2))
        linked = np.linalg.norm(place[:, None] - place[None], axis=2) <= reach
        np.fill_diagonal(linked, False)
        reached = np.linalg.matrix_power(linked.astype(float) + np.eye(count), count) > 0
        if reached.all():
            return linked


def lossy(linked: np.ndarray, loss: float, seed: int) -> Hears:
    rng = np.random.default_rng(seed)
    return lambda _, j, i: bool(linked[j, i] and rng.random() >= loss)


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_all_find_the_mean_and_no_mass_is_lost(loss: float) -> None:
    inputs = np.random.default_rng(1).normal(size=(30, 2))
    net = Net(inputs, lossy(graph(30, 2, 0.35), loss, 3))
    net.run(60)
    settled = net.epochs()
    assert len(settled) == 1, "one epoch for all"
    for _ in range(5):
        net.run(30)
        assert net.epochs() == settled, "loss alone starts no new epoch"
        assert net.total() == pytest.approx([*inputs.sum(axis=0), 30], abs=1e-9)
    spread = np.linalg.norm(inputs - inputs.mean(axis=0), axis=1).max()
    assert net.errors().max() < 1e-3 * spread


@pytest.mark.slow
def test_under_a_peer_cap_only_those_who_hear_take_a_share() -> None:
    """A receiver-side cap makes hearing one-way: a sender that split over all in range would lose mass."""
    rng = np.random.default_rng(5)
    place = rng.uniform(size=(60, 2))
    distance = np.linalg.norm(place[:, None] - place[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    rank = np.argsort(np.argsort(distance, axis=0), axis=0)
    hears = rank < 30  # hears[j, i]: j is among the 30 nearest of i
    assert (hears != hears.T).sum() > 100, "the cap binds and is not symmetric"
    inputs = rng.normal(size=(60, 2))
    net = Net(inputs, lossy(hears, 0.1, 6))
    net.run(200)
    assert net.total() == pytest.approx([*inputs.sum(axis=0), 60], abs=1e-9)
    assert net.errors().max() < 1e-3


@pytest.mark.slow
def test_after_a_death_the_survivors_agree_on_their_own_mean() -> None:
    inputs = np.random.default_rng(1).normal(size=(20, 2)) * 10
    net = Net(inputs, lossy(graph(20, 4, 0.45), 0.1, 3))
    net.run(150)
    before = net.epochs()
    for dead in (3, 7, 11):
        del net.nodes[dead], net.said[dead]
    net.run(10)
    old_mean = np.mean(inputs, axis=0)
    for node in net.nodes.values():
        assert node.mean_m == pytest.approx(old_mean, abs=0.1), "the old mean serves meanwhile"
    net.run(250)
    assert net.epochs() != before
    assert net.errors().max() < 0.01
    survivors = [inputs[i] for i in net.nodes]
    assert net.total() == pytest.approx([*np.sum(survivors, axis=0), 17], abs=1e-9)


@pytest.mark.slow
def test_a_restarted_node_brings_its_mass_only_once() -> None:
    inputs = np.random.default_rng(2).normal(size=(15, 2))
    net = Net(inputs, lossy(graph(15, 6, 0.5), 0.1, 3))
    net.run(100)
    net.nodes[4] = net.fresh(4)
    net.run(250)
    assert net.total() == pytest.approx([*inputs.sum(axis=0), 15], abs=1e-9)
    assert net.errors().max() < 0.01


@pytest.mark.slow
def test_a_link_that_turns_one_way_carries_no_share_any_more() -> None:
    linked = graph(15, 6, 0.5)
    one_way = linked.copy()
    first, second = np.argwhere(linked)[0]
    one_way[first, second] = False
    inputs = np.random.default_rng(2).normal(size=(15, 2))
    net = Net(inputs, lambda r, j, i: bool(linked[j, i] if r < 100 else one_way[j, i]))
    net.run(350)
    assert f"n{second:02d}" not in net.said[int(first)].out_neighbours
    assert net.total() == pytest.approx([*inputs.sum(axis=0), 15], abs=1e-9)
    assert net.errors().max() < 1e-3


@pytest.mark.slow
def test_it_tracks_inputs_that_move() -> None:
    inputs = np.random.default_rng(2).normal(size=(15, 2))
    net = Net(inputs, lossy(graph(15, 6, 0.5), 0.1, 3))
    net.run(120)
    pace = 0.01
    for step in range(100):
        net.inputs = inputs + pace * step
        net.run(1)
    assert net.errors().max() < 10 * pace * np.sqrt(2), "less than ten rounds behind"
    net.run(100)
    assert net.errors().max() < 1e-3


def test_two_components_have_two_means() -> None:
    inputs = np.arange(20.0).reshape(10, 2)
    net = Net(inputs, lambda _, j, i: (j < 5) == (i < 5))
    net.run(100)
    for i, node in net.nodes.items():
        assert node.mean_m == pytest.approx(inputs[:5].mean(axis=0) if i < 5 else inputs[5:].mean(axis=0), abs=1e-6)


def test_before_anything_has_settled_there_is_no_mean() -> None:
    net = Net(np.zeros((3, 2)), lambda *_: True)
    net.run(3)
    assert all(node.mean_m is None for node in net.nodes.values())


def test_without_loss_it_is_the_linear_iteration() -> None:
    """MODEL 8: x(t+1) = A x(t), A_ij = 1/(d_j + 1); the error falls by the second-largest |eigenvalue| a round."""
    linked = graph(20, 4, 0.45)
    inputs = np.random.default_rng(1).normal(size=(20, 2))
    net = Net(inputs, lambda _, j, i: bool(linked[j, i]))
    net.run(60)
    epochs = net.epochs()
    kept = np.array([net.nodes[i].mass for i in range(20)])  # what a node keeps is what each of its peers gets
    net.run(1)
    assert net.epochs() == epochs
    arrived = kept + linked.T @ kept
    expected = arrived / (linked.sum(axis=0) + 1)[:, None]
    assert np.array([net.nodes[i].mass for i in range(20)]) == pytest.approx(expected, abs=1e-12)

    iteration = (linked + np.eye(20)) / (linked.sum(axis=0) + 1)
    rates = np.sort(np.abs(np.linalg.eigvals(iteration)))[::-1]
    assert rates[0] == pytest.approx(1.0)
    first = net.errors().max()
    net.run(40)
    assert (net.errors().max() / first) ** (1 / 40) == pytest.approx(rates[1], rel=0.05)


@cache
def averaging(rule: str, loss: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """Inputs (N, 2), and states (N, 2) after each of 300 rounds of averaging in a network of twenty."""
    linked = graph(20, 4, 0.45)
    count = len(linked)
    inputs = np.random.default_rng(1).normal(size=(count, 2))
    hears = lossy(linked, loss, 3)
    nodes = [AveragingConsensus(f"n{i:02d}", rule) for i in range(count)]
    said: list[Share] = []
    states = []
    for step in range(300):
        heard = [{f"n{j:02d}": s for j, s in enumerate(said) if hears(step, j, i)} for i in range(count)]
        said = [node.round(inputs[i], heard[i]) for i, node in enumerate(nodes)]
        states.append(np.array([node.mean_m for node in nodes], dtype=float))
    return inputs, states


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["metropolis", "max-degree"])
def test_averaging_without_loss_keeps_the_mean_and_finds_it(rule: str) -> None:
    inputs, states = averaging(rule, 0.0)
    for state in states:
        assert state.mean(axis=0) == pytest.approx(inputs.mean(axis=0), abs=1e-12)
    assert states[-1] == pytest.approx(np.tile(inputs.mean(axis=0), (20, 1)), abs=1e-6)


@pytest.mark.slow
def test_metropolis_needs_fewer_rounds_than_max_degree() -> None:
    spread = {rule: averaging(rule, 0.0)[1][20].std(axis=0).max() for rule in ("metropolis", "max-degree")}
    assert spread["metropolis"] < spread["max-degree"]


@pytest.mark.slow
def test_metropolis_averaging_is_the_linear_iteration() -> None:
    linked = graph(20, 4, 0.45)
    _, states = averaging("metropolis", 0.0)
    degree = linked.sum(axis=0) + 1
    matrix = np.where(linked, 1 / np.maximum(degree[:, None], degree), 0.0)
    matrix += np.diag(1 - matrix.sum(axis=1))
    assert states[51] == pytest.approx(matrix @ states[50], abs=1e-12)


@pytest.mark.slow
def test_loss_moves_the_mean_of_averaging_which_is_why_running_sums_are_the_default() -> None:
    inputs, states = averaging("metropolis", 0.3)
    assert states[-1].std(axis=0).max() < 1e-3, "they agree"
    assert np.linalg.norm(states[-1].mean(axis=0) - inputs.mean(axis=0)) > 1e-3, "but not on the mean"


def test_averaging_refuses_another_rule() -> None:
    with pytest.raises(VnetError, match="averaging rule 'exact': allowed: metropolis, max-degree"):
        AveragingConsensus("a", "exact")


Lie = Callable[[int, Share], Share]


def deceived(count: int, lie: Lie, hears: Hears = lambda *_: True) -> tuple[Net, list[Counter[str]]]:
    """A net of `count` after 400 rounds in which what node 0 says has been changed by `lie` of the round."""
    rejected = [Counter[str]() for _ in range(count)]
    inputs = np.random.default_rng(2).normal(size=(count, 2))
    net = Net(inputs, hears, ConsensusConfig(gate_m=15.0))
    net.nodes = {i: RatioConsensus(f"n{i:02d}", net.config, rejected[i]) for i in range(count)}
    for turn in range(400):
        net.run(1)
        net.said[0] = lie(turn, net.said[0])
    return net, rejected


def agreed_without_the_first(net: Net) -> None:
    expected = net.inputs[1:].mean(axis=0)
    for node in list(net.nodes.values())[1:]:
        assert node.mean_m == pytest.approx(expected, abs=1e-3)


@pytest.mark.slow
def test_false_sums_are_not_taken_and_who_says_them_is_left_out() -> None:
    def lie(turn: int, share: Share) -> Share:
        s_x, s_y, w = share.running_sum
        return share._replace(running_sum=(s_x + 50 * w, s_y, w))

    net, rejected = deceived(8, lie)
    agreed_without_the_first(net)
    assert all(
        set(counts) == {"implausible_mass", "banned"} and counts["implausible_mass"] <= 4 for counts in rejected[1:]
    )


def test_a_peer_that_starts_epoch_after_epoch_is_left_out_and_not_those_who_took_them_over() -> None:
    def lie(turn: int, share: Share) -> Share:
        return share._replace(epoch=share.epoch + 1) if turn > 50 else share

    net, rejected = deceived(6, lie, lambda _, j, i: abs(i - j) <= 2)
    agreed_without_the_first(net)
    assert all(set(counts) == {"banned"} for counts in rejected[1:3])
    assert max(net.epochs()) <= 20, "a burst, and then one in 100 rounds"


def test_an_average_is_not_drawn_to_a_state_beyond_the_gate() -> None:
    rejected = Counter[str]()
    node = AveragingConsensus("a", "metropolis", ConsensusConfig(gate_m=15.0), rejected)
    for _ in range(20):
        node.round(np.zeros(2), {"b": Share(0, (50.0, 0.0, 2.0), frozenset("a"), frozenset("a"))})
    assert node.mean_m == pytest.approx([0.0, 0.0])
    assert rejected == {"implausible_mass": 20}


@pytest.mark.parametrize("alive_rounds", [20, 80])
def test_who_gives_to_the_dead_keeps_the_mean_of_before(alive_rounds: int) -> None:
    """If they die before the first mean has settled, there is none until one has begun again without them."""
    nodes = {name: RatioConsensus(name) for name in "abc"}
    rng = np.random.default_rng(1)
    shares: dict[str, Share] = {}

    def all_round(living: str) -> None:
        nonlocal shares
        heard = {name: {peer: share for peer, share in shares.items() if peer != name} for name in living}
        inputs = {name: np.array([5.0, -3.0]) + 0.05 * rng.normal(size=2) for name in living}
        shares = {name: nodes[name].round(inputs[name], heard[name]) for name in living}

    for _ in range(alive_rounds):
        all_round("abc")
    for _ in range(200):  # b and c are gone; a finds out after 20 rounds, and begins anew by itself
        all_round("a")
        mean = nodes["a"].mean_m
        assert mean is None or np.linalg.norm(mean - (5.0, -3.0)) < 0.6, mean
    assert mean is not None


def test_a_moving_mean_is_mostly_what_neighbours_say_now() -> None:
    neighbours, consensus = (1.0, 2.0), np.array([2.0, 2.0])
    assert tracked_mean(neighbours, None).tolist() == [1.0, 2.0]
    assert tracked_mean(neighbours, consensus).tolist() == [1.2, 2.0]
    assert tracked_mean(neighbours, consensus, 0.5).tolist() == [1.1, 2.0]
