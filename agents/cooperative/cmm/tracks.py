"""Tracks: the vehicles that a filter follows, one row each, and the constant-velocity model of their motion.

What belongs to a vehicle alone is a record of `TRACK`; what belongs to a vehicle and a particle is an array with
the particles along its last axis. `Tracks` owns both, and the lanes that each vehicle may be on, so that rows are
added and dropped everywhere at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vnet.types import Array

Rows = NDArray[np.intp]

SAME_TIME_S = 1e-7
"""Times (s) closer than this are the same: they come from whole nanoseconds."""
TRACK = np.dtype(
    [
        ("covariance", "f8", (4, 4)),  # of [x, y, ẋ, ẏ], the same for all particles
        ("acceleration_m2_s4", "f8", (4, 4)),  # covariance of the acceleration, (2, 2) in each of the four blocks
        ("age_s", "f8"),  # how far the vehicle's Kalman filter is behind the present: the age of its latest fix
        ("unseen_s", "f8"),  # since its latest fix that was no outlier
        ("since_map_update_s", "f8"),  # since the map was last evaluated for this vehicle; infinite for never
        ("heading_rad", "f8"),  # of its latest fix with a heading; NaN without
        ("anchor_m", "f8", (2,)),  # where its offset in the lane was new evidence the last time; NaN for never
        ("anchor_rad", "f8"),  # heading of the lane on which that was; NaN for never
    ]
)


class Tracks:
    """The vehicles that a filter follows: M rows in the order in which they were first seen, K particles.

    names: ids of the vehicles, by row.
    table: (M,) records of `TRACK`.
    mean: (M, 4, K), the mean of [x, y, ẋ, ẏ] given each particle, at the time of the vehicle's latest fix.
    map_log_likelihood: (M, K), log P(vehicle on a road) as counted in the particles' weights.
    candidate_row, candidate_lane: (E,) each, the pairs of a vehicle and a lane that it may be on, by row.
    """

    def __init__(self, particles: int) -> None:
        self.names: list[str] = []
        self.table = np.empty(0, dtype=TRACK)
        self.mean = np.empty((0, 4, particles))
        self.map_log_likelihood = np.empty((0, particles))
        self.candidate_row: Rows = np.empty(0, dtype=np.intp)
        self.candidate_lane: Rows = np.empty(0, dtype=np.intp)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def covariance(self) -> Array:
        """Covariances (M, 4, 4) of [x, y, ẋ, ẏ], a view of the table."""
        return np.asarray(self.table["covariance"])

    @property
    def acceleration_m2_s4(self) -> Array:
        """Covariances of the acceleration, (2, 2) in each block of (M, 4, 4), a view of the table."""
        return np.asarray(self.table["acceleration_m2_s4"])

    @property
    def age_s(self) -> Array:
        """Ages (M,) of the vehicles' latest fixes, a view of the table."""
        return np.asarray(self.table["age_s"])

    def advance(self, dt_s: float) -> None:
        """Let `dt_s` pass: every time since something grows."""
        for clock in ("age_s", "unseen_s", "since_map_update_s"):
            elapsed_s = self.table[clock]
            elapsed_s += dt_s

    def add(
        self,
        name: str,
        *,
        mean: Array,
        covariance: Array,
        acceleration_m2_s4: Array,
        age_s: float,
        heading_rad: float | None,
        lanes: Sequence[int] | Rows,
    ) -> None:
        """Follow one more vehicle, in the last row: `mean` (4, K), `covariance` (4, 4), acceleration (2, 2).

        `lanes` are the lanes that it may be on. Nothing has been counted of the map for it yet.
        """
        record = np.zeros(1, dtype=TRACK)
        record["covariance"] = covariance
        record["acceleration_m2_s4"] = np.tile(acceleration_m2_s4, (2, 2))
        record["age_s"] = record["unseen_s"] = age_s
        record["since_map_update_s"] = np.inf
        record["heading_rad"] = np.nan if heading_rad is None else heading_rad
        record["anchor_m"] = record["anchor_rad"] = np.nan
        row = len(self.names)
        self.names.append(name)
        self.table = np.concatenate([self.table, record])
        self.mean = np.concatenate([self.mean, mean[None]])
        nothing = np.zeros((1, self.map_log_likelihood.shape[1]))
        self.map_log_likelihood = np.concatenate([self.map_log_likelihood, nothing])
        self.candidate_row = np.append(self.candidate_row, np.full(len(lanes), row))
        self.candidate_lane = np.append(self.candidate_lane, np.asarray(lanes, dtype=np.intp))

    def drop_unseen(self, after_s: float) -> None:
        """Forget the vehicles without a usable fix for longer than `after_s`; the others close ranks."""
        kept = self.table["unseen_s"] <= after_s
        if kept.all():
            return
        self.names = [name for name, keep in zip(self.names, kept.tolist(), strict=True) if keep]
        self.table, self.mean = self.table[kept], self.mean[kept]
        self.map_log_likelihood = self.map_log_likelihood[kept]
        remaining = kept[self.candidate_row]
        new_row = np.cumsum(kept) - 1
        self.candidate_row = new_row[self.candidate_row[remaining]]
        self.candidate_lane = self.candidate_lane[remaining]

    def take_particles(self, index: Rows) -> None:
        """Go on with the particles `index` (n,) of the present ones."""
        # np.take, and not [..., index], which would leave the particles scattered in memory
        self.mean = self.mean.take(index, axis=-1)
        self.map_log_likelihood = self.map_log_likelihood.take(index, axis=-1)

    # Lanes that the vehicles may be on.

    def candidates(self, rows: Rows) -> tuple[Rows, Rows]:
        """Rows and lanes (E,) of the pairs that concern the vehicles in `rows`, by row."""
        entry = np.flatnonzero(self._are(rows)[self.candidate_row])
        return self.candidate_row[entry], self.candidate_lane[entry]

    def set_candidates(self, rows: Rows, candidate_row: Rows, candidate_lane: Rows) -> None:
        """Replace the lanes of the vehicles in `rows` by the pairs (E,) of a row and a lane."""
        others = ~self._are(rows)[self.candidate_row]
        row = np.concatenate([self.candidate_row[others], candidate_row])
        order = np.argsort(row, kind="stable")
        self.candidate_row = row[order]
        self.candidate_lane = np.concatenate([self.candidate_lane[others], candidate_lane])[order]

    def without_candidate(self) -> NDArray[np.bool_]:
        """A mask (M,) of the vehicles that may be on no lane."""
        return np.asarray(np.bincount(self.candidate_row, minlength=len(self)) == 0)

    def _are(self, rows: Rows) -> NDArray[np.bool_]:
        """A mask (M,) of `rows`."""
        mask = np.zeros(len(self), dtype=np.bool_)
        mask[rows] = True
        return mask


