"""Propagation: path loss, shadowing, fading, and attenuation by buildings.

Path loss and shadowing are functions of the two positions alone: the mean power of a link depends neither on other
vehicles nor on the way by which the two came there. Fading is drawn for each frame and receiver.

The ray from one antenna to the other is straight, in the plane. A building adds `wall_db` for each time that the
ray crosses its outline, and `inside_db_per_m` for each metre of the ray inside. The result is the same for both
directions, wherever an outline begins, and whichever way it goes round. A ray that touches a corner, or runs along
a wall, has the loss of a ray a little to the north, and much less to the west.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from emulator.scenario.program import RoadsideUnit
from emulator.scenario.radio import Buildings as Section
from emulator.scenario.radio import DualSlope, Fading, FreeSpace, LogDistance, Shadowing, TwoRay, WinnerB1
from emulator.scenario.random_streams import Draws
from emulator.world.buildings import Buildings
from vnet.types import Array, Mask

LIGHT_M_S = 299_792_458.0
"""Speed of light in m/s."""
VEHICLE_ANTENNA_M = 1.5
"""Height of a vehicle's antenna above the ground where the path loss does not say it."""
NEAREST_M = 1.0
"""Least distance of the path loss models: below it, antennas are in each other's near field."""
WINNER_NEAREST_M = 3.0
"""Least distance of WINNER+ B1."""
WAVES = 512
"""Plane waves whose sum is the shadowing."""
QUANTILES = 1 << 16
"""Equally likely values of the fading factor."""
DIGITS = 6
"""Mean powers are rounded to millionths of a decibel: the last bit of a sum, which may depend on the library and on
the number of vehicles, then decides nothing."""


PathLossModel = FreeSpace | LogDistance | DualSlope | TwoRay | WinnerB1
"""A model of the path loss."""
CELL_M = 20.0
"""Least side of the cells in which edges are looked up: about the length of a building's edge."""
MOST_CELLS = 10_000_000
"""Entries of the table of cells; with enormous buildings cells are larger."""
MARGIN = 1e-3
"""Share of a cell by which rays are widened, against rounding, where cells are chosen."""
FIRST_REACH_M = 50.0
"""Length over which rays are followed in the first round; then twice as far, and so on."""
MOST_RAYS = 20_000
"""Rays that are followed at once, which bounds the memory."""
Index = NDArray[np.intp]


def vehicle_antenna_m(model: PathLossModel) -> float:
    """Return the height in m of the antennas of vehicles."""
    return model.antenna_m if isinstance(model, TwoRay | WinnerB1) else VEHICLE_ANTENNA_M


def loss_db(model: PathLossModel, distance_m: Array, height_m: tuple[Array, Array] | None = None) -> Array:
    """Return the path loss in dB over distances of any shape.

    `distance_m` are distances on the ground, and `height_m` the heights of both antennas; those of vehicles if
    left out.
    """
    far_m = np.maximum(distance_m, NEAREST_M)
    if isinstance(model, TwoRay):
        return _two_ray_db(model, far_m, *(height_m or (model.antenna_m, model.antenna_m)))
    if isinstance(model, WinnerB1):
        return _winner_b1_db(model, distance_m, *(height_m or (model.antenna_m, model.antenna_m)))
    if height_m is not None:
        far_m = np.maximum(np.hypot(distance_m, height_m[0] - height_m[1]), NEAREST_M)
    match model:
        case FreeSpace():
            return 20 * np.log10(4 * np.pi * far_m * model.frequency_ghz * 1e9 / LIGHT_M_S)
        case LogDistance():
            return model.reference_db + 10 * model.exponent * np.log10(far_m)
        case DualSlope():
            near = 10 * model.exponent * np.log10(np.minimum(far_m, model.break_m))
            beyond = 10 * model.far_exponent * np.log10(np.maximum(far_m, model.break_m) / model.break_m)
            return model.reference_db + near + beyond


