"""GNSS receivers and motion sensors: the error that all share, and what each adds."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from emulator.scenario.random_streams import stream
from emulator.scenario.scenario import Scenario
from emulator.scenario.sections import WILD_M
from emulator.world.input_files import open_csv
from vnet.errors import ScenarioError, shown
from vnet.types import Array
from vnet.units import NS_PER_S

MOST_ROWS = 1_000_000
"""Most rows of a file: a day of ten a second has fewer."""
LONGEST_LINE = 10_000
"""Characters of a line of the file."""
FARTHEST_M = 100 * WILD_M
"""Largest recorded error."""
_COMPONENT = re.compile(r"(.+_|)(?:east|north)_m")
M_PER_KM = 1000.0
SLOWEST_MPS = 1e-9
"""Speed of a vehicle that stands, as a divisor."""
EVERY = slice(None)
"""All periods."""


@dataclass(frozen=True)
class CommonErrors:
    """The common error `common_m` (K, 2) at the start of each period, in metres.

    `receiver_m` (K, R, 2) is what each of a file's receivers has beyond it; None without several. Vehicle n has
    that of receiver n mod R.
    """

    common_m: Array
    receiver_m: Array | None = None


def common_errors(scenario: Scenario, periods: int) -> CommonErrors:
    """Return the common error of a run. Raise ScenarioError for a file that cannot be used."""
    common = scenario.world.common_error
    if common.path is None:
        error_m = gauss_markov(scenario, "common error", (common.sigma_m, common.tau_s), (periods, 2))
        return CommonErrors(error_m)
    time_s, error_m = _read(common.path)
    start_s = time_s[0] if common.start_s is None else common.start_s
    at_s = start_s + np.arange(periods) * scenario.period_ns / NS_PER_S
    if start_s < time_s[0] or at_s[-1] > time_s[-1]:
        raise ScenarioError(
            f"{common.path}: has errors from {time_s[0]:.10g} to {time_s[-1]:.10g} s; "
            f"the run needs them from {start_s:.10g} to {at_s[-1]:.10g} s"
        )
    columns = [np.interp(at_s, time_s, column) for column in error_m.reshape(len(time_s), -1).T]
    recorded_m = np.stack(columns, axis=1).reshape(periods, -1, 2)
    common_m = recorded_m.mean(axis=1)
    return CommonErrors(common_m, recorded_m - common_m[:, None] if recorded_m.shape[1] > 1 else None)


def gauss_markov(
    scenario: Scenario, name: str, law: tuple[float, float], shape: tuple[int, ...], item: int = 0
) -> Array:
    """Return a first-order Gauss-Markov process of `shape` (K, …) that starts in its stationary state.

    `law` is its standard deviation and its correlation time in s; `name` and `item` are those of its random stream.
    """
    sigma, tau_s = law
    normal = stream(scenario.run.seed, name, item).standard_normal(shape)
    keep = math.exp(-scenario.period_ns / NS_PER_S / tau_s)
    process = np.empty_like(normal)
    process[0] = sigma * normal[0]
    added = sigma * math.sqrt(1 - keep**2)
    for k in range(1, len(normal)):
        process[k] = keep * process[k - 1] + added * normal[k]
    return process


def _read(path: Path) -> tuple[Array, Array]:
    """Return times (k,) in s and errors (k, R, 2) in m of each receiver. Raise ScenarioError for a bad file."""
    with open_csv(path, LONGEST_LINE) as lines:
        reader = csv.DictReader(lines)
        columns = _columns(path, reader.fieldnames or ())
        rows = []
        for row in reader:
            rows.append([_number(path, reader.line_num, name, row[name]) for name in columns])
            if len(rows) > MOST_ROWS:
                raise ScenarioError(f"{path}: more than {MOST_ROWS:,} rows")
    if not rows:
        raise ScenarioError(f"{path}: no rows of errors")
    table = np.array(rows)
    late = np.flatnonzero(np.diff(table[:, 0]) <= 0)
    if len(late):
        time_s = table[late[0] + 1, 0]
        raise ScenarioError(f"{path}: time_s = {time_s:.10g} follows {table[late[0], 0]:.10g}: times must increase")
    far = np.abs(table[:, 1:]).max()
    if far > FARTHEST_M:
        raise ScenarioError(f"{path}: an error of {far:g} m; at most {FARTHEST_M:g} m are allowed")
    return table[:, 0], table[:, 1:].reshape(len(table), -1, 2)


def _columns(path: Path, names: object) -> list[str]:
    """Return the columns that are read: time_s, then east and north of each receiver."""
    found = [str(name) for name in names] if isinstance(names, (list, tuple)) else []
    receivers = dict.fromkeys(match[1] for name in found if (match := _COMPONENT.fullmatch(name)))
    columns = ["time_s", *(f"{receiver}{axis}_m" for receiver in receivers for axis in ("east", "north"))]
    missing = [name for name in columns if name not in found] or (["east_m"] if len(columns) == 1 else [])
    if missing:
        raise ScenarioError(
            f"{path}: no column {missing[0]}; time_s, east_m and north_m are needed, or of several receivers "
            "NAME_east_m and NAME_north_m each"
        )
    for name in columns:
        if found.count(name) > 1:
            raise ScenarioError(f"{path}: column {name} is there twice")
    return columns


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    try:
        number = float(text or "")
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ScenarioError(f"{path}: line {line}: {name} = {shown(text)}: a finite number is needed")
    return number


def noise_m(scenario: Scenario, periods: int, count: int) -> Array:
    """Draw the receivers' white noise (K, N, 2) in metres."""
    seed = scenario.run.seed
    normal = [stream(seed, "gnss", vehicle).standard_normal((periods, 2)) for vehicle in range(count)]
    return scenario.world.gnss.sigma_m * np.stack(normal, axis=1)