# Motion at constant velocity.


def transition(elapsed_s: Array) -> Array:
    """Transitions (M, 4, 4) of [x, y, ẋ, ẏ] over `elapsed_s` (M,)."""
    return np.asarray(np.eye(4) + elapsed_s[:, None, None] * np.eye(4, k=2))


def predicted_covariance(
    covariance: Array, transitions: Array, acceleration_m2_s4: Array, elapsed_s: Array
) -> Array:
    """Covariances F P Fᵀ + Q (M, 4, 4) after `transitions` F, for white acceleration over `elapsed_s` (M,).

    Q is that of an acceleration which is constant within the interval: Bar-Shalom, Li and Kirubarajan 2001, §6.3.2.
    """
    half = elapsed_s**2 / 2
    gain = np.array([half, half, elapsed_s, elapsed_s]).T
    process = gain[:, :, None] * gain[:, None, :] * acceleration_m2_s4
    return np.asarray(transitions @ covariance @ transitions.transpose(0, 2, 1) + process)


def white_acceleration(heading_rad: float | None, along_across_m2_s4: tuple[float, float]) -> Array:
    """Covariance (2, 2) of the acceleration, from variances along and across the heading.

    Without a heading the variance along counts in all directions.
    """
    if heading_rad is None:
        return np.eye(2) * along_across_m2_s4[0]
    along = np.array([np.cos(heading_rad), np.sin(heading_rad)])
    across = np.array([-along[1], along[0]])
    first, second = along_across_m2_s4
    return np.asarray(first * np.outer(along, along) + second * np.outer(across, across))
