"""Mean consensus by running sums: the mean of everybody's x, from neighbours only (MODEL 4).

Each node holds mass (s, w), at first (x, 1); the ratio s/w tends to the mean x̄ of all. Every round it splits its
mass evenly between itself and the peers that hear it, and broadcasts the *running sum* of what it has given to each
peer. A peer takes what has been added since the last sum it saw, so that a later frame repairs an earlier loss
(Hadjicostis, Vaidya, Domínguez-García 2016, "Robust distributed average consensus via exchange of running sums").
The inputs change: a change of x is added to s, so that the ratio tracks the mean (dynamic average consensus).

Mass must be neither created nor lost. A sender splits only over peers whose recent frames list it as heard, and
names them: its *out-neighbours*; only they take a share. When that set changes (a peer dies, joins, restarts, no
longer hears), everybody starts again under a new epoch: the highest spreads, and the old mean serves until the new
one has settled.

`AveragingConsensus` is the ordinary averaging of neighbours' states, for comparison: lost frames move its mean.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Set
from dataclasses import dataclass
from operator import itemgetter
from typing import Literal, NamedTuple, Protocol, get_args

import numpy as np

from vnet.errors import VnetError
from vnet.types import Array


class Share(NamedTuple):
    """A node's broadcast of one round: its epoch, the running sum (s_x, s_y, w) given to each of `out_neighbours`.

    `heard` are the peers that it has received lately. Averaging needs no epoch (it is 0) and has
    (state x, state y, degree) in place of a sum.
    """

    epoch: int
    running_sum: tuple[float, float, float]
    out_neighbours: frozenset[str]
    heard: frozenset[str]


@dataclass(frozen=True)
class ConsensusConfig:
    """Constants of a consensus; a round is a period of the program."""

    silence_rounds: int = 20
    """Silence after which a peer is gone: at 20 % loss a chance of 10⁻¹⁴."""
    steady_rounds: int = 5
    """Age at which a changed set of out-neighbours starts a new epoch, so that single losses do not."""
    settle_rounds: int = 30
    """Age at which a new epoch's ratio is the mean; until then the old mean serves."""
    serve_rounds: int = 100
    """Age up to which an old mean serves, if epoch follows epoch."""
    gate_m: float = math.inf
    """Distance from the node's own input beyond which the ratio of a mass is implausible: it is not taken."""
    ban_penalty: int = 10
    """Penalty beyond which a peer is banned, and the penalty for implausible mass."""
    forgive_rounds: int = 100
    """Rounds in which a penalty of 1 is forgiven (a leaky bucket)."""
    max_penalty: int = 4
    """Largest penalty for a leap of epochs. To be the first with a new epoch costs 1, shared by all who are."""


MIN_MASS = 0.1
"""Weight added to that of a mass before its ratio is judged: tracking adds the change of the input to masses of any
size, and small ones need not have a sensible ratio."""
MAX_PENALIZED = 1024
"""Number of peers whose penalties are kept: names cost an attacker nothing."""
MIN_WEIGHT_SHARE = 0.6
"""Share of the usual weight below which a ratio is not the mean: most of the mass is elsewhere."""
USUAL_ROUNDS = 50
"""Rounds over which the usual weight is averaged."""
DOUBTFUL_ROUNDS = 6
"""Silence of an out-neighbour for which the ratio is not the mean: at 10 % loss a chance of 10⁻⁶."""


Triple = tuple[float, float, float]
"""Mass (s_x, s_y, w)."""
_NO_MASS = (0.0, 0.0, 0.0)


class Consensus(Protocol):
    """The interface of a consensus to a vehicle."""

    @property
    def mean_m(self) -> Array | None:
        """The mean (2,) as far as it is known."""
        ...

    def round(self, value: Array, shares: Mapping[str, Share]) -> Share:
        """One round with the input x (2,) and what peers said last, by peer; returns what to broadcast."""
        ...


class Peers:
    """The peers that a node has received lately, and whether each of them receives this node."""

    def __init__(self, node: str, silence_rounds: int) -> None:
        self._node = node
        self._silence_rounds = silence_rounds
        self._round = 0
        self._received: dict[str, int] = {}  # the round in which each was received last
        self._hears_us: dict[str, bool] = {}
        self._heard: frozenset[str] | None = None
        self._mutual: frozenset[str] | None = None

    @property
    def heard(self) -> frozenset[str]:
        """Peers received lately."""
        if self._heard is None:
            self._heard = frozenset(self._received)
        return self._heard

    @property
    def mutual(self) -> frozenset[str]:
        """Peers received lately that receive this node as well."""
        if self._mutual is None:
            self._mutual = frozenset(peer for peer, hears in self._hears_us.items() if hears)
        return self._mutual

    def longest_silence(self, peers: Set[str]) -> int:
        """Number of rounds since the most silent of `peers` was received."""
        received, now = self._received, self._round
        return now - min([received.get(peer, now) for peer in peers], default=now)

    def drop(self, peer: str) -> None:
        """Forget a peer at once."""
        self._received.pop(peer, None)
        self._hears_us.pop(peer, None)
        self._heard = self._mutual = None

    def listen(self, shares: Mapping[str, Share]) -> None:
        """Take note of one round's shares."""
        self._round += 1
        oldest = self._round - self._silence_rounds
        if min(self._received.values(), default=oldest) < oldest:
            for peer in [peer for peer, received in self._received.items() if received < oldest]:
                self.drop(peer)
        received, hears_us, node, now = self._received, self._hears_us, self._node, self._round
        for peer, (_, _, _, heard) in shares.items():
            received[peer] = now
            hears = node in heard
            if hears_us.get(peer) is not hears:
                hears_us[peer] = hears
                self._heard = self._mutual = None


