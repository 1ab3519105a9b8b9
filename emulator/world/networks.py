"""Networks of standing vehicles on straight lanes, read from CSV or generated.

Generated networks have the character of the paper's three networks (Ann Arbor, zhao-lab/network-propagation, MIT):
the targets below are their sorted degrees at 3 km range and the sizes of their components. Positions are drawn, and
then annealed until the degrees fit. The published positions are not used.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from itertools import compress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emulator.scenario.random_streams import NETWORK_KEY, philox
from emulator.world.input_files import check_columns, check_row_count, number_within, open_csv
from vnet.errors import ScenarioError, shown
from vnet.transport.keys import is_segment
from vnet.types import Array

COLUMNS = ("id", "x_m", "y_m", "heading_rad")
"""Columns of a network file."""
REFERENCE_RANGE_M = 3000.0
"""Radio range at which the degrees below hold."""
MAX_COORDINATE_M = 2e7
"""Bound of coordinates: twice what projections use, and what 32 bits hold in cm."""
LARGEST_EXTENT_DEG = 2.0
"""Extent of the largest region whose vehicles are taken for positions in degrees."""
MOST_TURNED_RAD = 4 * np.pi
"""Heading beyond which it is probably in degrees: whoever unwinds headings rarely counts more turns."""
HEADINGS_NOTE = "heading_rad looks like degrees, and is taken for radians"
DEGREES_NOTE = "x_m and y_m look like degrees, and are taken for metres; trips may be in lat_deg and lon_deg"
_LONGEST_LINE = 10_000
"""Characters of a line of a network file."""

# Degrees of the published networks at 3 km, by number of vehicles, as "degree:number of vehicles that have it".
_DEGREES = {
    50: "2:2 3:1 4:2 5:1 7:3 8:1 9:2 10:4 11:4 12:4 13:3 14:2 15:3 16:6 17:3 18:5 20:1 21:2 22:1",
    38: "2:2 3:2 4:2 5:3 6:3 7:7 8:2 9:6 10:8 12:3",
    24: "2:8 3:5 4:2 5:2 7:4 8:2 9:1",
}
_COMPONENTS = {50: (50,), 38: (38,), 24: (15, 6, 3)}
"""Sizes of the published networks' components, by number of vehicles."""

_AXIS_SHARES = {0.0: 0.24, math.pi / 2: 0.08, math.pi: 0.16, 3 * math.pi / 2: 0.04}
"""Shares of the vehicles with a heading along an axis, as in a town with a grid; the others' headings are
uniform."""
_AXIS_SPREAD_RAD = math.radians(2.0)
"""Standard deviation of a heading along an axis."""

TOWN_SIDE_M = 10_500.0
"""Side of the square for 50 vehicles; its area is proportional to their number."""
_ANNEALING_MOVES = 20_000
"""Most moves of the annealing."""
_LARGEST_ANNEALED = 200
"""Largest network that is annealed; larger ones are drawn uniformly."""


@dataclass(frozen=True)
class PlacedVehicles:
    """Vehicles and their lanes: `position_m` (N, 2) on the centre line, `heading_rad` (N,) in [0, 2π).

    `notes` are lines for the user about the file.
    """

    node_ids: tuple[str, ...]
    position_m: Array
    heading_rad: Array
    notes: tuple[str, ...] = ()


def load_network(path: Path) -> PlacedVehicles:
    """Read a CSV file with the columns `COLUMNS`. Raise ScenarioError, naming the line, for a bad file."""
    vehicles: dict[str, tuple[float, float, float]] = {}
    with open_csv(path, _LONGEST_LINE) as lines:
        reader = csv.DictReader(lines)
        check_columns(path, reader, COLUMNS)
        for row in reader:
            name, values = _read_row(path, reader.line_num, row)
            if name in vehicles:
                raise ScenarioError(f"{path}: line {reader.line_num}: id = {name!r} appears twice; ids must differ")
            vehicles[name] = values
            check_row_count(path, len(vehicles))
    if not vehicles:
        raise ScenarioError(f"{path}: no vehicles; at least one row is needed")
    numbers = np.array(list(vehicles.values()))
    are_degrees = _look_like_degrees(numbers[:, :2]), bool((np.abs(numbers[:, 2]) > MOST_TURNED_RAD).any())
    notes = compress([f"{path}: {DEGREES_NOTE}", f"{path}: {HEADINGS_NOTE}"], are_degrees)
    return PlacedVehicles(tuple(vehicles), numbers[:, :2], np.mod(numbers[:, 2], 2 * np.pi), tuple(notes))


