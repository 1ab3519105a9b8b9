"""Problems of a map: its likely errors, and its shift and bias against recorded trips, before a run meets them.

No filter can tell a shift of the map, its *datum*, from the common error of receivers: both move all vehicles
alike. Recorded trips whose positions are true can. Where a vehicle drives at q, the nearest lane that fits its
heading, with normal n and n·p = offset, leaves the residual r = n·q − offset, and over all vehicles and roads

    r = aside + n·datum + e

is fitted by least squares with weights that fall to 0 at 4.7 deviations (Tukey's biweight): a vehicle on a
road that the map does not have says nothing. Residuals are alike within some 500 m, and where one person drives:
the standard error is the larger of what squares of that side tell and what the jackknife over vehicles does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.world.maps.roads import NAMES, Ints, Roads
from emulator.world.trips.motion import Motion
from vnet.errors import ScenarioError
from vnet.extras import require
from vnet.roads.road_map import RoadMap
from vnet.types import Array

REACH_M = 25.0
"""Distance (m) within which a lane is sought."""
SPACING_M = 20.0
"""Way (m) of a vehicle between two of its residuals: those closer together are the same."""
PLACE_M = 500.0
"""Side (m) of the squares whose residuals are taken for independent of each other."""
MIN_PLACES = 10
"""Least number of squares that make a calibration."""
ROUNDS = 30
"""Rounds of reweighting."""
GROUPS = 50
"""Most groups of vehicles without which a fit is made: each is a fit."""
BIWEIGHT = 4.685
"""Tukey's constant: 95 % as efficient as least squares where residuals are Gaussian."""
NORMAL_MAD = 1.4826
"""Deviation of a Gaussian relative to the median of absolute deviations."""
GAP_M = 1.0
"""A road's end this close to another point, but not joined to it, is more likely an error than a dead end."""


@dataclass(frozen=True)
class Residuals:
    """Residuals `metres` (n,) to the right of lanes with normals `normal` (n, 2), in squares `place` (n, 2).

    vehicle: (n,), row numbers of the vehicles.
    """

    metres: Array
    normal: Array
    place: NDArray[np.intp]
    vehicle: NDArray[np.intp]

    def of(self, vehicles: NDArray[np.bool_]) -> Residuals:
        """Return those of the vehicles of a mask (N,)."""
        return self.rows(vehicles[self.vehicle])

    def rows(self, kept: NDArray[np.bool_]) -> Residuals:
        """Return those of a mask (n,)."""
        return Residuals(self.metres[kept], self.normal[kept], self.place[kept], self.vehicle[kept])


@dataclass(frozen=True)
class Calibration:
    """Shift of a map as trips tell it; lengths in metres.

    datum_m: (2,), by how much the map is to be moved east and north. error_m: (2,), its standard error.
    aside_m: mean distance of the driven line to the right of the lanes. sigma_m: deviation of residuals.
    places, samples: number of squares and of residuals.
    """

    datum_m: Array
    error_m: Array
    aside_m: float
    sigma_m: float
    places: int
    samples: int


def residuals(lanes: RoadMap, motion: Motion) -> Residuals:
    """Return the residuals of all vehicles that drive near a lane that fits their heading."""
    parts = []
    for vehicle in range(len(motion.node_ids)):
        position_m, heading_rad = motion.position_m[:, vehicle], motion.heading_rad[:, vehicle]
        rows = _apart(position_m, heading_rad)
        found, segment, _ = lanes.near(position_m[rows], heading_rad[rows], np.full(len(rows), REACH_M))
        first = np.flatnonzero(np.diff(found, prepend=-1))  # the nearest of each
        found, segment = rows[found[first]], segment[first]
        off_m = (lanes.normal[segment] * position_m[found]).sum(axis=1) - lanes.offset_m[segment]
        parts.append(
            Residuals(
                off_m,
                lanes.normal[segment],
                np.floor(position_m[found] / PLACE_M).astype(np.intp),
                np.full(len(found), vehicle),
            )
        )
    return Residuals(
        np.concatenate([part.metres for part in parts]),
        np.concatenate([part.normal for part in parts]),
        np.concatenate([part.place for part in parts]),
        np.concatenate([part.vehicle for part in parts]),
    )


def calibrate(found: Residuals) -> Calibration:
    """Fit datum and mean offset to residuals. Raise ScenarioError if they are in too few places."""
    where, index = np.unique(found.place, axis=0, return_inverse=True)
    places = len(where)
    if places < MIN_PLACES:
        raise ScenarioError(
            f"vehicles drive on its lanes in {places} squares of {PLACE_M:g} m: at least {MIN_PLACES} are needed"
        )
    fit = _fit(found, np.ones(len(found.metres)))
    # Sums over each square are independent; residuals in it are not (White 1980, by clusters).
    score = np.zeros((places, 3))
    np.add.at(score, index.ravel(), fit.weighted * fit.off_m[:, None])
    variance_m2 = np.diag(fit.inverse @ score.T @ score @ fit.inverse)[1:]
    variance_m2 = np.maximum(variance_m2, _jackknife_m2(found, fit)[1:])
    return Calibration(
        datum_m=fit.found_m[1:],
        error_m=np.sqrt(variance_m2),
        aside_m=float(fit.found_m[0]),
        sigma_m=fit.scale_m,
        places=places,
        samples=len(found.metres),
    )


@dataclass(frozen=True)
class _Fit:
    """A fit: coefficients (3,), weighted regressors (n, 3), weights (n,), residuals (n,), inverse matrix (3, 3)."""

    found_m: Array
    weighted: Array
    weight: Array
    off_m: Array
    inverse: Array
    scale_m: float