class RatioConsensus:
    """The consensus state of one node. Epoch 0 means: not taking part yet."""

    def __init__(
        self, node: str, config: ConsensusConfig | None = None, rejected: Counter[str] | None = None
    ) -> None:
        """Begin outside of any epoch. `rejected` counts shares by reason: `implausible_mass`, `banned`."""
        self._node = node
        self._config = config or ConsensusConfig()
        self._gate_m = self._config.gate_m
        self._rejected = Counter() if rejected is None else rejected
        self._penalties: dict[str, tuple[float, int]] = {}  # penalty, and the epoch up to which it accounts
        self.epoch = 0
        self._highest = 0
        # Three numbers each, (s_x, s_y, w): for so few, plain ones take a fifth of the time of arrays.
        self._mass = (0.0, 0.0, 0.0)
        self._running_sum = (0.0, 0.0, 0.0)
        self._input: tuple[float, float] | None = None
        self._out_neighbours: frozenset[str] = frozenset()
        self._changed_rounds = 0
        self._age = 0
        self._seen: dict[str, tuple[float, float, float]] = {}
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
        return np.array(self._mass)

    def round(self, value: Array, shares: Mapping[str, Share]) -> Share:
        """One round with the input x (2,) and what peers said last, by peer; returns what to broadcast."""
        x, y = value.tolist()
        shares, added = self._believed(x, y, shares)
        self._peers.listen(shares)
        self._highest = max(self._highest, _newest_epoch(shares))
        if self._follow(x, y):  # nothing has been seen of the new epoch
            each = ((peer, share) for peer, share in shares.items() if share.epoch == self.epoch)
            added = {peer: share.running_sum for peer, share in each if self._node in share.out_neighbours}
        s_x, s_y, w = self._mass
        for peer in sorted(added):
            more_x, more_y, more_w = added[peer]
            s_x, s_y, w = s_x + more_x, s_y + more_y, w + more_w
            self._seen[peer] = shares[peer].running_sum
        self._mass = s_x, s_y, w
        self._split()
        self._divide()
        self._input = float(x), float(y)
        return Share(self.epoch, self._running_sum, self._out_neighbours, self._peers.heard)

    def _believed(
        self, x: float, y: float, shares: Mapping[str, Share]
    ) -> tuple[dict[str, Share], dict[str, Triple]]:
        """Return the shares without those of banned peers and of implausible mass: as if these were not received.

        Mass that such a peer has been given is lost until a new epoch starts without it; the ratio of what is left
        is the mean all the same. Mass is plausible if it may be of common errors near the input (x, y). The second
        value is what each has given this node since its last sum.
        """
        if self._penalties:
            leak = 1 / self._config.forgive_rounds
            self._penalties = {
                p: (penalty - leak, epoch) for p, (penalty, epoch) in self._penalties.items() if penalty > leak
            }
        self._penalize_new_epochs(shares)
        gate_m, penalties, present, node, seen = self._gate_m, self._penalties, self.epoch, self._node, self._seen
        believed: dict[str, Share] = {}
        added: dict[str, Triple] = {}
        for peer, share in shares.items():
            if penalties and self._penalty(peer) > self._config.ban_penalty:
                self._rejected["banned"] += 1
                continue
            epoch, (s_x, s_y, w), out_neighbours, _ = share
            if epoch == present and node in out_neighbours:
                seen_x, seen_y, seen_w = seen.get(peer, _NO_MASS)
                s_x, s_y, w = s_x - seen_x, s_y - seen_y, w - seen_w
                if w < 0 or not math.hypot(s_x - w * x, s_y - w * y) <= gate_m * (w + MIN_MASS):
                    self._rejected["implausible_mass"] += 1
                    self._penalize(peer, self._config.ban_penalty, epoch)
                    continue
                added[peer] = s_x, s_y, w
            believed[peer] = share
        return believed, added

    def _penalize_new_epochs(self, shares: Mapping[str, Share]) -> None:
        """Penalize the peers that are the first with a new epoch.

        They share the penalty: the peer that starts an epoch brings it alone, peers that hand it on do so together.
        """
        newest = _newest_epoch(shares)
        if newest > self._highest > 0:  # a node that joins finds the others further on, which is no fault of theirs
            first = [peer for peer, share in shares.items() if share.epoch == newest]
            for peer in first:
                if newest > self._penalties.get(peer, (0.0, 0))[1]:
                    self._penalize(peer, min(newest - self._highest, self._config.max_penalty) / len(first), newest)

    def _penalty(self, peer: str) -> float:
        return self._penalties[peer][0] if peer in self._penalties else 0.0

    def _penalize(self, peer: str, more: float, epoch: int) -> None:
        penalty = self._penalty(peer) + more
        if peer in self._penalties or len(self._penalties) < MAX_PENALIZED:
            self._penalties[peer] = penalty, epoch
        if penalty > self._config.ban_penalty:
            self._peers.drop(peer)

    def _follow(self, x: float, y: float) -> bool:
        """Start a new epoch where one is due, otherwise add the change of the input (x, y); tells which."""
        wanted = self._peers.mutual
        changed = wanted != self._out_neighbours or self.epoch == 0
        self._changed_rounds = self._changed_rounds + 1 if changed else 0
        if self._changed_rounds >= self._config.steady_rounds:
            self._start(self._highest + 1, x, y, wanted)
            return True
        if self.epoch and self._highest > self.epoch:
            self._start(self._highest, x, y, wanted)
            return True
        if self.epoch:
            assert self._input is not None
            s_x, s_y, w = self._mass
            self._mass = s_x + (x - self._input[0]), s_y + (y - self._input[1]), w
            self._age += 1
        return False

    def _start(self, epoch: int, x: float, y: float, out_neighbours: frozenset[str]) -> None:
        self.epoch = self._highest = epoch
        self._mass = float(x), float(y), 1.0
        self._usual_weight = 1.0
        self._running_sum = (0.0, 0.0, 0.0)
        self._out_neighbours = out_neighbours
        self._changed_rounds = 0
        self._age = 0
        self._seen = {}

    def _divide(self) -> None:
        """Take the ratio for the mean, if it can be trusted.

        A node that gives to peers that have died keeps next to nothing of its usual mass, and changes of its input
        are then too much for it; in the end for all nodes, whose mass goes there too.
        """
        self._mean_rounds += 1
        s_x, s_y, w = self._mass
        weight = w * (len(self._out_neighbours) + 1)  # before it was split
        self._usual_weight += (weight - self._usual_weight) / USUAL_ROUNDS
        settled = self.epoch and self._age >= self._config.settle_rounds
        if not settled or weight < MIN_WEIGHT_SHARE * self._usual_weight:
            return
        if self._peers.longest_silence(self._out_neighbours) < DOUBTFUL_ROUNDS:
            self._mean, self._mean_rounds = np.array([s_x / w, s_y / w]), 0

    def _split(self) -> None:
        if self.epoch:
            given, (x, y, w) = len(self._out_neighbours), self._mass
            x_given, y_given, w_given = x / (given + 1), y / (given + 1), w / (given + 1)
            r_x, r_y, r_w = self._running_sum
            self._running_sum = r_x + x_given, r_y + y_given, r_w + w_given
            self._mass = x - x_given * given, y - y_given * given, w - w_given * given


