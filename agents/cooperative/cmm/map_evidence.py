"""Map evidence: how the particles are weighted by what the map says of each vehicle.

The map tells of a vehicle's offset in its lane, which changes over many seconds. Counted as independent evidence
ten times a second it would make the filter far too sure of itself. So what counts of the log-likelihood L of being
on the road is its *change*,

    log w += L_t − (1 − ρ) L_{t−1},

with ρ = Δt / τ the share of new evidence: the latest evaluation replaces the one before. For that reason
evaluations may be rare: in each step of 0.1 s the map is evaluated for half the vehicles.
"""

from __future__ import annotations

import numpy as np

from agents.cooperative.cmm.common_error import CommonErrorParticles
from agents.cooperative.cmm.map_matching import Matcher
from agents.cooperative.cmm.tracks import SAME_TIME_S, Rows, Tracks
from vnet.types import Array

MAP_UPDATE_S = 0.2
"""Time (s) between two evaluations of the map for a vehicle: every other step, by odd and even rows."""
TURN_RAD = 0.5
"""Turn (rad) since the last new evidence beyond which a vehicle drives on another road."""
STAND_M = 5.0
"""Way (m) since the last new evidence below which a vehicle stands, for all that its fixes can tell."""
MIN_GATE_M = 3.0
"""Margin (m) added to three deviations when lanes are sought: half a lane and an error of the map."""
MAX_GATE_M = 25.0
"""Distance (m) within which lanes are sought at most: beyond it another street is as near."""