def further_error_m(
    scenario: Scenario, position_m: Array, middle_m: Array, receiver_m: Array | None
) -> Array | None:
    """Return what fixes have beyond truth, common error and noise (K, N, 2), in metres; None if there is nothing.

    That is multipath, outliers, the gradient of the common error at `position_m` (K, N, 2) around `middle_m` (2,),
    and what the receivers of a file have beyond their mean, `receiver_m` (K, R, 2).
    """
    gnss, common = scenario.world.gnss, scenario.world.common_error
    periods, count = position_m.shape[:2]
    parts: list[Array] = []
    if gnss.multipath_sigma_m:
        parts.append(_multipath_m(scenario, periods, count))
    if gnss.outlier_probability and gnss.outlier_m:
        parts.append(_outliers_m(scenario, periods, count))
    if common.gradient_m_per_km:
        law = common.gradient_m_per_km, common.tau_s
        gradient = gauss_markov(scenario, "common error gradient", law, (periods, 2, 2))
        parts.append(np.einsum("kij,knj->kni", gradient, (position_m - middle_m) / M_PER_KM))
    if receiver_m is not None:
        parts.append(receiver_m[:periods, np.arange(count) % receiver_m.shape[1]])
    return np.sum(parts, axis=0) if parts else None


def _multipath_m(scenario: Scenario, periods: int, count: int) -> Array:
    law = scenario.world.gnss.multipath_sigma_m, scenario.world.gnss.multipath_tau_s
    return np.stack([gauss_markov(scenario, "multipath", law, (periods, 2), n) for n in range(count)], axis=1)


def _outliers_m(scenario: Scenario, periods: int, count: int) -> Array:
    gnss = scenario.world.gnss
    draws = np.stack([stream(scenario.run.seed, "outlier", n).random((periods, 2)) for n in range(count)], axis=1)
    angle = 2 * math.pi * draws[..., 1]
    away_m = np.where(draws[..., 0] < gnss.outlier_probability, gnss.outlier_m, 0.0)
    return np.stack([away_m * np.cos(angle), away_m * np.sin(angle)], axis=-1)


class MotionSensors:
    """Headings and speeds as receivers tell them: the truth with noise that is drawn in advance.

    `rows` are the periods of the truth that is given: all at once, or one after the other as vehicles drive.
    """

    def __init__(self, scenario: Scenario, periods: int, count: int) -> None:
        self._gnss, seed = scenario.world.gnss, scenario.run.seed

        def normal(name: str, is_needed: bool) -> Array | None:
            if not is_needed:
                return None
            return np.stack([stream(seed, name, n).standard_normal(periods) for n in range(count)], axis=1)

        self._heading_normal = normal("heading", self._gnss.heading)
        self._speed_normal = normal("speed", self._gnss.speed_sigma_mps > 0)

    def heading_rad(self, heading_rad: Array, speed: Array, rows: slice = EVERY) -> Array:
        """Return the headings (k, N) of fixes in radians, [0, 2π); NaN for a fix without one."""
        gnss = self._gnss
        if self._heading_normal is None:
            return np.full(heading_rad.shape, np.nan)
        sigma_rad: Array | float = gnss.heading_sigma_rad
        if gnss.heading_speed_sigma_mps:
            by_speed = gnss.heading_speed_sigma_mps / np.maximum(speed, SLOWEST_MPS)
            sigma_rad = np.minimum(np.hypot(sigma_rad, by_speed), math.pi)
        heading = np.mod(heading_rad + sigma_rad * self._heading_normal[rows], 2 * np.pi)
        if gnss.heading_min_speed_mps:
            heading[speed < gnss.heading_min_speed_mps] = np.nan
        return np.asarray(heading)

    def speed_mps(self, speed: Array, rows: slice = EVERY) -> Array:
        """Return the speeds (k, N) of fixes in m/s, which are never negative; NaN for an absent vehicle."""
        if self._speed_normal is None:
            return speed
        return np.asarray(np.abs(speed + self._gnss.speed_sigma_mps * self._speed_normal[rows]))


def speed_mps(position_m: Array, period_ns: int, moves: bool) -> Array:
    """Return the vehicles' speeds (K, N) from positions (K, N, 2) in metres; NaN for an absent vehicle.

    They are means over the periods before and after. Vehicles that do not drive stand, however they sway.
    """
    absent = np.isnan(position_m[..., 0])
    if not moves:
        return np.where(absent, np.nan, 0.0)
    step_mps = np.linalg.norm(np.diff(position_m, axis=0), axis=2) / (period_ns / NS_PER_S)
    edge = np.full((1, position_m.shape[1]), np.nan)
    before, after = np.concatenate([edge, step_mps]), np.concatenate([step_mps, edge])
    known = np.isfinite(before).astype(int) + np.isfinite(after)
    total = np.nan_to_num(before) + np.nan_to_num(after)
    return np.where(absent, np.nan, total / np.maximum(known, 1))