def _jackknife_m2(found: Residuals, fit: _Fit) -> Array:
    """Return the variances (3,) by fits without each group of vehicles in turn, from the weights of all on."""
    vehicles, index = np.unique(found.vehicle, return_inverse=True)
    groups = min(len(vehicles), GROUPS)
    if groups < 2:
        return np.zeros(3)
    without = []
    for group in range(groups):
        kept = index % groups != group
        without.append(_fit(found.rows(kept), fit.weight[kept], ROUNDS // 5).found_m)
    return np.asarray((groups - 1) * np.var(without, axis=0))


def _fit(found: Residuals, weight: Array, rounds: int = ROUNDS) -> _Fit:
    regressors = np.column_stack([np.ones(len(found.metres)), found.normal])
    for _ in range(rounds):
        weighted = regressors * weight[:, None]
        inverse = np.linalg.pinv(weighted.T @ regressors)
        found_m = inverse @ weighted.T @ found.metres
        off_m = found.metres - regressors @ found_m
        scale_m = NORMAL_MAD * float(np.median(np.abs(off_m))) + 1e-9
        weight = np.maximum(0.0, 1 - (off_m / (BIWEIGHT * scale_m)) ** 2) ** 2
    return _Fit(found_m, weighted, weight, off_m, np.asarray(inverse), scale_m)


def _apart(position_m: Array, heading_rad: Array) -> NDArray[np.intp]:
    """Return the rows (n,) of a vehicle's positions that are `SPACING_M` apart, along its way."""
    present = np.flatnonzero(np.isfinite(position_m[:, 0]) & np.isfinite(heading_rad))
    if not len(present):
        return present
    steps_m = np.hypot(*np.diff(position_m[present], axis=0).T)
    step = np.floor(np.append(0.0, np.cumsum(steps_m)) / SPACING_M)
    return present[np.flatnonzero(np.diff(step, prepend=-1))]


@dataclass(frozen=True)
class MapReport:
    """The figures that `vnet map show` prints: lengths in km, counts, and the `problems` that occur.

    `by_class` gives the number of roads and their length in km; `size_km` the extent east and north.
    """

    length_km: float
    lane_km: float
    roads: int
    nodes: int
    by_class: dict[str, tuple[int, float]]
    one_way_km: float
    size_km: tuple[float, float]
    problems: dict[str, str]


def examine(roads: Roads) -> MapReport:
    """Measure a map and count its likely errors."""
    km = roads.length_m / 1000
    require("the problems of a map", "scipy", error=ScenarioError)
    by_class = {
        NAMES[kind]: (int((roads.kind == kind).sum()), float(km[roads.kind == kind].sum()))
        for kind in np.unique(roads.kind).tolist()
    }
    east, north = np.ptp(roads.node_m, axis=0) / 1000
    return MapReport(
        length_km=float(km.sum()),
        lane_km=float(km @ (roads.forward + roads.backward)),
        roads=len(roads),
        nodes=len(roads.node_m),
        by_class=dict(sorted(by_class.items(), key=lambda entry: -entry[1][1])),
        one_way_km=float(km[roads.one_way].sum()),
        size_km=(float(east), float(north)),
        problems=_problems(roads),
    )


def _piece_of_node(roads: Roads) -> Ints:
    """Return the connected component (N,) of each point; component 0 has the greatest length of road."""
    start, end = roads.node[roads.segment], roads.node[roads.segment + 1]
    count = len(roads.node_m)
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    joined = coo_matrix((np.ones(len(start)), (start, end)), shape=(count, count))
    pieces, label = connected_components(joined, directed=False)
    length_m = np.bincount(label[start], roads.segment_length_m, minlength=pieces)
    rank = np.empty(pieces, dtype=np.intp)
    rank[np.argsort(-length_m, kind="stable")] = np.arange(pieces)
    return np.asarray(rank[label])


def _problems(roads: Roads) -> dict[str, str]:
    found = {oddity: f"{count:,}" for oddity, count in roads.notes.items()}
    start, end = roads.node[roads.segment], roads.node[roads.segment + 1]
    piece = _piece_of_node(roads)
    if piece.max():
        isolated_km = roads.segment_length_m[piece[start] > 0].sum() / 1000
        found["isolated pieces"] = f"{piece.max():,}, {isolated_km:.1f} km of road outside the largest piece"
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, times = np.unique(low * len(roads.node_m) + high, return_counts=True)
    _add_count(found, "duplicate segments", int((times - 1).sum()))
    _add_count(found, "segments without length", int((roads.segment_length_m == 0).sum()))
    degree = np.bincount(np.concatenate([start, end]), minlength=len(roads.node_m))
    _add_count(found, "dead ends", int((degree == 1).sum()))
    _add_count(found, f"ends within {GAP_M:g} m of a point but not joined to it", _gaps(roads, degree, start, end))
    return found


def _add_count(found: dict[str, str], problem: str, count: int) -> None:
    if count:
        found[problem] = f"{count:,}"


def _gaps(roads: Roads, degree: Ints, start: Ints, end: Ints) -> int:
    from scipy.spatial import cKDTree

    tree = cKDTree(roads.node_m)
    ends = np.flatnonzero(degree == 1)
    neighbour = np.empty(len(roads.node_m), dtype=np.intp)
    neighbour[start] = end
    neighbour[end] = start  # an end has one neighbour only
    distance_m, nearest = tree.query(roads.node_m[ends], k=3, distance_upper_bound=GAP_M)
    present = np.isfinite(distance_m) & (nearest != ends[:, None]) & (nearest != neighbour[ends, None])
    return int(present.any(axis=1).sum())
