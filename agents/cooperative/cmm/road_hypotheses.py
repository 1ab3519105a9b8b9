"""The Gaussian sum of one vehicle on the map of a city: one Gaussian for each lane that competes (MODEL 10).

Given the lanes that a vehicle has driven on, all is linear: its fix is z = p + c + n, and a lane with normal n says
n·p = offset + l, where the vehicle's own offset l from the lane of the map stays what it is for hundreds of metres.
So each hypothesis is a Gaussian over [c, p, v, l], the common error, position and velocity, and the offset:

- l ~ N(0, σ²) is new when the vehicle comes upon a lane or has turned into it;
- as it drives, l is renewed by and by: a Gauss-Markov process of the way, exp(−way / `lateral_m`);
- as long as it stands, l stays, and the map says nothing new.

That the vehicle is on no road is the last hypothesis: anywhere within 15 m of one. From it lanes are found again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.cmm.information import Information, inverse, transport
from agents.cooperative.cmm.map_matching import OFF_ROAD_WITHIN_M
from vnet.types import Array

OFFSET = 6
"""Coordinate of the offset in the lane, after c, p and v."""
BEND_M = 0.3
"""Deviation (m) of a vehicle from its own offset: lanes of a map have corners, which vehicles cut."""
OFF_ROAD = -1
"""Lane of the hypothesis that the vehicle is on no road."""
TURN_RAD = 0.5
"""Turn (rad) since the last full evidence beyond which a lane is another road, with another offset."""
SAME_LANE_M = 2.0
"""Change (m) of the offset between two looks at the map up to which a lane continues the one before."""
SWITCH_M = 100.0
"""Way (m) in which a vehicle may come from off the road onto a lane, or leave it."""
DECIDED = 1e-4
"""Probability below which a hypothesis is dropped."""


@dataclass(frozen=True)
class Candidates:
    """Lanes (n,) on which a vehicle may be now, with their segments' geometry.

    lane: numbers. normal: (n, 2). offset_m: n·p of the centre lines. heading_rad: directions. sigma_m: deviations
    of a vehicle's offset from the lane of the map.
    """

    lane: NDArray[np.intp]
    normal: Array
    offset_m: Array
    heading_rad: Array
    sigma_m: Array

    def __len__(self) -> int:
        return len(self.lane)


@dataclass(frozen=True)
class _Hypothesis:
    """One Gaussian over [c, p, v, l], and the lane on which the vehicle is."""

    log_weight: float
    mean: Array
    covariance: Array
    lane: int
    normal: Array
    offset_m: float
    anchor_rad: float


class RoadHypotheses:
    """Weighted Gaussians of one vehicle, lanes and no road.

    log_weight: (H,), normalized. mean: (H, 7) and covariance: (H, 7, 7) of [c, p, v, l]. lane: (H,), `OFF_ROAD` for
    none.
    """

    def __init__(self, mean: Array, covariance: Array, off_road: float, lateral_m: float) -> None:
        """Begin off the road with mean (7,) and covariance (7, 7)."""
        self.mean, self.covariance = mean[None].copy(), covariance[None].copy()
        self.log_weight = np.zeros(1)
        self.lane = np.array([OFF_ROAD], dtype=np.intp)
        self._lateral_m = lateral_m
        self._off_road = off_road
        # The line of each lane at the last look at the map, and its heading when it was evidence in full.
        self._normal, self._offset_m = np.zeros((1, 2)), np.zeros(1)
        self._anchor_rad = np.full(1, np.nan)
        self._had_lanes = False

    @property
    def weight(self) -> Array:
        """Probabilities (H,) of the hypotheses."""
        return np.asarray(np.exp(self.log_weight))

    def moments(self) -> tuple[Array, Array]:
        """Return mean (7,) and covariance (7, 7) over all hypotheses."""
        return mixture(self.weight, self.mean, self.covariance)

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw `count` values (count, 2) of c."""
        rows = rng.choice(len(self.mean), count, p=self.weight)
        roots = np.linalg.cholesky(self.covariance[:, :2, :2])
        return np.asarray(self.mean[rows, :2] + (roots[rows] @ rng.standard_normal((count, 2, 1)))[:, :, 0])

    def predict(self, move: Array, noise: Array) -> None:
        """Map each hypothesis by `move` (7, 7) and add noise of covariance (7, 7)."""
        self.mean = self.mean @ move.T
        self.covariance = move @ self.covariance @ move.T + noise

    def update(self, fix_m: Array, noise_m2: Array) -> None:
        """Take a fix (2,) with noise covariance (2, 2)."""
        cross = self.covariance[:, :, :2] + self.covariance[:, :, 2:4]
        seen = cross[:, :2] + cross[:, 2:4] + noise_m2
        root = np.linalg.inv(np.linalg.cholesky(seen))
        off = fix_m - self.mean[:, :2] - self.mean[:, 2:4]
        white = (root @ off[:, :, None])[:, :, 0]
        gain = cross @ root.transpose(0, 2, 1)
        self.mean = self.mean + (gain @ white[:, :, None])[:, :, 0]
        self.covariance = self.covariance - gain @ gain.transpose(0, 2, 1)
        if len(self.mean) > 1:
            self.log_weight = self.log_weight + np.log(root[:, 0, 0] * root[:, 1, 1]) - 0.5 * (white**2).sum(axis=1)
            self._normalize()

    def absorb(self, pooled: Information) -> None:
        """Replace what is known of c by `pooled`: a lane that fits better to it becomes more likely.

        A hypothesis is multiplied by what is new. Where more is taken from it than it had, it is moved.
        """
        mean, covariance = self.moments()
        x, p = mean[:2], covariance[:2, :2]
        before = Information.of(x, p)
        new_x, new_p = pooled.moments()
        matrix, vector = pooled.matrix - before.matrix, pooled.vector - before.vector
        if len(self.mean) == 1:
            self._condition(0, new_x, new_p)
            return
        for row in range(len(self.mean)):
            own = Information.of(self.mean[row, :2], self.covariance[row, :2, :2])
            after = Information.from_arrays(own.matrix + matrix, own.vector + vector)
            a, b, d = after.matrix[0, 0], after.matrix[0, 1], after.matrix[1, 1]
            least = np.linalg.eigvalsh(pooled.matrix)[0] * 0.5
            if a + d > 0 and (a - least) * (d - least) - b * b > 0 and a > least:
                to_m, to_m2 = after.moments()
                scale = math.log(np.linalg.det(own.matrix) / np.linalg.det(after.matrix))
                fit = after.vector @ to_m - own.vector @ self.mean[row, :2]
                self.log_weight[row] += 0.5 * (scale + fit)
            else:
                affine = transport(p, new_p)
                to_m = new_x + affine @ (self.mean[row, :2] - x)
                to_m2 = affine @ self.covariance[row, :2, :2] @ affine.T
            self._condition(row, to_m, to_m2)
        self._normalize()

    def _condition(self, row: int, mean_m: Array, covariance_m2: Array) -> None:
        """Give c of a hypothesis these moments, and move what goes with it along its regression on c."""
        covariance = self.covariance[row]
        slope = covariance[:, :2] @ inverse(covariance[:2, :2])
        self.mean[row] = self.mean[row] + slope @ (mean_m - self.mean[row, :2])
        self.covariance[row] = covariance + slope @ (covariance_m2 - covariance[:2, :2]) @ slope.T

    # Lanes.

    def look(self, lanes: Candidates, driven_m: float) -> None:
        """Look at the map: `lanes` are where the vehicle may be now, `driven_m` the way since the last look.

        A lane goes on as the candidate that lies in its line. One that does not go on is given up for all
        candidates, and so is no road where none was before; else a vehicle comes back to a road, or leaves it, now
        and then.
        """
        switched = 1 - math.exp(-driven_m / SWITCH_M)
        off, on = self._off_road, 1 - self._off_road
        born = []
        for row, lane in enumerate(self.lane.tolist()):
            goes_on = None if lane == OFF_ROAD else self._continuation(row, lanes)
            if not len(lanes):
                born.append(self._off_the_road(row, 1.0))
            elif goes_on is not None:
                born.append(self._on_lane(row, lanes, goes_on, driven_m, 1 - off * switched))
                born.append(self._off_the_road(row, off * switched))
            else:
                again = switched if lane == OFF_ROAD and self._had_lanes else 1.0
                probability = again * on / len(lanes)
                born += [self._on_lane(row, lanes, n, None, probability) for n in range(len(lanes))]
                born.append(self._off_the_road(row, 1 - again * on))
        self._had_lanes = len(lanes) > 0
        self._take(born)

    def _continuation(self, row: int, lanes: Candidates) -> int | None:
        """Return the candidate that goes on the lane of hypothesis `row`, or None."""
        if not len(lanes):
            return None
        turn = np.cos(lanes.heading_rad - self._anchor_rad[row])
        position_m = self.mean[row, 2:4]
        offset_m = self._normal[row] @ position_m - self._offset_m[row]
        apart_m = np.abs(lanes.normal @ position_m - lanes.offset_m - offset_m)
        apart_m[turn < math.cos(TURN_RAD)] = np.inf
        best = int(np.argmin(apart_m))
        return best if apart_m[best] <= SAME_LANE_M else None

    def _off_the_road(self, row: int, probability: float) -> _Hypothesis:
        """Return what becomes of hypothesis `row` if the vehicle is on no road now."""
        return _Hypothesis(
            self.log_weight[row] + math.log(probability),
            self.mean[row],
            self.covariance[row],
            OFF_ROAD,
            np.zeros(2),
            0.0,
            np.nan,
        )

    def _on_lane(
        self, row: int, lanes: Candidates, n: int, driven_m: float | None, probability: float
    ) -> _Hypothesis:
        """Return what becomes of hypothesis `row` on candidate `n`: after `driven_m` on it, or None to begin there.

        To begin there is as likely as that lane is, relative to a position anywhere within `OFF_ROAD_WITHIN_M`.
        """
        mean, covariance, sigma_m = self.mean[row].copy(), self.covariance[row].copy(), float(lanes.sigma_m[n])
        keep = 0.0 if driven_m is None else math.exp(-driven_m / self._lateral_m)
        mean[OFFSET] *= keep
        covariance[OFFSET] *= keep
        covariance[:, OFFSET] *= keep
        covariance[OFFSET, OFFSET] += sigma_m**2 * (1 - keep**2)
        normal = lanes.normal[n]
        off_m = float(lanes.offset_m[n] + mean[OFFSET] - normal @ mean[2:4])
        cross = covariance[:, 2:4] @ normal - covariance[:, OFFSET]
        total_m2 = float(normal @ cross[2:4] - cross[OFFSET]) + BEND_M**2
        squared = off_m**2 / total_m2
        if driven_m is None:
            log = -0.5 * (squared + math.log(2 * math.pi * total_m2)) + math.log(2 * OFF_ROAD_WITHIN_M)
        else:
            log = 0.5 * (1 - squared)
        return _Hypothesis(
            self.log_weight[row] + math.log(probability) + log,
            mean + cross * (off_m / total_m2),
            covariance - np.outer(cross, cross) / total_m2,
            int(lanes.lane[n]),
            normal,
            float(lanes.offset_m[n]),
            float(lanes.heading_rad[n] if driven_m is None else self._anchor_rad[row]),
        )

    def _take(self, born: Sequence[_Hypothesis]) -> None:
        """Go on with these hypotheses: one a lane, by its moments, and none that is out of question."""
        log = np.array([one.log_weight for one in born])
        weight = np.exp(log - log.max())
        weight /= weight.sum()
        by_lane: dict[int, list[int]] = {}
        for row, one in enumerate(born):
            by_lane.setdefault(one.lane, []).append(row)
        kept = []
        for rows in by_lane.values():
            total = weight[rows].sum()
            if total < DECIDED:
                continue
            part = weight[rows] / total
            best = born[rows[int(np.argmax(part))]]
            mean, covariance = mixture(
                part, np.array([born[row].mean for row in rows]), np.array([born[row].covariance for row in rows])
            )
            kept.append(replace(best, log_weight=math.log(total), mean=mean, covariance=covariance))
        self.log_weight = np.array([one.log_weight for one in kept])
        self.mean = np.array([one.mean for one in kept])
        self.covariance = np.array([one.covariance for one in kept])
        self.lane = np.array([one.lane for one in kept], dtype=np.intp)
        self._normal = np.array([one.normal for one in kept])
        self._offset_m = np.array([one.offset_m for one in kept])
        self._anchor_rad = np.array([one.anchor_rad for one in kept])
        self._normalize()

    def _normalize(self) -> None:
        self.log_weight = self.log_weight - self.log_weight.max()
        self.log_weight = self.log_weight - math.log(float(np.exp(self.log_weight).sum()))


def mixture(weight: Array, mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Return mean (n,) and covariance (n, n) of H Gaussians.

    They have weights (H,), means (H, n) and covariances (H, n, n).
    """
    if len(weight) == 1:
        return mean[0], covariance[0]
    middle = weight @ mean
    spread = mean - middle
    return middle, np.asarray(np.tensordot(weight, covariance, 1) + (spread.T * weight) @ spread)
