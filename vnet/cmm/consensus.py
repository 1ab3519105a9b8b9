"""Mean consensus by running sums: the mean of everybody's x, from neighbours only (MODEL 4).

Each node holds mass (s, w), at first (x, 1); the ratio s/w tends to the mean x̄ of all. Every round it splits its
mass evenly between itself and the peers that hear it, and broadcasts the *running sum* of what it has given to each
peer. A peer takes what has been added since the last sum it saw, so that a later frame repairs an earlier loss
(Hadjicostis, Vaidya, Domínguez-García 2016, "Robust distributed average consensus via exchange of running sums").
The inputs change: a change of x is added to s, so that the ratio tracks the mean (dynamic average consensus).

Mass must be neither created nor lost. A sender splits only over peers whose recent frames list it as heard, and
names them; only they take a share. When that set changes (a peer dies, joins, restarts, no longer hears), everybody
starts again under a new epoch: the highest spreads, and the old mean serves until the new one has settled.

`AveragingConsensus` is the ordinary averaging of neighbours' states, for comparison: lost frames move its mean.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Set
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from vnet.errors import VnetError
from vnet.types import Array


@dataclass(frozen=True)
class Share:
    """What a node says each round: its epoch, the running sum (s_x, s_y, w) given to each of `out_neighbours`.

    Averaging needs no epoch (it is 0) and says (state x, state y, degree) instead of a sum.
    """

    epoch: int
    running_sum: tuple[float, float, float]
    out_neighbours: frozenset[str]
    heard: frozenset[str]


@dataclass(frozen=True)
class ConsensusConfig:
    """Rounds, that is periods, of patience.

    `silence_rounds`: a peer not heard for so long is gone. `steady_rounds`: how long a changed set of takers must
    last before it starts a new epoch. `settle_rounds`: how long the old mean serves after a start; if epoch follows
    epoch, for `serve_rounds` at most.
    `gate_m`: mass whose ratio is further from the node's own input is not taken, and its sender not heard.
    `penalty`: a peer that has been blamed for more is not heard; it is forgiven one in `blame_rounds` (a leaky
    bucket). False sums count so much each, to be the first to bring a new epoch 1, a leap of epochs up to
    `max_penalty`.
    """

    silence_rounds: int = 20
    steady_rounds: int = 5
    settle_rounds: int = 30
    serve_rounds: int = 100
    gate_m: float = math.inf
    penalty: int = 10
    blame_rounds: int = 100
    max_penalty: int = 4


LEAST_MASS = 0.1
"""Tracking adds the change of the input to masses of any size: small ones need not have a sensible ratio."""


MOST_BLAMED = 1024
"""Names cost a liar nothing."""


class Consensus(Protocol):
    """What a vehicle needs of a consensus."""

    @property
    def mean_m(self) -> Array | None:
        """The mean (2,) as far as it is known."""
        ...

    def round(self, value: Array, shares: Mapping[str, Share]) -> Share:
        """One round with the input x (2,) and what peers said last, by peer; returns what to broadcast."""
        ...


class Peers:
    """Who is there, and who of them says that it hears this node."""

    def __init__(self, node: str, silence_rounds: int) -> None:
        self._node = node
        self._silence_rounds = silence_rounds
        self._silent: dict[str, int] = {}
        self._hears_us: dict[str, bool] = {}

    @property
    def heard(self) -> frozenset[str]:
        """Peers heard lately."""
        return frozenset(self._silent)

    @property
    def mutual(self) -> frozenset[str]:
        """Peers heard lately that hear this node as well."""
        return frozenset(peer for peer, hears in self._hears_us.items() if hears)

    def longest_silence(self, peers: Set[str]) -> int:
        """For how many rounds the most silent of `peers` has not been heard."""
        return max((self._silent.get(peer, 0) for peer in peers), default=0)

    def drop(self, peer: str) -> None:
        """Forget a peer at once."""
        self._silent.pop(peer, None)
        self._hears_us.pop(peer, None)

    def listen(self, shares: Mapping[str, Share]) -> None:
        """Take note of one round's shares."""
        for peer in list(self._silent):
            self._silent[peer] += 1
            if self._silent[peer] > self._silence_rounds:
                del self._silent[peer], self._hears_us[peer]
        for peer, share in shares.items():
            self._silent[peer] = 0
            self._hears_us[peer] = self._node in share.heard


LEAST_SHARE, USUAL_ROUNDS = 0.6, 50
"""A ratio of less than this share of the mass usual in so many rounds is not taken for the mean."""
DOUBTFUL_ROUNDS = 6
"""Nor is one while a peer that is given to has been silent for so long: at 10 % loss that is one chance in 10⁶."""