_epoch = itemgetter(0)


def _newest_epoch(shares: Mapping[str, Share]) -> int:
    return max(map(_epoch, shares.values()), default=0)


class DirectMean:
    """The mean of everybody's x, heard from everybody: for comparisons, where all hear all.

    `current`: shares are of the same instant as the input, and not of the round before.
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


AveragingRule = Literal["metropolis", "max-degree"]
AVERAGING_RULES: tuple[str, ...] = get_args(AveragingRule)


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
        """Begin with the first input. `rejected` counts implausible states as `implausible_mass`."""
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
            self._rejected["implausible_mass"] += len(shares) - len(believed)
        return believed


def _towards(state: Array, degree: float, other: tuple[float, float, float]) -> Array:
    """Step (2,) from a node's own state towards a peer's, by the larger of both degrees."""
    x, y, other_degree = other
    return np.asarray((np.array([x, y]) - state) / max(degree, other_degree, 1.0))


CONSENSUS_SHARE = 0.2
"""Weight of the consensus where inputs move: on N2 the error of the mean is then 0.072 m, of the neighbours' mean
0.070 m, of consensus alone 0.147 m, and the estimates themselves are 0.086 m from the mean."""


def tracked_mean(neighbours_mean_m: tuple[float, float], mean_m: Array | None, limit_m: float = math.inf) -> Array:
    """Return the network's mean (2,) from the neighbours' of this instant and what consensus says, if anything.

    Consensus takes dozens of rounds, in which the inputs move by more than they differ; what neighbours say is of
    this instant, but of few. What consensus says counts for at most `limit_m` from them: false sums would else
    choose the weights.
    """
    x, y = neighbours_mean_m
    if mean_m is not None:
        consensus_x, consensus_y = mean_m.tolist()
        off_x, off_y = consensus_x - x, consensus_y - y
        share = CONSENSUS_SHARE * min(1.0, limit_m / max(math.hypot(off_x, off_y), 1e-300))
        x, y = x + share * off_x, y + share * off_y
    return np.array([x, y])