class MapEvidence:
    """The update of the particles from the map.

    lateral_tau_s: time in which a vehicle's offset in a straight lane is renewed.
    lateral_m: direction in which it is, on the map of a city.
    """

    def __init__(self, matcher: Matcher, lateral_tau_s: float, lateral_m: float) -> None:
        self.matcher = matcher
        self._lateral_tau_s = lateral_tau_s
        self._lateral_m = lateral_m

    @property
    def drives(self) -> bool:
        """True if vehicles drive on this map, so that their lanes are sought at each update."""
        return self.matcher.drives

    def first_lanes(self, position_m: Array, heading_rad: float | None, gate_m: float) -> Rows:
        """Lanes for a new vehicle near (2,). None on the map of a city, where each update seeks them."""
        if self.drives:
            return np.empty(0, dtype=np.intp)
        heading = np.array([np.nan if heading_rad is None else heading_rad])
        _, lanes = self.matcher.seek(position_m[None], heading, np.array([gate_m]))
        return lanes

    def update(self, tracks: Tracks, particles: CommonErrorParticles, rows: Rows) -> None:
        """Weight the particles by the change of the map's log-likelihood, for those of `rows` that are due."""
        since_s = tracks.table["since_map_update_s"][rows]
        due = since_s > MAP_UPDATE_S - SAME_TIME_S
        rows, since_s = rows[due], since_s[due]
        replaced = np.maximum(0.0, 1 - since_s / self._lateral_tau_s)
        if self.drives and len(rows):
            rows, since_s, replaced = self._seek_lanes(tracks, particles, rows, since_s)
        if not len(rows) or not len(tracks.candidate_lane):
            return
        log_likelihood = self.log_likelihood(tracks, tracks.mean, rows)
        tracks.table["since_map_update_s"][rows] = MAP_UPDATE_S / 2 * (np.isinf(since_s) & (rows % 2 == 1))
        particles.log_weight += log_likelihood.sum(axis=0) - replaced @ tracks.map_log_likelihood[rows]
        tracks.map_log_likelihood[rows] = log_likelihood

    def update_in_full(self, tracks: Tracks, particles: CommonErrorParticles) -> None:
        """Weight the particles by the map's log-likelihood of all vehicles, as new evidence: the paper's update."""
        if self.drives and len(tracks):
            self._seek_lanes(tracks, particles, np.arange(len(tracks)), tracks.table["since_map_update_s"])
        tracks.map_log_likelihood = self.log_likelihood(tracks, tracks.mean)
        particles.log_weight = particles.log_weight + tracks.map_log_likelihood.sum(axis=0)

    def log_likelihood(self, tracks: Tracks, mean: Array, rows: Rows | None = None) -> Array:
        """Return log P(vehicle on a road), (M, K), for means (M, 4, K): the candidate lanes as a mixture.

        With `rows`, in ascending order, only of these vehicles, (len(rows), K). It is 0 for one without a lane.
        """
        if rows is None:
            rows = np.arange(len(tracks))
        vehicle, lane = tracks.candidates(rows)
        row = np.searchsorted(rows, vehicle)
        covariance_m2 = tracks.covariance[vehicle, :2, :2]
        return self.matcher.log_likelihood(mean[vehicle, :2], covariance_m2, row, lane, len(rows))

    def _seek_lanes(
        self, tracks: Tracks, particles: CommonErrorParticles, rows: Rows, since_s: Array
    ) -> tuple[Rows, Array, Array]:
        """Seek the lanes on which the vehicles `rows`, which drive, may be now.

        Returns the rows that have any, their `since_s`, and the share (m,) of their evidence so far that the new
        evaluation replaces.
        """
        middle_m, gate_m = _neighbourhood(tracks, particles.weight, rows)
        found, lane = self.matcher.seek(middle_m, tracks.table["heading_rad"][rows], gate_m)
        tracks.set_candidates(rows, rows[found], lane)
        first = np.flatnonzero(np.diff(found, prepend=-1))  # the nearest lane of each row that has any
        some = found[first]
        along_rad = self.matcher.heading_rad[lane[first]]
        kept, replaced = self._replaced(tracks, rows[some], middle_m[some], along_rad)
        return rows[some][kept], since_s[some][kept], replaced

    def _replaced(self, tracks: Tracks, rows: Rows, middle_m: Array, along_rad: Array) -> tuple[Array, Array]:
        """Find the share of the vehicles' evidence so far that an update from the map replaces.

        All of it where the vehicle stands, because its offset is what it was; less the further it has driven;
        nothing once it has turned, because another offset across another road says something else. `middle_m` (m,
        2) is where the vehicles are and `along_rad` (m,) the heading of their nearest lanes.

        Returns a mask of the rows to update, and for these the share, 0 to 1. Moves the anchors of those with new
        evidence.
        """
        table = tracks.table
        driven_m = np.hypot(*(middle_m - table["anchor_m"][rows]).T)
        alike = np.cos(along_rad - table["anchor_rad"][rows])
        alike = np.where(np.isnan(table["heading_rad"][rows]), np.abs(alike), alike)  # on the same road, either way
        turned = ~(alike > np.cos(TURN_RAD))  # NaN, so true, where it is seen for the first time
        sure = ~(turned & (driven_m <= STAND_M))  # one that stands has not turned: another lane seems nearer
        rows, middle_m, along_rad = rows[sure], middle_m[sure], along_rad[sure]
        driven_m, turned = driven_m[sure], turned[sure]
        new = np.where(driven_m > STAND_M, driven_m / self._lateral_m, 0.0)
        new[turned] = 1.0
        table["anchor_m"][rows[new > 0]] = middle_m[new > 0]
        table["anchor_rad"][rows[turned]] = along_rad[turned]
        return sure, np.maximum(0.0, 1 - new)


def _neighbourhood(tracks: Tracks, weight: Array, rows: Rows) -> tuple[Array, Array]:
    """Find expected positions (m, 2) of the vehicles `rows`, and distances (m,) within which to seek lanes."""
    position_m = tracks.mean[rows, :2]
    middle_m = position_m @ weight
    spread_m = position_m - middle_m[..., None]
    covariance = tracks.covariance[rows]
    variance_m2 = ((spread_m * spread_m) @ weight).sum(axis=1) + covariance[:, 0, 0]
    gate_m = 3 * np.sqrt(variance_m2 + covariance[:, 1, 1]) + MIN_GATE_M
    return middle_m, np.minimum(gate_m, MAX_GATE_M)
