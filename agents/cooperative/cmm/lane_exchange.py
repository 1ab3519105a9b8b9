"""The exchange of a vehicle on straight lanes: its own increments, and those that it takes (`lane_memory`)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from agents.cooperative.cmm.information import NOTHING, Five, Information
from agents.cooperative.cmm.lane_memory import (
    MAX_AGE,
    CommonMemory,
    LaneFilter,
    Moments,
    information_of,
    is_of_lane,
    kind_of_increment,
    summed,
)
from agents.cooperative.cmm.own_kalman import OwnKalman
from agents.cooperative.cmm.own_vehicle import OwnVehicle
from agents.cooperative.cmm.plausibility import MEMORY_S
from agents.cooperative.cmm.rbpf import Observation

JOINING_PERIODS = 3
"""Periods in which a vehicle that has just begun waits for others, who tell when memories began."""
NOT_BEGUN: Five = (0.0, 0.0, -1.0, 0.0, -1.0)
"""The increment of a vehicle that waits: if nobody else has begun either, all begin with the next fix."""
UNDERSTATED = 0.5
"""Share by which averaged priors understate what is new: a vehicle adds the increments within two hops, and the
averages hold those of all. Without it the ANEES of c is 0.55 to 0.9 on N1, N2 and N3, the bound's 1.1 to 1.3."""
LEAST_NOISE_M2 = 0.64
"""Variance (m²) of fixes across the lane below which the movement of c between fixes shows in increments about c
(0.8 m). Where nobody has so precise a receiver increments are about c: they also hold what fixes say along the lane
(4 % of the error of c), and what the vehicle has learned of c from others. A receiver that states multipath is
always taken for a precise one."""
SMOOTHING = 0.05
"""Weight of the latest period in the share of increments that come from out of range."""


