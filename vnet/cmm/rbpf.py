"""The Rao-Blackwellized particle filter of one vehicle (MODEL 2).

Particle k is a hypothesis c^k of the common GNSS error; given it, every tracked vehicle j has a Kalman filter on
[x, y, ẋ, ẏ]. Its covariance P_j, innovation covariance S and gain K do not depend on k, so that a vehicle has one
gain and all particles are one matrix product: means are kept as (M, 4, K) with the particles contiguous.

A fix may be old: a neighbour's has crossed the radio, another's has been passed on. So each vehicle's Kalman filter
stands at the time of its own latest fix, and particles remember the c of the last seconds: an old fix is held
against the c of its own time. Given a particle's trajectory that is exact; nothing is approximated but that the
trajectory was drawn without it.

The road is evidence about a vehicle's offset in its lane, which changes over many seconds. Counting it anew ten
times a second would make the filter far too sure of itself. So what counts of the log-likelihood L of being on the
road is its *change*, log w += L_t − (1 − ρ) L_{t−1}: the latest look replaces the one before, and a share
ρ = Δt/τ of it is new evidence. So looks may be rare: half the vehicles' roads are looked at in each step of 0.1 s.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vnet.cmm.map_matching import matcher
from vnet.errors import VnetError
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array


@dataclass(frozen=True)
class RbpfConfig:
    """Constants of the filter; lengths in metres, times in seconds.

    `common_sigma_m`, `common_tau_s`: the Gauss-Markov process of the common error; `common_walk_m` replaces it by a
    random walk that strays so far in a second (the paper's 0.5 m in 0.1 s are 0.5 / √0.1). `acceleration_m2_s4`:
    white acceleration along the lane, a hundredth of it across. `lateral_tau_s`: how long a vehicle keeps its
    offset in the lane (see the module's text). `gate_sigmas`: fixes further off are outliers. `forget_s`: vehicles
    not heard for that long are dropped. `memory_s`: how old a fix may be. `start_m`, `start_sigma_m`: where the
    cloud starts, else around 0 with `common_sigma_m`. The paper's: `one_sided` lanes are bounded on the right only;
    with `separate_map_update` a step does not look at roads, `update_from_map` does. `least_log_road`: no road says
    less of a vehicle, so that one whose fixes are false moves the cloud by no more (a truncated likelihood).

    On the map of a city: `off_road` is the share of vehicles on no road, and vehicles drive, with accelerations of
    `driving_m2_s4` along and across their heading, and `driving_m_s`, a deviation, when first seen. Their offset
    in the lane changes not with time, `lateral_tau_s`, but over `lateral_m` of road.
    """

    particles: int = 200
    common_sigma_m: float = 3.0
    common_tau_s: float = 600.0
    common_walk_m: float | None = None
    acceleration_m2_s4: float = 1.0
    lateral_tau_s: float = 20.0
    gate_sigmas: float = 5.0
    forget_s: float = 2.0
    memory_s: float = 1.5
    start_m: tuple[float, float] = (0.0, 0.0)
    start_sigma_m: float | None = None
    one_sided: bool = False
    separate_map_update: bool = False
    least_log_road: float = -np.inf
    off_road: float = 0.1
    driving_m2_s4: tuple[float, float] = (16.0, 4.0)
    driving_m_s: float = 15.0
    lateral_m: float = 500.0

    def __post_init__(self) -> None:
        if self.particles < 1:
            raise VnetError(f"particles = {self.particles}: at least 1 is needed")


@dataclass(frozen=True)
class Observation:
    """A fix of one vehicle: `position_m` (2,) as the receiver says it, noise covariance, heading if known, age."""

    position_m: Array
    covariance_m2: Array
    heading_rad: float | None
    age_s: float = 0.0


class Rbpf:
    """The filter's state: hypotheses `common_m` (2, K), `log_weight` (K,), and the tracked vehicles."""

    def __init__(self, config: RbpfConfig, lanes: LaneMap | RoadMap, rng: np.random.Generator) -> None:
        self.config = config
        self._roads = matcher(lanes, config.one_sided, config.least_log_road, config.off_road)
        self._rng = rng
        straight_m2_s4 = config.acceleration_m2_s4, 0.01 * config.acceleration_m2_s4
        self._white_m2_s4 = config.driving_m2_s4 if self._roads.drives else straight_m2_s4
        self._starting_s = START_S if config.start_sigma_m is None else 0.0
        count = config.particles * (START_FACTOR if self._starting_s else 1)
        sigma_m = config.common_sigma_m if config.start_sigma_m is None else config.start_sigma_m
        self.common_m = np.array(config.start_m)[:, None] + sigma_m * rng.standard_normal((2, count))
        self.log_weight = np.zeros(count)
        self.vehicles: list[str] = []
        self.mean = np.empty((0, 4, count))
        self.covariance = np.empty((0, 4, 4))
        self._acceleration = np.empty((0, 4, 4))  # white acceleration of each vehicle, in all four blocks
        self._age_s = np.empty(0)  # how far each vehicle's filter is behind
        self._unseen_s = np.empty(0)
        self._since_map_update_s = np.empty(0)  # since a road was looked at for its sake; inf for never
        self._heading_rad = np.empty(0)  # as each vehicle's latest fix that bore one says; else NaN
        self._anchor_m = np.empty((0, 2))  # where its lateral offset was new evidence the last time, and on a lane
        self._anchor_rad = np.empty(0)  # of which heading
        self._lane_vehicle = np.empty(0, dtype=np.intp)  # one entry a (vehicle, candidate lane)
        self._lane = np.empty(0, dtype=np.intp)
        self._log_road = np.zeros((0, count))  # L at each vehicle's latest fix
        self._past_age_s = np.zeros(1)
        self._past_m = self.common_m[None].copy()  # c of the last seconds, in any order

    # One period.

    def step(self, dt_s: float, observations: Mapping[str, Observation]) -> None:
        """Advance by `dt_s` and take at most one fix of each vehicle.

        Fixes that are not newer than the vehicle's latest, or older than `memory_s`, are left out.
        """
        self._predict(dt_s)
        oldest_s = float(self._past_age_s.max()) + SAME_TIME_S
        seen = {}
        for row, (name, age_s) in enumerate(zip(self.vehicles, self._age_s.tolist(), strict=True)):
            observation = observations.get(name)
            if observation and observation.age_s < age_s - SAME_TIME_S and observation.age_s <= oldest_s:
                seen[row] = observation
        self._update(seen)
        for name in sorted(observations.keys() - set(self.vehicles)):
            if observations[name].age_s <= oldest_s:
                seen[len(self.vehicles)] = observations[name]
                self._add(name, observations[name])
        rows = np.array(list(seen), dtype=np.intp)
        if not self.config.separate_map_update:
            self._match_map(rows)
        self._forget()
        self._resample_if_due(dt_s)

    def _resample_if_due(self, dt_s: float) -> None:
        count = self.config.particles
        if self._starting_s > 0:
            self._starting_s -= dt_s
            count *= START_FACTOR if self._starting_s > 0 else 1
        if len(self.log_weight) != count or self.effective_sample_size < count / 2:
            self._resample_to(count)

    def _predict(self, dt_s: float) -> None:
        config = self.config
        if config.common_walk_m is None:
            keep = np.exp(-dt_s / config.common_tau_s)
            spread_m = config.common_sigma_m * np.sqrt(1 - keep**2)
            self.common_m *= keep
        else:
            spread_m = config.common_walk_m * np.sqrt(dt_s)
        self.common_m += spread_m * self._rng.standard_normal(self.common_m.shape)
        self._age_s += dt_s
        self._unseen_s += dt_s
        self._since_map_update_s += dt_s
        self._remember(dt_s)

    def _remember(self, dt_s: float) -> None:
        """Add the particles' c of now to those of the last seconds."""
        self._past_age_s += dt_s
        old = self._past_age_s > self.config.memory_s
        if np.count_nonzero(old) == 1:  # as a rule: the new takes its place, and nothing is copied
            row = int(old.argmax())
            self._past_age_s[row], self._past_m[row] = 0.0, self.common_m
            return
        self._past_age_s = np.concatenate([[0.0], self._past_age_s[~old]])
        self._past_m = np.concatenate([self.common_m[None], self._past_m[~old]])

    def _update(self, seen: Mapping[int, Observation]) -> None:
        """Move the vehicles that are seen, by row, to the time of their fix and take it.

        With S⁻¹ = WᵀW for the innovation covariance S, everything that is asked of innovations is asked of Wν: its
        square is the distance, and the gain is P Hᵀ Wᵀ.
        """
        if not seen:
            return
        rows, fixes = np.array(list(seen), dtype=np.intp), seen.values()
        age_s = np.array([fix.age_s for fix in fixes])
        elapsed_s = self._age_s[rows] - age_s
        moving = _moving(elapsed_s)
        covariance = _moved(self.covariance[rows], moving, self._acceleration[rows], elapsed_s)
        whitening = _whitening(covariance[:, :2, :2] + np.array([fix.covariance_m2 for fix in fixes]))
        gain = covariance[:, :, :2] @ whitening.transpose(0, 2, 1)
        whole = len(rows) == len(self.vehicles)
        mean = self.mean if whole else self.mean[rows]
        # −Wν = W (H m + c − z), as products of small matrices: numpy's fastest way over particles.
        off = (whitening @ moving[:, :2]) @ mean
        off += whitening @ self._common_at(age_s)
        off -= whitening @ np.array([fix.position_m for fix in fixes])[:, :, None]
        kept = self._inside_gate(off)
        if not kept.all():
            gain[~kept] = 0
            off[~kept] = 0
        mean = moving @ mean
        mean -= gain @ off
        covariance -= gain @ gain.transpose(0, 2, 1)
        off = off.reshape(-1, off.shape[2])
        self.log_weight -= 0.5 * np.einsum("ik,ik->k", off, off)
        if self._roads.drives:
            self._turn(rows, fixes)
        if whole:
            self.mean = mean
        else:
            self.mean[rows] = mean
        self.covariance[rows] = 0.5 * (covariance + covariance.transpose(0, 2, 1))
        self._age_s[rows] = age_s
        self._unseen_s[rows[kept]] = age_s[kept]

    def _turn(self, rows: NDArray[np.intp], fixes: Iterable[Observation]) -> None:
        """Vehicles that drive accelerate along the heading of their latest fix."""
        for row, fix in zip(rows.tolist(), fixes, strict=True):
            if fix.heading_rad is not None:
                self._heading_rad[row] = fix.heading_rad
                self._acceleration[row] = np.tile(_acceleration(fix.heading_rad, self._white_m2_s4), (2, 2))

    def _common_at(self, age_s: Array) -> Array:
        """The particles' c of so long ago: (2, K) if that is now for all, else (m, 2, K)."""
        if not age_s.any():
            return self.common_m
        return np.asarray(self._past_m[np.abs(self._past_age_s - age_s[:, None]).argmin(axis=1)])

    def _inside_gate(self, off: Array) -> NDArray[np.bool_]:
        """Per vehicle, not per particle: the gain must stay the same for all particles. `off` is −Wν, (m, 2, K)."""
        weight, gate = self.weight, self.config.gate_sigmas**2
        middle = off @ weight
        inside = np.asarray((middle * middle).sum(axis=1) <= gate)
        if inside.all():
            return inside
        # The particles' spread adds to the unit covariance of −Wν: that can only bring in a fix that is outside.
        far = np.flatnonzero(~inside)
        off, middle = off[far], middle[far, :, None]
        total = np.eye(2) + (off * weight) @ off.transpose(0, 2, 1) - middle @ middle.transpose(0, 2, 1)
        distance = middle.transpose(0, 2, 1) @ np.linalg.solve(total, middle)
        inside[far] = distance[:, 0, 0] <= gate
        return inside

    def _add(self, name: str, observation: Observation) -> None:
        """Track a vehicle from its first fix: m = z − c, at rest, with the fix's covariance."""
        count = len(self.log_weight)
        mean = np.zeros((1, 4, count))
        mean[0, :2] = observation.position_m[:, None] - self._common_at(np.array([observation.age_s]))
        covariance = np.zeros((1, 4, 4))
        covariance[0, :2, :2] = observation.covariance_m2
        speed_m_s = self.config.driving_m_s if self._roads.drives else REST_SPEED_M_S
        covariance[0, 2:, 2:] = np.eye(2) * speed_m_s**2
        expected_m = observation.position_m - self.estimate_m
        gate_m = 3 * float(np.sqrt(np.trace(self.estimate_covariance_m2) + np.trace(observation.covariance_m2)))
        heading = observation.heading_rad
        heading_rad = np.array([np.nan if heading is None else heading])
        lanes = np.empty(0, dtype=np.intp)  # of those who drive they are sought at each look
        if not self._roads.drives:
            _, lanes = self._roads.seek(expected_m[None], heading_rad, np.array([gate_m]))
        if heading is None and len(lanes):
            heading = float(self._roads.heading_rad[lanes[0]])
        row = len(self.vehicles)
        self.vehicles.append(name)
        self.mean = np.concatenate([self.mean, mean])
        self.covariance = np.concatenate([self.covariance, covariance])
        acceleration = _acceleration(heading, self._white_m2_s4)
        self._acceleration = np.concatenate([self._acceleration, np.tile(acceleration, (1, 2, 2))])
        self._age_s = np.append(self._age_s, observation.age_s)
        self._unseen_s = np.append(self._unseen_s, observation.age_s)
        self._since_map_update_s = np.append(self._since_map_update_s, np.inf)
        self._heading_rad = np.append(self._heading_rad, heading_rad)
        self._anchor_m = np.concatenate([self._anchor_m, [[np.nan, np.nan]]])
        self._anchor_rad = np.append(self._anchor_rad, np.nan)
        self._lane_vehicle = np.append(self._lane_vehicle, np.full(len(lanes), row))
        self._lane = np.append(self._lane, lanes)
        self._log_road = np.concatenate([self._log_road, np.zeros((1, count))])

    def _forget(self) -> None:
        gone = self._unseen_s > self.config.forget_s
        if not gone.any():
            return
        kept = np.flatnonzero(~gone)
        self.vehicles = [self.vehicles[row] for row in kept]
        self.mean, self.covariance = self.mean[kept], self.covariance[kept]
        self._acceleration = self._acceleration[kept]
        self._age_s, self._unseen_s = self._age_s[kept], self._unseen_s[kept]
        self._since_map_update_s, self._heading_rad = self._since_map_update_s[kept], self._heading_rad[kept]
        self._anchor_m, self._anchor_rad = self._anchor_m[kept], self._anchor_rad[kept]
        self._log_road = self._log_road[kept]
        new_row = np.cumsum(~gone) - 1
        still = ~gone[self._lane_vehicle]
        self._lane_vehicle, self._lane = new_row[self._lane_vehicle[still]], self._lane[still]

    def _match_map(self, rows: NDArray[np.intp]) -> None:
        """Weigh the particles by what the roads say of those vehicles in `rows` whose turn it is."""
        since_map_update_s = self._since_map_update_s[rows]
        due = since_map_update_s > LOOK_S - SAME_TIME_S
        rows, since_map_update_s = rows[due], since_map_update_s[due]
        stays = np.maximum(0.0, 1 - since_map_update_s / self.config.lateral_tau_s)
        if self._roads.drives and len(rows):
            rows, since_map_update_s, stays = self._find_lanes(rows, since_map_update_s)
        if not len(rows) or not len(self._lane):
            return
        log_road = self.log_road(self.mean, self.covariance, rows)
        self._since_map_update_s[rows] = LOOK_S / 2 * (np.isinf(since_map_update_s) & (rows % 2 == 1))
        self.log_weight += log_road.sum(axis=0) - stays @ self._log_road[rows]
        self._log_road[rows] = log_road

    def _find_lanes(
        self, rows: NDArray[np.intp], since_map_update_s: Array
    ) -> tuple[NDArray[np.intp], Array, Array]:
        """Seek anew the lanes on which vehicles that drive may be.

        Returns the rows that have any, their `since_map_update_s`, and how much of each one's evidence so far the
        new look replaces: all of it where the vehicle stands, because its offset is what it was; less the further
        it has driven; nothing once it has turned, because another offset across another road says something else.
        """
        place_m = self.mean[rows, :2]
        middle_m = place_m @ self.weight
        spread_m = place_m - middle_m[..., None]
        variance_m2 = ((spread_m * spread_m) @ self.weight).sum(axis=1) + self.covariance[rows, 0, 0]
        gate_m = np.minimum(3 * np.sqrt(variance_m2 + self.covariance[rows, 1, 1]) + LEAST_GATE_M, MOST_GATE_M)
        found, lane = self._roads.seek(middle_m, self._heading_rad[rows], gate_m)
        others = np.ones(len(self.vehicles), dtype=np.bool_)
        others[rows] = False
        kept = others[self._lane_vehicle]
        vehicle = np.concatenate([self._lane_vehicle[kept], rows[found]])
        order = np.argsort(vehicle, kind="stable")
        self._lane_vehicle = vehicle[order]
        self._lane = np.concatenate([self._lane[kept], lane])[order]

        first = np.flatnonzero(np.diff(found, prepend=-1))
        some = found[first]
        rows, middle_m = rows[some], middle_m[some]
        along_rad = self._roads.heading_rad[lane[first]]
        driven_m = np.hypot(*(middle_m - self._anchor_m[rows]).T)
        alike = np.cos(along_rad - self._anchor_rad[rows])
        alike = np.where(np.isnan(self._heading_rad[rows]), np.abs(alike), alike)  # on the same road, either way
        turned = ~(alike > np.cos(TURN_RAD))  # NaN, so true, where it is seen for the first time
        sure = ~(turned & (driven_m <= STAND_M))  # who stands has not turned: another lane seems nearer for once
        rows, some, middle_m, along_rad = rows[sure], some[sure], middle_m[sure], along_rad[sure]
        driven_m, turned = driven_m[sure], turned[sure]
        new = np.where(driven_m > STAND_M, driven_m / self.config.lateral_m, 0.0)
        new[turned] = 1.0
        anew = rows[new > 0]
        self._anchor_m[anew] = middle_m[new > 0]
        self._anchor_rad[rows[turned]] = along_rad[turned]
        return rows, since_map_update_s[some], np.maximum(0.0, 1 - new)

    def update_from_map(self) -> None:
        """Weigh the particles by the roads of all vehicles, and resample: the paper's order, after stacking."""
        if self._roads.drives and self.vehicles:
            self._find_lanes(np.arange(len(self.vehicles)), self._since_map_update_s)
        self._log_road = self.log_road(self.mean, self.covariance)
        self.log_weight = self.log_weight + self._log_road.sum(axis=0)
        self.resample()

    def log_road(self, mean: Array, covariance: Array, rows: NDArray[np.intp] | None = None) -> Array:
        """log P(vehicle on a road) as (M, K) for means (M, 4, K): the candidate lanes as a mixture.

        With `rows`, in ascending order, only of those vehicles, (len(rows), K). A vehicle without a lane scores 0.
        """
        if rows is None:
            rows = np.arange(len(self.vehicles))
        entry = self._lanes_of(rows)
        vehicle, lane = self._lane_vehicle[entry], self._lane[entry]
        row = np.searchsorted(rows, vehicle)
        return self._roads.log_road(mean[vehicle, :2], covariance[vehicle, :2, :2], row, lane, len(rows))

    def _lanes_of(self, rows: NDArray[np.intp]) -> NDArray[np.intp]:
        """Entries of `_lane` for the vehicles `rows`."""
        wanted = np.zeros(len(self.vehicles), dtype=np.bool_)
        wanted[rows] = True
        return np.flatnonzero(wanted[self._lane_vehicle])

    # What the filter believes.

    @property
    def log_weight(self) -> Array:
        """Log-weights (K,), up to a constant."""
        return self._log_weight

    @log_weight.setter
    def log_weight(self, log_weight: Array) -> None:
        self._log_weight = log_weight
        self._weight: Array | None = None

    @property
    def weight(self) -> Array:
        """Normalized weights (K,)."""
        if self._weight is None:
            self._log_weight = self._log_weight - self._log_weight.max()
            weight = np.exp(self._log_weight)
            self._weight = weight / weight.sum()
        return self._weight

    @property
    def effective_sample_size(self) -> float:
        """1 / Σ w²."""
        return float(1.0 / (self.weight @ self.weight))

    @property
    def estimate_m(self) -> Array:
        """x = Σ w c, (2,)."""
        return np.asarray(self.common_m @ self.weight)

    @property
    def estimate_covariance_m2(self) -> Array:
        """Weighted covariance of c, (2, 2)."""
        spread = self.common_m - self.estimate_m[:, None]
        return np.asarray((spread * self.weight) @ spread.T)

    def position_m(self, vehicle: str) -> tuple[Array, Array]:
        """Position (2,) of a tracked vehicle now and its covariance (2, 2), over c as well."""
        row = self.vehicles.index(vehicle)
        weight = self.weight
        position = self.mean[row, :2] + self._age_s[row] * self.mean[row, 2:]
        mean = position @ weight
        spread = position - mean[:, None]
        here = slice(row, row + 1)
        moving = _moving(self._age_s[here])
        covariance = _moved(self.covariance[here], moving, self._acceleration[here], self._age_s[here])
        return mean, covariance[0, :2, :2] + (spread * weight) @ spread.T

    def velocity_m_s(self, vehicle: str) -> Array:
        """Velocity (2,) of a tracked vehicle."""
        return np.asarray(self.mean[self.vehicles.index(vehicle), 2:] @ self.weight)

    # Resampling and fusion.

    def resample(self) -> None:
        """Systematic resampling (Kitagawa 1996) to equal weights."""
        self._resample_to(self.config.particles)

    def _resample_to(self, count: int) -> None:
        index = systematic(self.weight, count, self._rng)
        # np.take, and not [..., index], which would leave the particles scattered in memory
        self.common_m = self.common_m.take(index, axis=-1)
        self._past_m = self._past_m.take(index, axis=-1)
        self.mean = self.mean.take(index, axis=-1)
        self._log_road = self._log_road.take(index, axis=-1)
        self.log_weight = np.zeros(len(index))

    def shift(self, by_m: Array) -> None:
        """Move the cloud by (2,), and what goes with it along the regression on c. Nothing is resampled."""
        mean, past, log_road = self.regression_on_common_error()
        self.common_m = self.common_m + by_m[:, None]
        self.mean += (mean @ by_m)[..., None]
        self._past_m += (past @ by_m)[..., None]
        self._log_road += (log_road @ by_m)[..., None]

    def sample(self, count: int) -> Array:
        """`count` equally likely hypotheses of c as (count, 2), for others."""
        return np.asarray(self.common_m[:, systematic(self.weight, count, self._rng)].T)

    def condition_on(self, common_m: Array) -> tuple[Array, Array, Array]:
        """What this filter makes of hypotheses (n, 2): means (M, 4, n), past (L, 2, n), log P on road (M, n).

        Each hypothesis is paired with a particle of this filter, whose vehicles and past are moved along the
        regression on c: so that what c does not determine keeps its spread, and its correlations.
        """
        count = len(common_m)
        partner = self._rng.permutation(systematic(self.weight, count, self._rng))
        by_m = common_m.T - self.common_m[:, partner]
        mean_slope, past_slope, road_slope = self.regression_on_common_error()
        mean = self.mean.take(partner, axis=-1) + mean_slope @ by_m
        past = self._past_m.take(partner, axis=-1) + past_slope @ by_m
        log_road = self.log_road(mean, self.covariance)
        bare = np.bincount(self._lane_vehicle, minlength=len(self.vehicles)) == 0
        if bare.any():  # on no lane just now: what the last one said still counts
            log_road[bare] = self._log_road[bare][:, partner] + road_slope[bare] @ by_m
        return mean, past, log_road

    def regression_on_common_error(self) -> tuple[Array, Array, Array]:
        """Regression on c, Cov(·, c) Cov(c)⁻¹: of the means (M, 4, 2), of the past (L, 2, 2), of log_road (M, 2).

        Where the cloud has collapsed: −I for positions (a vehicle is where its fix says, less c), I, and 0.
        """
        covariance = self.estimate_covariance_m2
        eigenvalues = np.linalg.eigvalsh(covariance)
        if eigenvalues[0] < COLLAPSED_M2 or eigenvalues[0] < 1e-6 * eigenvalues[1]:
            mean = np.zeros((len(self.vehicles), 4, 2))
            mean[:, 0, 0] = mean[:, 1, 1] = -1.0
            return mean, np.tile(np.eye(2), (len(self._past_m), 1, 1)), np.zeros((len(self.vehicles), 2))
        project = ((self.common_m - self.estimate_m[:, None]) * self.weight).T @ np.linalg.inv(covariance)
        return self.mean @ project, self._past_m @ project, self._log_road @ project

    @property
    def own_log_road(self) -> Array:
        """log P on road of each tracked vehicle and particle (M, K), as counted in the weights."""
        return self._log_road

    def replace(
        self,
        own: NDArray[np.intp],
        common_m: Array,
        supplied: tuple[Array, Array, Array],
        log_weight: Array,
    ) -> None:
        """Go on with the particles `own` (indices, m of them) and hypotheses (n, 2) as `condition_on` made them.

        `log_weight` (m + n,) are their weights, own first; resampled to K.
        """
        count = self.config.particles
        weight = np.exp(log_weight - log_weight.max())
        index = systematic(weight / weight.sum(), count, self._rng)
        from_own = own[index[index < len(own)]]
        imported = index[index >= len(own)] - len(own)
        mean, past, log_road = supplied
        self._past_m = np.concatenate([self._past_m[:, :, from_own], past[:, :, imported]], axis=2)
        self.common_m = np.concatenate([self.common_m[:, from_own], common_m[imported].T], axis=1)
        self.mean = np.concatenate([self.mean[:, :, from_own], mean[:, :, imported]], axis=2)
        self._log_road = np.concatenate([self._log_road[:, from_own], log_road[:, imported]], axis=1)
        self.log_weight = np.zeros(count)


REST_SPEED_M_S = 0.5
"""Deviation of a vehicle's speed at its first fix."""
START_FACTOR, START_S = 10, 0.45
"""So many times the particles at first: few of those that the prior spreads over metres survive the first fixes."""
COLLAPSED_M2 = 1e-6
LOOK_S = 0.2
"""How often a road is looked at for a vehicle's sake; which step it is depends on the vehicle."""
TURN_RAD = 0.5
"""Who has turned by so much since its offset was new evidence drives on another road."""
STAND_M = 5.0
"""Who has not driven so far since then stands, for all that its fixes can tell."""
LEAST_GATE_M, MOST_GATE_M = 3.0, 25.0
"""Lanes are sought no nearer, and no further."""
SAME_TIME_S = 1e-7
"""Times closer than this are the same: they come from whole nanoseconds."""


def systematic(weight: Array, count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Indices of a systematic sample: one draw, `count` equidistant pointers into the cumulated weights."""
    pointers = (np.arange(count) + rng.random()) / count
    index = np.searchsorted(np.cumsum(weight), pointers)
    return np.asarray(np.minimum(index, len(weight) - 1))


def _acceleration(heading_rad: float | None, white_m2_s4: tuple[float, float]) -> Array:
    """White acceleration (2, 2), along the heading and across; without a heading the larger in all directions."""
    if heading_rad is None:
        return np.eye(2) * white_m2_s4[0]
    along = np.array([np.cos(heading_rad), np.sin(heading_rad)])
    across = np.array([-along[1], along[0]])
    return np.asarray(white_m2_s4[0] * np.outer(along, along) + white_m2_s4[1] * np.outer(across, across))


def _moving(elapsed_s: Array) -> Array:
    """Transitions (M, 4, 4) over `elapsed_s` (M,): constant velocity."""
    return np.asarray(np.eye(4) + elapsed_s[:, None, None] * np.eye(4, k=2))


def _moved(covariance: Array, moving: Array, acceleration: Array, elapsed_s: Array) -> Array:
    """Covariances (M, 4, 4) after `moving`, with white acceleration (M, 4, 4) for `elapsed_s`."""
    half = elapsed_s**2 / 2
    push = np.array([half, half, elapsed_s, elapsed_s]).T
    process = push[:, :, None] * push[:, None, :] * acceleration
    return np.asarray(moving @ covariance @ moving.transpose(0, 2, 1) + process)


def _whitening(covariance: Array) -> Array:
    """W with WᵀW = S⁻¹ for covariances S (M, 2, 2): the inverse of Cholesky's factor."""
    first = np.sqrt(covariance[:, 0, 0])
    slope = covariance[:, 1, 0] / covariance[:, 0, 0]
    second = np.sqrt(covariance[:, 1, 1] - slope * covariance[:, 1, 0])
    whitening = np.zeros(covariance.shape)
    whitening[:, 0, 0], whitening[:, 1, 0], whitening[:, 1, 1] = 1 / first, -slope / second, 1 / second
    return whitening
