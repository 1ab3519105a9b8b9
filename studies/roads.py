"""Roads that nobody tuned on: what they tell of c, and what the exchange loses of it.

Vehicles drive through generated cities whose seeds no constant was chosen by, or as recorded trips did. Beside the
cooperative program stands one filter that hears all: the same filters of all vehicles, with one belief about c, to
which each adds its fixes at once. Its error is what roads tell; the rest is the exchange's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from agents.cooperative.cmm.information import Information
from agents.cooperative.cmm.own_vehicle import OwnVehicle, own_vehicle
from agents.cooperative.cmm.own_vehicle_on_map import OwnVehicleOnMap
from agents.cooperative.cmm.rbpf import Observation
from agents.cooperative.options import Options
from agents.cooperative.program import map_shift_m2
from emulator.cells.cells import Cell
from emulator.drivers.emulation import Emulation
from emulator.scenario.scenario import Scenario
from emulator.world.truth import Instant
from emulator.world.world import World
from studies.city import city_scenario
from studies.measure import measure, normalized
from studies.paper import SETTLED_S
from studies.reports import Result, column, markdown_table, mean_and_error, paired_ratio, select, unique, with_error
from vnet.types import Array

CITIES = (101, 102, 103)
"""Seeds of the cities: constants are chosen by cities of seeds below 100 alone."""
VEHICLES = 50
ONE = "one_filter_"
"""Prefix of the figures of the filter that hears all."""


class OneFilter:
    """The filters of all vehicles of a run, with one belief about c."""

    def __init__(self, world: World, options: Options) -> None:
        self._world, self._options = world, options
        self._shift_m2 = map_shift_m2(world.lane_map)
        self._own: dict[int, OwnVehicle | OwnVehicleOnMap] = {}
        self._rng = np.random.default_rng(0)
        self._noise_m2 = world.fix(0, int(np.flatnonzero(world.present(0))[0])).covariance_m2
        self._belief: Information | None = None

    def step(self, dt_s: float, instant: Instant) -> tuple[Array, Array, Array]:
        """Take the fixes of an instant; return c (2,), its stated covariance (2, 2), and positions (N, 2)."""
        present = np.flatnonzero(np.isfinite(instant.fix_m[:, 0])).tolist()
        for gone in set(self._own) - set(present):
            del self._own[gone]
        for number in present:
            if number not in self._own:
                own = own_vehicle(self._options.own_config(), self._world.lane_map, self._rng)
                if self._belief is not None:
                    own.restart(self._belief)
                self._own[number] = own
        said = [self._own[number].step(dt_s, self._fix(instant, number)) for number in present]
        pooled = self._own[present[0]].prior
        for increment in said:
            pooled = pooled.plus(increment)
        position_m = np.full(instant.fix_m.shape, np.nan)
        for number in present:
            own = self._own[number]
            own.absorb(pooled)
            found = own.position_m()
            position_m[number] = instant.fix_m[number] - own.estimate_m if found is None else found[0]
        self._belief = pooled
        common_m, covariance_m2 = pooled.moments()
        return common_m, covariance_m2 + self._shift_m2, position_m

    def _fix(self, instant: Instant, number: int) -> Observation:
        heading_rad = float(instant.fix_heading_rad[number])
        known = None if np.isnan(heading_rad) else heading_rad
        return Observation(instant.fix_m[number], self._noise_m2, known)


def measure_roads(emulation: Emulation, from_s: float) -> tuple[dict[str, Any], pa.Table]:
    """Figures of a run from `from_s` on, and beside them, as `one_filter_…`, those of the filter that hears all."""
    figures, metrics = measure(emulation, from_s)
    world, dt_s = emulation.world, emulation.world.period_ns / 1e9
    one = OneFilter(world, Options.parse(emulation.scenario.program.options))
    off_m, covariances_m2, away_m = [], [], []
    for period in range(len(emulation.metrics.rows)):
        instant = world.at(period)
        common_m, covariance_m2, position_m = one.step(dt_s, instant)
        if period * dt_s >= from_s:
            off_m.append(common_m - instant.common_error_m)
            covariances_m2.append(covariance_m2)
            away_m.append(position_m - instant.position_m)
    squares = normalized(np.array(off_m)[:, None], np.array(covariances_m2)[:, None])
    figures |= {
        f"{ONE}rmse_m": float(np.sqrt(np.mean(np.sum(np.array(off_m) ** 2, axis=1)))),
        f"{ONE}anees": float(np.mean(squares) / 2),
        f"{ONE}position_rmse_m": float(np.sqrt(np.nanmean(np.sum(np.array(away_m) ** 2, axis=2)))),
    }
    return figures, metrics


def roads_cells(
    places: Mapping[str, Mapping[str, Any]], seeds: Sequence[int], duration_s: float, rate_hz: float
) -> list[Cell]:
    """Return a cell for each place and seed; `places` are the sections `network` and, if any, `map`, by name."""
    return [
        Cell(
            {"place": name, "seed": seed}, _scenario(place, seed, duration_s, rate_hz), from_s, False, measure_roads
        )
        for from_s in (min(SETTLED_S, duration_s / 2),)
        for name, place in places.items()
        for seed in seeds
    ]


def _scenario(place: Mapping[str, Any], seed: int, duration_s: float, rate_hz: float) -> Scenario:
    return city_scenario({**place, "world": {"gnss": {"rate_hz": rate_hz}}}, seed, "optimized", duration_s)


def cities(seeds: Sequence[int]) -> dict[str, dict[str, Any]]:
    """Return the sections of generated cities by name."""
    return {f"city {seed}": {"network": {"kind": "city", "vehicles": VEHICLES, "seed": seed}} for seed in seeds}


def report(results: Sequence[Result], duration_s: float, rate_hz: float) -> str:
    """Return the errors of the program and of the filter that hears all, by place, in Markdown."""
    header = ["place", "one filter: c [m]", "its ANEES", "program: c [m]", "its ANEES", "95 % ellipses"]
    header += ["program : one filter", "position [m]", "of one filter", "diverged"]
    rows = []
    for place in unique(results, "place"):
        found = select(results, place=place)
        ratio = paired_ratio(column(found, "rmse_m"), column(found, f"{ONE}rmse_m"))
        rows.append(
            [
                place,
                mean_and_error(column(found, f"{ONE}rmse_m"), 2),
                mean_and_error(column(found, f"{ONE}anees"), 2),
                mean_and_error(column(found, "rmse_m"), 2),
                mean_and_error(column(found, "common_error_anees"), 2),
                f"{100 * np.mean(column(found, 'coverage_95')):.0f} %",
                with_error(*ratio, ".2f"),
                mean_and_error(column(found, "position_rmse_m"), 2),
                mean_and_error(column(found, f"{ONE}position_rmse_m"), 2),
                str(sum(column(found, "divergent"))),
            ]
        )
    return (
        "# Roads that nobody tuned on\n\n"
        f"{markdown_table(header, rows)}\n\n"
        f"RMSE from {min(SETTLED_S, duration_s / 2):g} s on, of {duration_s:g} s; fixes of {rate_hz:g} Hz; "
        f"{len(unique(results, 'seed'))} seeds, ± standard error. One filter: those of all vehicles with one "
        "belief about c, which hears every fix at once.\n"
    )