class RatioConsensus:
    """The consensus state of one node. Epoch 0 means: not taking part yet."""

    def __init__(
        self, node: str, config: ConsensusConfig | None = None, rejected: Counter[str] | None = None
    ) -> None:
        """`rejected` counts shares that are not believed, by reason: `sums`, `banned`."""
        self._node = node
        self._config = config or ConsensusConfig()
        self._rejected = Counter() if rejected is None else rejected
        self._blamed: dict[str, tuple[float, int]] = {}  # and up to which epoch
        self.epoch = 0
        self._highest = 0
        self._mass = np.zeros(3)
        self._running_sum = np.zeros(3)
        self._input: Array | None = None
        self._takers: frozenset[str] = frozenset()
        self._changed_rounds = 0
        self._age = 0
        self._seen: dict[str, Array] = {}
        self._peers = Peers(node, self._config.silence_rounds)
        self._mean: Array | None = None
        self._mean_rounds = 0  # since it was the ratio
        self._usual_weight = 1.0

    @property
    def mean_m(self) -> Array | None:
        """The mean (2,) as far as it is known; None before the first has settled."""
        return self._mean if self._mean_rounds <= self._config.serve_rounds else None

    @property
    def mass(self) -> Array:
        """(s_x, s_y, w), for tests of conservation."""
        return self._mass

    def round(self, value: Array, shares: Mapping[str, Share]) -> Share:
        """One round with the input x (2,) and what peers said last, by peer; returns what to broadcast."""
        shares = self._believed(value, shares)
        self._peers.listen(shares)
        self._highest = max([self._highest, *(share.epoch for share in shares.values())])
        self._follow(value)
        for peer in sorted(shares):
            self._take(peer, shares[peer])
        self._split()
        self._divide()
        self._input = np.array(value, dtype=float)
        s_x, s_y, w = self._running_sum.tolist()
        return Share(self.epoch, (s_x, s_y, w), self._takers, self._peers.heard)

    def _believed(self, value: Array, shares: Mapping[str, Share]) -> dict[str, Share]:
        """Without the shares of those who bring false sums, or epoch after epoch: as if these were not heard.

        What they have been given is given to them in vain, until a new epoch starts without them; the ratio of what
        is left is the mean all the same.
        """
        leak = 1 / self._config.blame_rounds
        self._blamed = {
            p: (penalty - leak, epoch) for p, (penalty, epoch) in self._blamed.items() if penalty > leak
        }
        self._blame_for_epochs(shares)
        x, y = value.tolist()
        believed = {}
        for peer, share in shares.items():
            if self._blame_of(peer) > self._config.penalty:
                self._rejected["exile"] += 1
            elif not self._is_plausible(peer, share, x, y):
                self._rejected["sums"] += 1
                self._blame(peer, self._config.penalty, share.epoch)
            else:
                believed[peer] = share
        return believed

    def _blame_for_epochs(self, shares: Mapping[str, Share]) -> None:
        """Blame those who are the first with a new epoch.

        They share the blame: who starts it brings it alone, and who hands it on does so together with others.
        """
        newest = max((share.epoch for share in shares.values()), default=0)
        if newest > self._highest > 0:  # who joins finds the others further on, for which they are not to blame
            first = [peer for peer, share in shares.items() if share.epoch == newest]
            for peer in first:
                if newest > self._blamed.get(peer, (0.0, 0))[1]:
                    self._blame(peer, min(newest - self._highest, self._config.max_penalty) / len(first), newest)

    def _blame_of(self, peer: str) -> float:
        return self._blamed[peer][0] if peer in self._blamed else 0.0

    def _blame(self, peer: str, more: float, epoch: int) -> None:
        penalty = self._blame_of(peer) + more
        if peer in self._blamed or len(self._blamed) < MOST_BLAMED:
            self._blamed[peer] = penalty, epoch
        if penalty > self._config.penalty:
            self._peers.drop(peer)

    def _is_plausible(self, peer: str, share: Share, x: float, y: float) -> bool:
        """Whether what the peer has added since its last sum could be mass of common errors near (x, y)."""
        if share.epoch != self.epoch or self._node not in share.out_neighbours:
            return True
        seen = self._seen.get(peer)
        s_x, s_y, w = share.running_sum if seen is None else (np.array(share.running_sum) - seen).tolist()
        return w >= 0 and math.hypot(s_x - w * x, s_y - w * y) <= self._config.gate_m * (w + LEAST_MASS)

    def _follow(self, value: Array) -> None:
        """Start a new epoch where one is due, otherwise add the change of the input."""
        wanted = self._peers.mutual
        changed = wanted != self._takers or self.epoch == 0
        self._changed_rounds = self._changed_rounds + 1 if changed else 0
        if self._changed_rounds >= self._config.steady_rounds:
            self._start(self._highest + 1, value, wanted)
        elif self.epoch and self._highest > self.epoch:
            self._start(self._highest, value, wanted)
        elif self.epoch:
            assert self._input is not None
            self._mass[:2] += value - self._input
            self._age += 1

    def _start(self, epoch: int, value: Array, out_neighbours: frozenset[str]) -> None:
        self.epoch = self._highest = epoch
        self._mass = np.array([value[0], value[1], 1.0])
        self._usual_weight = 1.0
        self._running_sum = np.zeros(3)
        self._takers = out_neighbours
        self._changed_rounds = 0
        self._age = 0
        self._seen = {}

    def _take(self, peer: str, share: Share) -> None:
        if share.epoch != self.epoch or self._node not in share.out_neighbours:
            return
        total = np.array(share.running_sum)
        self._mass += total - self._seen.get(peer, 0.0)
        self._seen[peer] = total

    def _divide(self) -> None:
        """Take the ratio for the mean, where it can be trusted.

        Whoever gives to peers that have died keeps next to nothing of what is usual, and changes of its input are
        then too much for it; in the end for all, whose mass goes there too.
        """
        self._mean_rounds += 1
        weight = float(self._mass[2]) * (len(self._takers) + 1)  # before it was split
        self._usual_weight += (weight - self._usual_weight) / USUAL_ROUNDS
        settled = self.epoch and self._age >= self._config.settle_rounds
        doubtful = self._peers.longest_silence(self._takers) >= DOUBTFUL_ROUNDS
        if settled and not doubtful and weight >= LEAST_SHARE * self._usual_weight:
            self._mean, self._mean_rounds = self._mass[:2] / self._mass[2], 0

    def _split(self) -> None:
        if self.epoch:
            share = self._mass / (len(self._takers) + 1)
            self._running_sum += share
            self._mass = self._mass - share * len(self._takers)