def _two_ray_db(model: TwoRay, distance_m: Array, here_m: Array | float, there_m: Array | float) -> Array:
    """Return the two-ray path loss (Sommer, Joerer and Dressler 2012, equations 3 to 6) between two heights."""
    wavelength_m = LIGHT_M_S / (model.frequency_ghz * 1e9)
    direct_m, reflected_m = np.hypot(distance_m, here_m - there_m), np.hypot(distance_m, here_m + there_m)
    phase_rad = 2 * np.pi * (direct_m - reflected_m) / wavelength_m
    sine, cosine = (here_m + there_m) / reflected_m, distance_m / reflected_m
    root = np.sqrt(model.permittivity - cosine**2)
    reflection = (sine - root) / (sine + root)
    rays = np.abs(1 + reflection * np.exp(1j * phase_rad))
    return np.asarray(20 * np.log10(4 * np.pi * direct_m / wavelength_m / np.maximum(rays, 1e-9)))


def _winner_b1_db(model: WinnerB1, distance_m: Array, here_m: Array | float, there_m: Array | float) -> Array:
    """Return the WINNER+ B1 path loss with line of sight between two heights, not less than free space.

    WINNER+ D5.3, table 4-1, as 3GPP TR 36.885 and Gonzalez-Martin et al. (2019) take it: at least 3 m.
    """
    far_m = np.maximum(np.hypot(distance_m, here_m - there_m), WINNER_NEAREST_M)
    here_m, there_m = (np.maximum(height_m - model.environment_m, 0.1) for height_m in (here_m, there_m))
    break_m = 4 * here_m * there_m * model.frequency_ghz * 1e9 / LIGHT_M_S
    log_ghz = np.log10(model.frequency_ghz)
    near_db = 22.7 * np.log10(far_m) + 27 + 20 * log_ghz
    beyond_db = 40 * np.log10(far_m) + 7.56 - 17.3 * np.log10(here_m) - 17.3 * np.log10(there_m) + 2.7 * log_ghz
    free_db = 20 * np.log10(far_m) + 46.4 + 20 * np.log10(model.frequency_ghz / 5)
    return np.asarray(np.maximum(np.where(far_m < break_m, near_db, beyond_db), free_db))


def transmit_powers_dbm(
    model: PathLossModel | None, count: int, units: Sequence[RoadsideUnit] = ()
) -> list[float] | None:
    """Return the transmit powers in dBm of `count` nodes, of which the last are `units`; None without a model."""
    if model is None:
        return None
    of_units = [model.tx_power_dbm if unit.tx_power_dbm is None else unit.tx_power_dbm for unit in units]
    return [model.tx_power_dbm] * (count - len(units)) + of_units


class ShadowField:
    """Shadowing as a random field over the positions of both ends: a sum of plane waves of random direction.

    Its correlation is Gudmundson's exp(-Δ / d) for either end (1991), and the product of these for both (Wang,
    Tameh and Nix 2008). The wave vectors follow the spectrum of the exponential covariance in the plane: Gaussian
    vectors divided by the square root of a χ² variable of one degree of freedom. Adding both directions makes the
    field symmetric.
    """

    def __init__(self, shadowing: Shadowing, seed: int) -> None:
        self._sigma_db = shadowing.sigma_db
        self._decorrelation_m = shadowing.decorrelation_m
        uniform = Draws(seed, "shadowing").uniform(0, 0, 7 * WAVES).reshape(7, WAVES)
        self._here, self._there = (self._wave_vectors(uniform[first : first + 3]) for first in (0, 3))
        self._phase_rad = 2 * np.pi * uniform[6]

    def _wave_vectors(self, uniform: Array) -> Array:
        """Return wave vectors (2, WAVES) in rad/m from uniform draws (3, WAVES)."""
        from scipy.special import ndtri  # slow to import, and only shadowing needs it

        normal = ndtri(np.maximum(uniform, 1e-300))
        return np.asarray(normal[:2] / np.maximum(np.abs(normal[2]) * self._decorrelation_m, 1e-9))

    def between(self, position_m: Array, distance_m: Array) -> Array:
        """Return the shadowing loss (N, N) in dB between positions (N, 2) at these distances (N, N), in metres."""
        here = position_m @ self._here + self._phase_rad
        there = position_m @ self._there
        one_way = np.cos(here) @ np.cos(there).T - np.sin(here) @ np.sin(there).T
        # Both directions are correlated where the ends are close: the divisor keeps the variance of the sum.
        correlation = np.exp(-2 * distance_m / self._decorrelation_m)
        return np.asarray(self._sigma_db * (one_way + one_way.T) / np.sqrt(WAVES * (1 + correlation)))