def _look_like_degrees(position_m: Array) -> bool:
    """Return True for positions within some metres, with fractions, that would be places on earth in degrees."""
    extent = np.ptp(position_m, axis=0).max()
    on_earth = bool((np.abs(position_m) <= 180.0).all()) and bool((np.abs(position_m).min(axis=0) <= 90.0).any())
    has_fractions = bool((position_m != np.round(position_m, 2)).any())
    return 0 < extent < LARGEST_EXTENT_DEG and on_earth and has_fractions


def _read_row(path: Path, line: int, row: dict[str, str | None]) -> tuple[str, tuple[float, float, float]]:
    if None in row:
        raise ScenarioError(f"{path}: line {line}: more fields than columns; numbers are written with a point")
    name = (row["id"] or "").strip()
    if not is_segment(name):
        raise ScenarioError(f"{path}: line {line}: id = {shown(name)}: letters, digits, '_', '.', '-', at most 64")
    values = [number_within(path, line, row, column, MAX_COORDINATE_M) for column in COLUMNS[1:]]
    return name, (values[0], values[1], values[2])


def numbered_ids(vehicles: int) -> tuple[str, ...]:
    """Return the ids v01, v02, … of vehicles, which sort as they are numbered."""
    width = max(2, len(str(vehicles)))
    return tuple(f"v{number:0{width}d}" for number in range(1, vehicles + 1))


def generate_network(layout: str, vehicles: int, seed: int) -> PlacedVehicles:
    """Draw a network of `vehicles`; the same arguments give the same network.

    `urban` has the degrees and components of the published networks for 50, 38 and 24 vehicles; for other numbers,
    the scaled degrees of the nearest of them. `dense` is a city centre in which most vehicles are in range of each
    other.
    """
    rng = np.random.Generator(philox(seed, NETWORK_KEY))
    node_ids = numbered_ids(vehicles)
    heading_rad = _draw_headings(rng, vehicles)
    if layout == "dense":
        return PlacedVehicles(node_ids, rng.uniform(0, 1.4 * REFERENCE_RANGE_M, (vehicles, 2)), heading_rad)
    if 1 < vehicles <= _LARGEST_ANNEALED:
        return PlacedVehicles(node_ids, _Town(rng, vehicles).anneal(), heading_rad)
    side_m = TOWN_SIDE_M * math.sqrt(vehicles / 50)
    return PlacedVehicles(node_ids, rng.uniform(0, side_m, (vehicles, 2)), heading_rad)


def _draw_headings(rng: np.random.Generator, vehicles: int) -> Array:
    axes = np.array([*_AXIS_SHARES, np.nan])
    shares = np.array([*_AXIS_SHARES.values()])
    axis = rng.choice(axes, size=vehicles, p=[*shares, 1 - shares.sum()])
    along = axis + rng.normal(0, _AXIS_SPREAD_RAD, vehicles)
    anywhere = rng.uniform(0, 2 * np.pi, vehicles)
    return np.asarray(np.mod(np.where(np.isnan(axis), anywhere, along), 2 * np.pi))


def _target_degrees(vehicles: int) -> NDArray[np.intp]:
    """Return the sorted target degrees: published, or quantiles of the nearest connected published network."""
    connected = [count for count, sizes in _COMPONENTS.items() if len(sizes) == 1 or count == vehicles]
    nearest = min(connected, key=lambda count: (abs(count - vehicles), count))
    pairs = [entry.split(":") for entry in _DEGREES[nearest].split()]
    published = np.concatenate([np.full(int(count), int(degree)) for degree, count in pairs])
    if vehicles == nearest:
        return published
    quantiles = np.interp(np.linspace(0, 1, vehicles), np.linspace(0, 1, nearest), published)
    scale = min(1.0, math.sqrt(vehicles / nearest))
    degrees: NDArray[np.intp] = np.clip(np.round(quantiles * scale), 1, vehicles - 1).astype(np.intp)
    return degrees