class LaneExchange:
    """The increments of the vehicle `own`, whose fixes come each `period_s`, and those that it takes.

    has_joined: true once memories have begun, which they do as soon as somebody has a precise receiver.
    """

    def __init__(self, own: OwnVehicle, period_s: float) -> None:
        self._own = own
        self._period_s = period_s
        self._model = own.model  # without multipath, of which no fix has told yet
        self._memory = CommonMemory(self._model, period_s)
        self.has_joined = False
        self._waits = False
        self._waited = 0
        self._lane: LaneFilter | None = None
        self._lane_of: OwnKalman | None = None
        self._beyond = 0.0
        self._begins = False
        self._since_older_s = math.inf

    # The own fix.

    def step(self, dt_s: float, fix: Observation | None) -> Five:
        """Advance by `dt_s` and take the own fix; returns its increment."""
        self._since_older_s += dt_s
        if self.has_joined:
            self._advance(max(1, round(dt_s / self._period_s)))
        increment = self._own.step(dt_s, fix)
        lane = self._own.lane
        if lane is None or not (self.has_joined or self._is_precise(lane, fix)):
            self._lane = self._lane_of = None
            return increment.numbers
        if not self.has_joined:
            self._waits = True
            return NOT_BEGUN
        if fix is None or not self._own.took_fix:
            self._miss()
            return NOTHING.numbers
        return self._filter_on(lane, fix).take(fix.position_m, self._memory.age)

    def _is_precise(self, lane: OwnKalman, fix: Observation | None) -> bool:
        if fix is None:
            return False
        return self._own.model is not self._model or lane.noise_across(fix.white_covariance_m2) < LEAST_NOISE_M2

    def _advance(self, periods: int) -> None:
        if self._begins:
            self._begins = False
            self._begin(0)
            return
        if periods > MAX_AGE:
            self._begin(MAX_AGE)
            return
        for period in range(periods):
            self._memory.predict()
            if self._lane:
                self._lane.predict()
                if period < periods - 1:
                    self._miss()

    def _miss(self) -> None:
        """Go on without a fix."""
        if self._lane:
            self._memory.follow(self._lane.kind, is_own=True)
            self._lane.miss(self._memory.news(self._lane.kind), self._memory.age)

    def _filter_on(self, lane: OwnKalman, fix: Observation) -> LaneFilter:
        """Return the filter on this lane, which begins if it is another lane, or another receiver."""
        kept, noise_m2, multipath = self._lane, fix.white_covariance_m2, self._multipath()
        if kept is None or lane is not self._lane_of or kept.differs(noise_m2) or kept.multipath != multipath:
            kept = LaneFilter((lane.point_m, lane.heading_rad), self._model, noise_m2, self._period_s, multipath)
            self._lane, self._lane_of = kept, lane
        self._memory.follow(kept.kind, is_own=True)
        kept.begin(self._memory.memory(kept.kind))
        return kept

    def _multipath(self) -> tuple[float, float]:
        """Variance and correlation time of the offset, relative to those without multipath."""
        own, lane = self._own.model, self._model
        return (own.lateral_sigma_m / lane.lateral_sigma_m) ** 2, own.lateral_tau_s / lane.lateral_tau_s

    # What others say.

    def _begin(self, age: int) -> None:
        """Begin again with memories of this age; what is known of c stays."""
        self._memory = CommonMemory(self._model, self._period_s, age)
        self.follow_own()
        self._lane = self._lane_of = None

    def join(self, increments: Sequence[Five]) -> None:
        """Begin again with the age of the oldest memories that are heard.

        A vehicle that has joined does so at most once in `MEMORY_S`: whoever claims an older memory in each period
        would stop the exchange.
        """
        ages = [round(increment[4]) for increment in increments if is_of_lane(increment)]
        oldest = max(ages, default=-1)
        if self.has_joined:
            if oldest > self._memory.age and self._since_older_s >= MEMORY_S:
                self._since_older_s = 0.0
                self._begins = False
                self._begin(min(oldest, MAX_AGE))
            return
        self._waited += self._waits
        if oldest >= 0:
            self.has_joined = True
            self._begin(min(oldest, MAX_AGE))
        elif ages or self._waited >= JOINING_PERIODS:
            self.has_joined = self._begins = True

    def restart(self) -> None:
        """Begin again after the vehicle's filter has."""
        self._begin(self._memory.age)

    def can_use(self, increment: Five, is_before: bool) -> bool:
        """Tell whether an increment, of the period before if so, can be used.

        It is about c, or says something, is of a memory of the same age, and its kind is followed.
        """
        kind = kind_of_increment(increment)
        return kind == 0 or (self._is_of_age(increment, is_before) and self._memory.follow(kind))

    def _is_of_age(self, increment: Five, is_before: bool) -> bool:
        """Tell whether an increment of a lane says something, of a memory of the same age."""
        age, own = round(increment[4]), self._memory.age
        return any(increment[:2]) and (age == own - is_before or age == own == MAX_AGE)

    def news(self, kind: int, is_before: bool) -> Moments:
        """Return the mean and the covariance of what increments of a kind are about."""
        return self._memory.news(kind, is_before)

    def follow_own(self) -> None:
        """Know of c what the vehicle's filter knows."""
        self._memory.absorb(Information.of(*self._own.belief))

    def absorb(
        self, pooled: Information, now: Iterable[Five], before: Sequence[Five], heard: int, weight: float
    ) -> None:
        """Replace what is known of c by `pooled`, and increments of lanes, of this period and of the one before.

        Those of this period came from `heard` vehicles; `weight` is the weight of other vehicles' priors.
        """
        before = [each for each in before if self._is_of_age(each, True)]
        beyond = min(1.0, len(before) / heard) if heard else 0.0
        self._beyond += SMOOTHING * (beyond - self._beyond)
        factor = 1 + UNDERSTATED * self._beyond * min(1.0, weight)
        belief = self._memory.fuse(pooled, self._sums(before, factor, True), self._sums(now, factor, False))
        self._own.absorb(belief, is_of_lanes=True)

    def _sums(self, increments: Iterable[Five], factor: float, is_before: bool) -> dict[int, Five]:
        """Return the sums by kind of those increments that can be used."""
        usable = [each for each in increments if self.can_use(each, is_before)]
        sums = summed((kind_of_increment(each), information_of(each)) for each in usable)
        return {
            kind: (factor * a, factor * b, factor * d, factor * x, factor * y)
            for kind, (a, b, d, x, y) in sums.items()
        }