class MeanPower:
    """Mean received power of every link: transmit power less path loss and shadowing.

    The last nodes are roadside `units`, with heights and powers of their own.
    """

    def __init__(
        self,
        path_loss: PathLossModel,
        shadowing: Shadowing | None,
        seed: int,
        units: Sequence[RoadsideUnit] = (),
    ) -> None:
        self._path_loss = path_loss
        self._units = tuple(units)
        self._shadow = ShadowField(shadowing, seed) if shadowing is not None else None

    def dbm(self, position_m: Array, distance_m: Array) -> Array:
        """Return the mean received power (N, N) in dBm; rows are senders, the diagonal is the transmit power.

        `position_m` (N, 2) are positions, `distance_m` (N, N) the distances between them; NaN gives NaN.
        """
        sent_dbm, height_m = self._antennas(len(position_m))
        power_dbm = sent_dbm - loss_db(self._path_loss, distance_m, height_m)
        if self._shadow is not None:
            power_dbm = power_dbm - self._shadow.between(position_m, distance_m)
        np.fill_diagonal(power_dbm, sent_dbm)
        return np.round(power_dbm, DIGITS)

    def _antennas(self, count: int) -> tuple[Array | float, tuple[Array, Array] | None]:
        """Return transmit powers (N, 1) in dBm and heights (N, 1) and (1, N) in m; one power without units."""
        if not self._units:
            return self._path_loss.tx_power_dbm, None
        of_vehicles_m = [vehicle_antenna_m(self._path_loss)] * (count - len(self._units))
        height_m = np.array(of_vehicles_m + [unit.height_m for unit in self._units])
        sent_dbm = np.array(transmit_powers_dbm(self._path_loss, count, self._units))
        return sent_dbm[:, None], (height_m[:, None], height_m[None, :])


@lru_cache(maxsize=16)
def _quantiles(m: float) -> Array:
    """Quantiles (QUANTILES,) of the gamma distribution of shape m and mean 1, at the middles of equal steps."""
    from scipy.special import gammaincinv  # slow to import, and only fading needs it

    return np.asarray(gammaincinv(m, (np.arange(QUANTILES) + 0.5) / QUANTILES) / m)


class Nakagami:
    """Nakagami fading: a frame's received power is multiplied by a gamma-distributed factor of mean 1.

    Nakagami 1960; the shape m depends on distance. Factors come from a table of quantiles at the middles of
    `QUANTILES` equally likely steps, so none exceeds the quantile of probability 1 - 2⁻¹⁷ (11.6 dB with m = 0.75).
    """

    def __init__(self, fading: Fading | None) -> None:
        self._until_m = np.array(fading.until_m if fading is not None else ())
        self._factor = np.concatenate([_quantiles(m) for m in fading.m]) if fading is not None else np.ones(1)
        self.fades = fading is not None
        """True if any factor is not one."""

    def shape(self, distance_m: Array) -> NDArray[np.intp]:
        """Return the table offsets of the shapes at these distances (any shape), as `factor` takes them."""
        return np.asarray(np.searchsorted(self._until_m, distance_m) * QUANTILES)

    def factor(self, shape: NDArray[np.intp], step: NDArray[np.intp]) -> Array:
        """Return the factors for table offsets from `shape` and drawn steps in [0, QUANTILES).

        Without fading it is one for all.
        """
        if len(self._factor) == 1:
            return self._factor
        factor: Array = self._factor[step + shape]
        return factor