class DirectMean:
    """The mean of everybody's x, heard from everybody: for comparisons, where all hear all.

    `current`: what has been heard is of the same instant as the input, and not of the round before.
    """

    def __init__(self, current: bool = False) -> None:
        self._current = current
        self._said: Array | None = None
        self._mean: Array | None = None

    @property
    def mean_m(self) -> Array | None:
        """The mean (2,) of what all said last; None before the first round."""
        return self._mean

    def round(self, value: Array, shares: Mapping[str, Share]) -> Share:
        """Take what everybody said last, and say the input x (2,)."""
        said = [np.array(shares[peer].running_sum[:2]) for peer in sorted(shares) if shares[peer].running_sum[2]]
        own = value if self._said is None or self._current else self._said
        self._mean = np.mean([own, *said], axis=0)
        self._said = np.array(value, dtype=float)
        x, y = self._said.tolist()
        return Share(0, (x, y, 1.0), frozenset(), frozenset(shares))


AVERAGING_RULES = ("metropolis", "max-degree")


class AveragingConsensus:
    """x_i += Σ_j (x_j − x_i) / max(D_i, D_j) over the peers that hear each other (Xiao and Boyd 2004).

    Under `metropolis` D_i is the number of nodes that it hears, under `max-degree` the largest of the network as
    far as word of it has come; both count the node itself, as the paper does. Both ends of a link weigh it by what
    they last broadcast, so that without loss the mean stays what it is even while word spreads. Loss moves it.
    Raises VnetError for another rule.
    """

    def __init__(
        self,
        node: str,
        rule: str,
        config: ConsensusConfig | None = None,
        rejected: Counter[str] | None = None,
    ) -> None:
        """`rejected` counts states that are not believed as `sums`."""
        if rule not in AVERAGING_RULES:
            raise VnetError(f"averaging rule {rule!r}: allowed: {', '.join(AVERAGING_RULES)}")
        self._rule = rule
        self._config = config or ConsensusConfig()
        self._rejected = Counter() if rejected is None else rejected
        self._peers = Peers(node, self._config.silence_rounds)
        self._input: Array | None = None
        self._state: Array | None = None
        self._degree = 1.0

    @property
    def mean_m(self) -> Array | None:
        """The state (2,), on its way to the mean; None before the first round."""
        return self._state

    def round(self, value: Array, shares: Mapping[str, Share]) -> Share:
        """One round with the input x (2,) and what peers said last, by peer; returns what to broadcast."""
        shares = self._believed(value, shares)
        self._peers.listen(shares)
        mutual = self._peers.mutual
        said = {peer: shares[peer].running_sum for peer in sorted(shares) if peer in mutual}
        state = np.array(value, dtype=float)
        if self._state is not None and self._input is not None:
            pull = sum((_towards(self._state, self._degree, other) for other in said.values()), np.zeros(2))
            state = self._state + pull + (value - self._input)
        # All who are heard count, not only those known to hear this node: of whom that is known late, and a first
        # step with too small a degree is a leap that loss makes lopsided.
        own_degree = 1.0 + len(self._peers.heard)
        if self._rule == "max-degree":
            self._degree = max([self._degree, own_degree, *(degree for _, _, degree in said.values())])
        else:
            self._degree = own_degree
        self._state, self._input = state, np.array(value, dtype=float)
        x, y = state.tolist()
        return Share(0, (x, y, self._degree), mutual, self._peers.heard)

    def _believed(self, value: Array, shares: Mapping[str, Share]) -> dict[str, Share]:
        x, y = value.tolist()
        believed = {
            peer: share
            for peer, share in shares.items()
            if math.hypot(share.running_sum[0] - x, share.running_sum[1] - y) <= self._config.gate_m
        }
        if len(believed) < len(shares):
            self._rejected["sums"] += len(shares) - len(believed)
        return believed


def _towards(state: Array, degree: float, other: tuple[float, float, float]) -> Array:
    """What one peer's state and degree add to one's own."""
    x, y, other_degree = other
    return np.asarray((np.array([x, y]) - state) / max(degree, other_degree, 1.0))