class _Town:
    """Positions under annealing, in districts (one for each component) that lie further apart than the range.

    Vehicles move within their district. The cost is the L1 distance between the sorted degrees and the target, plus
    `SPLIT_COST` if a district is not connected.

    A vehicle's links are the bits of one number. The distance follows from how many more vehicles than targets have
    at most each degree: it is the sum of these numbers without their signs, of which a move changes a few.
    """

    SPLIT_COST = 8.0

    def __init__(self, rng: np.random.Generator, vehicles: int) -> None:
        self._rng = rng
        target = _target_degrees(vehicles)
        self._least_cost = int(target.sum()) % 2  # the sum of all degrees is even
        self._components = _COMPONENTS.get(vehicles, (vehicles,))
        district = np.repeat(np.arange(len(self._components)), self._components)
        side_m = TOWN_SIDE_M * np.sqrt(np.array(self._components) / 50)
        left_m = np.concatenate([[0.0], np.cumsum(side_m[:-1] + 1.1 * REFERENCE_RANGE_M)])
        low_m = np.column_stack([left_m, np.zeros(len(side_m))])[district]
        high_m = low_m + side_m[district, None]
        middle_m = (low_m + high_m) / 2
        drawn = rng.normal(middle_m, (high_m - low_m) / 4)
        position_m = np.clip(drawn, low_m, high_m)
        offset = position_m[:, None] - position_m[None]
        linked = np.hypot(offset[..., 0], offset[..., 1]) <= REFERENCE_RANGE_M
        np.fill_diagonal(linked, False)
        self._x_m, self._y_m = position_m.T.copy()
        self._bounds_m: list[list[float]] = np.column_stack([low_m, high_m]).tolist()
        self._links = [sum(1 << other for other in np.flatnonzero(row).tolist()) for row in linked]
        self._degree: list[int] = linked.sum(axis=1).tolist()
        more = np.bincount(self._degree, minlength=vehicles) - np.bincount(target, minlength=vehicles)
        self._excess: list[int] = np.cumsum(more).tolist()
        self._distance: int = sum(map(abs, self._excess))
        self.cost = self._cost()

    def _cost(self) -> float:
        if self._distance <= self.SPLIT_COST and self._is_split():
            return self._distance + self.SPLIT_COST
        return self._distance

    def _is_split(self) -> bool:
        """Return true if a district is not connected; districts lie too far apart to merge."""
        first = 0
        for size in self._components:
            reached = found = 1 << first
            while found:
                vehicle = found.bit_length() - 1
                new = self._links[vehicle] & ~reached
                reached |= new
                found = found ^ 1 << vehicle | new
            if reached.bit_count() != size:
                return True
            first += size
        return False

    def anneal(self) -> Array:
        """Move single vehicles by the Metropolis rule until the cost is least; return the best positions (N, 2)."""
        best_m, best_cost = np.column_stack([self._x_m, self._y_m]), self.cost
        for move in range(_ANNEALING_MOVES):
            if best_cost == self._least_cost:
                break
            temperature = 1.5 * (1 - move / _ANNEALING_MOVES) ** 2
            self._try_move(temperature)
            if self.cost < best_cost:
                best_m, best_cost = np.column_stack([self._x_m, self._y_m]), self.cost
        return best_m

    def _try_move(self, temperature: float) -> None:
        rng = self._rng
        vehicle = int(rng.integers(len(self._links)))
        step_m = REFERENCE_RANGE_M * (0.1, 0.4, 1.2)[int(rng.integers(3))]
        east, north = rng.normal(size=2).tolist()
        random_draw = rng.random()
        x_m, y_m = float(self._x_m[vehicle]) + step_m * east, float(self._y_m[vehicle]) + step_m * north
        low_x_m, low_y_m, high_x_m, high_y_m = self._bounds_m[vehicle]
        if not (low_x_m <= x_m <= high_x_m and low_y_m <= y_m <= high_y_m):
            return
        old_links, links = self._links[vehicle], self._links_at(vehicle, x_m, y_m)
        if links != old_links:
            self._link(vehicle, links)
            cost = self._cost()
            if cost > self.cost and random_draw >= math.exp((self.cost - cost) / max(temperature, 1e-9)):
                self._link(vehicle, old_links)
                return
            self.cost = cost
        self._x_m[vehicle], self._y_m[vehicle] = x_m, y_m

    def _links_at(self, vehicle: int, x_m: float, y_m: float) -> int:
        """Return the links that a vehicle has at a position."""
        east_m, north_m = self._x_m - x_m, self._y_m - y_m
        in_range = east_m * east_m + north_m * north_m <= REFERENCE_RANGE_M**2
        in_range[vehicle] = False
        return int.from_bytes(np.packbits(in_range, bitorder="little").tobytes(), "little")

    def _link(self, vehicle: int, links: int) -> None:
        """Give a vehicle these links, and no others."""
        all_links, degree, excess = self._links, self._degree, self._excess
        changed, all_links[vehicle] = all_links[vehicle] ^ links, links
        while changed:
            other = changed.bit_length() - 1
            changed ^= 1 << other
            all_links[other] ^= 1 << vehicle
            for each in (vehicle, other):
                had = degree[each]
                if links >> other & 1:
                    degree[each] = had + 1
                    excess[had] -= 1
                    self._distance += 1 if excess[had] < 0 else -1
                else:
                    degree[each] = had - 1
                    excess[had - 1] += 1
                    self._distance += 1 if excess[had - 1] > 0 else -1