class _Cells:
    """Boxes, from `low_m` to `high_m` (n, 2), by the square cells that they touch."""

    def __init__(self, low_m: Array, high_m: Array) -> None:
        self._corner_m = low_m.min(axis=0) if len(low_m) else np.zeros(2)
        self._cell_m = CELL_M
        while np.prod((high_m - low_m) / self._cell_m + 1, axis=1).sum() > MOST_CELLS + len(low_m):
            self._cell_m *= 2
        first, last = (
            np.floor((end_m - self._corner_m) / self._cell_m).astype(np.int64) for end_m in (low_m, high_m)
        )
        self._columns, self._rows = (int(most) + 1 for most in last.max(axis=0, initial=-1))
        wide, high = (last - first + 1).T
        box = np.repeat(np.arange(len(low_m)), wide * high)
        nth = np.arange(len(box)) - np.repeat(np.cumsum(wide * high) - wide * high, wide * high)
        column, row = first[box, 0] + nth // high[box], first[box, 1] + nth % high[box]
        key = column * self._rows + row
        order = np.argsort(key, kind="stable")
        self._key, self._box = key[order], box[order]

    def along(self, start_m: Array, end_m: Array) -> tuple[Index, Index]:
        """Return pairs (ray, box), perhaps twice: all boxes that rays touch, and others near them.

        Rays go from `start_m` to `end_m` (n, 2), and none of them to the west.
        """
        (west, south), (east, north) = ((end_m - self._corner_m).T / self._cell_m for end_m in (start_m, end_m))
        first = np.clip(np.floor(west - MARGIN), 0, self._columns).astype(np.intp)
        count = np.clip(np.floor(east + MARGIN) + 1, first, self._columns).astype(np.intp) - first
        ray = np.repeat(np.arange(len(first)), count)
        column = first[ray] + np.arange(len(ray)) - np.repeat(np.cumsum(count) - count, count)
        width = np.where(east > west, east - west, 1.0)
        ends = []
        for border in (column - MARGIN, column + 1 + MARGIN):
            share = (np.clip(border, west[ray], east[ray]) - west[ray]) / width[ray]
            ends.append(south[ray] + share * (north - south)[ray])
        ends[1] = np.where((east == west)[ray], north[ray], ends[1])
        low = np.maximum(np.floor(np.minimum(*ends) - MARGIN), 0)
        high = np.minimum(np.floor(np.maximum(*ends) + MARGIN), self._rows - 1)
        inside = high >= low
        ray, low, high = ray[inside], low[inside], high[inside]
        key = column[inside] * self._rows
        stretch = np.searchsorted(self._key, key + low, side="left")
        length = np.searchsorted(self._key, key + high, side="right") - stretch
        nth = np.arange(int(length.sum())) - np.repeat(np.cumsum(length) - length, length)
        return np.repeat(ray, length), self._box[np.repeat(stretch, length) + nth]


@dataclass
class _Crossings:
    """Crossings of rays and edges: number of the ray, number of the edge, and share of the ray (n,) each."""

    ray: Index
    edge: Index
    share: Array

    @classmethod
    def none(cls) -> _Crossings:
        """Return no crossings."""
        return cls(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0))

    def and_(self, other: _Crossings, edges: int) -> _Crossings:
        """Return both, each ray with each of so many edges once, by ray and edge."""
        ray, edge = np.append(self.ray, other.ray), np.append(self.edge, other.edge)
        _, index = np.unique(ray * edges + edge, return_index=True)
        return _Crossings(ray[index], edge[index], np.append(self.share, other.share)[index])

    def of(self, kept: Mask) -> _Crossings:
        """Return the crossings that a mask (n,) marks."""
        return _Crossings(self.ray[kept], self.edge[kept], self.share[kept])


class Obstacles:
    """Buildings between antennas. Losses of the last positions are kept, for pairs of vehicles that stand."""

    def __init__(self, buildings: Buildings, section: Section) -> None:
        self._wall_db, self._inside_db_per_m = section.wall_db, section.inside_db_per_m
        edge_m = buildings.edges_m()
        backwards = _is_before(edge_m[:, 1], edge_m[:, 0])
        edge_m[backwards] = edge_m[backwards, ::-1]
        self._edge_m, self._building = edge_m, buildings.edge_buildings()
        self._buildings = len(buildings)
        self._cells = _Cells(edge_m.min(axis=1), edge_m.max(axis=1))
        self._position_m: Array = np.zeros((0, 2))
        self._margin_db: Array = np.zeros((0, 0))
        self._loss_db: Array = np.zeros((0, 0))

    def loss_db(self, position_m: Array, margin_db: Array) -> Array:
        """Return the loss (N, N) in dB between positions (N, 2), infinite where it exceeds `margin_db` (N, N).

        The margin is symmetric; where it is negative, or NaN, nothing is computed, and the loss is infinite.
        """
        known = np.zeros(margin_db.shape, dtype=bool)
        loss_db = np.full(margin_db.shape, np.inf)
        if self._margin_db.shape == margin_db.shape:
            stands = (self._position_m == position_m).all(axis=1)
            known = stands[:, None] & stands & (self._margin_db == margin_db)
            loss_db[known] = self._loss_db[known]
        one, other = np.nonzero(np.triu(~known & (margin_db >= 0), 1))
        for first in range(0, len(one), MOST_RAYS):
            some = one[first : first + MOST_RAYS], other[first : first + MOST_RAYS]
            found_db = self._between(position_m[some[0]], position_m[some[1]], margin_db[some])
            loss_db[some] = loss_db[some[::-1]] = found_db
        self._position_m, self._margin_db, self._loss_db = position_m.copy(), margin_db.copy(), loss_db.copy()
        return loss_db

    def _between(self, start_m: Array, end_m: Array, margin_db: Array) -> Array:
        """Return the losses (n,) of rays from `start_m` to `end_m` (n, 2), infinite beyond their margin."""
        swapped = _is_before(end_m, start_m)[:, None]
        start_m, end_m = np.where(swapped, end_m, start_m), np.where(swapped, start_m, end_m)
        length_m = np.hypot(*(end_m - start_m).T)
        crossings, reach_m = _Crossings.none(), FIRST_REACH_M
        followed, passes = np.zeros(len(start_m)), np.ones(len(start_m), dtype=bool)
        alive = np.arange(len(start_m))
        while len(alive):  # most rays through a town need not be followed far
            until = np.minimum(followed[alive] + reach_m / np.maximum(length_m[alive], reach_m / 2), 1.0)
            more = self._crossings(start_m[alive], end_m[alive], followed[alive], until)
            crossings = crossings.and_(_Crossings(alive[more.ray], more.edge, more.share), len(self._building))
            passes &= self._wall_db * np.bincount(crossings.ray, minlength=len(start_m)) <= margin_db
            crossings = crossings.of(passes[crossings.ray])
            followed[alive], reach_m = until, 2 * reach_m
            alive = alive[(until < 1) & passes[alive]]
        walls = np.bincount(crossings.ray, minlength=len(start_m))
        loss_db = self._wall_db * walls + self._inside_db_per_m * self._inside_m(start_m, end_m, crossings, passes)
        return np.where(passes & (loss_db <= margin_db), loss_db, np.inf)

    def _crossings(self, start_m: Array, end_m: Array, first: Array, last: Array) -> _Crossings:
        """Return where rays cross edges between these shares (n,) of them, perhaps some twice, and others beyond.

        Ends of edges on the ray's line count as right of it, ends of rays on the edge's line as left of that: as
        if the ray were moved by a little to the north, and by much less to the west.
        """
        from_m, to_m = (start_m + share[:, None] * (end_m - start_m) for share in (first, last))
        ray, edge = self._cells.along(from_m, to_m)
        (one, two), start, end = self._edge_m[edge].swapaxes(0, 1), start_m[ray], end_m[ray]
        crosses = (_left_of(start, end, one) > 0) != (_left_of(start, end, two) > 0)
        ray, edge, one, two, start, end = (each[crosses] for each in (ray, edge, one, two, start, end))
        before, behind = _left_of(one, two, start), _left_of(one, two, end)
        crosses = (before >= 0) != (behind >= 0)
        before, behind = before[crosses], behind[crosses]
        return _Crossings(ray[crosses], edge[crosses], before / (before - behind))

    def _inside_m(self, start_m: Array, end_m: Array, crossings: _Crossings, chosen: Mask) -> Array:
        """Return the metres (n,) of rays inside buildings, 0 of those that are not `chosen` (n,).

        Along a ray the crossings of a building, with the ends that are inside it, are entries and exits by turns.
        """
        parts = [(crossings.ray, self._building[crossings.edge], crossings.share)]
        for end, point_m in ((0.0, start_m), (1.0, end_m)):
            place, building = self._containing(point_m[chosen])
            parts.append((np.flatnonzero(chosen)[place], building, np.full(len(place), end)))
        ray, building, share = (np.concatenate(each) for each in zip(*parts, strict=True))
        order = np.lexsort((share, building, ray))
        ray, share, one = ray[order], share[order], ray[order] * self._buildings + building[order]
        first = np.append(True, np.diff(one) != 0)[: len(one)]
        nth = np.arange(len(one)) - np.flatnonzero(first)[np.cumsum(first) - 1]
        exits = np.flatnonzero(nth % 2)
        shares = np.bincount(ray[exits], share[exits] - share[exits - 1], minlength=len(start_m))
        return np.asarray(shares * np.hypot(*(end_m - start_m).T))

    def _containing(self, point_m: Array) -> tuple[Index, Index]:
        """Return pairs of a point and a building around it, which a ray to the east crosses an odd number of times.

        Rays to the east treat points on a wall as all rays do, so that entries and exits are as many.
        """
        place, number = np.unique(point_m, axis=0, return_inverse=True)
        east_m = np.maximum(place[:, 0], self._edge_m[..., 0].max(initial=0.0)) + CELL_M
        far_m = np.column_stack([east_m, place[:, 1]])
        found = self._crossings(place, far_m, np.zeros(len(place)), np.ones(len(place)))
        found = _Crossings.none().and_(found, len(self._building))
        pair, times = np.unique(found.ray * self._buildings + self._building[found.edge], return_counts=True)
        contained = pair[times % 2 == 1]
        of_place = np.argsort(number.ravel(), kind="stable")
        first = np.searchsorted(number.ravel()[of_place], np.arange(len(place) + 1))
        at, building = contained // max(self._buildings, 1), contained % max(self._buildings, 1)
        each = first[at + 1] - first[at]
        nth = np.arange(int(each.sum())) - np.repeat(np.cumsum(each) - each, each)
        return of_place[np.repeat(first[at], each) + nth], np.repeat(building, each)


def _is_before(one_m: Array, other_m: Array) -> Mask:
    """Return whether points (n, 2) are west of others, or south of them at the same easting."""
    return np.asarray(
        (one_m[:, 0] < other_m[:, 0]) | ((one_m[:, 0] == other_m[:, 0]) & (one_m[:, 1] < other_m[:, 1]))
    )


def _left_of(start_m: Array, end_m: Array, point_m: Array) -> Array:
    """Return twice the areas (n,) of triangles: positive where the point is left of the way from start to end."""
    way_m, to_m = end_m - start_m, point_m - start_m
    return np.asarray(way_m[:, 0] * to_m[:, 1] - way_m[:, 1] * to_m[:, 0])
