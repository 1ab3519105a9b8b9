"""Figures of a run for a study's table: those of its verdict, or those of the paper's experiments."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from emulator.cells.consistency import consistency_figures, others_figures
from emulator.checks.own import PREFIX
from emulator.drivers.emulation import Emulation
from emulator.records.divergence import first_divergences
from emulator.records.recorded_run import RecordedRun
from emulator.records.recorded_world import RecordedWorld
from emulator.records.reference import after, reference_series
from emulator.records.reported import reported_figures
from vnet.errors import VnetError
from vnet.types import Array
from vnet.units import NS_PER_S

WALL_CLOCK = ("wall_s", "real_time_factor")
"""Figures that the machine decides: they differ from run to run."""


def judged_figures(verdict: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of a judged run as one flat row.

    `failed`: the names of invalid checks; `frames_OUTCOME`: receptions by outcome; `packet_delivery_ratio`; all of
    vnet's figures by name; of each value that programs report the mean over all reports by its name, and as
    `last.NAME` the mean over the vehicles of their last one; of own checks each number by `own:NAME.FIGURE`. Texts
    and rows are left out.
    """
    frames = verdict["frames_by_outcome"]
    row = {
        "verdict": verdict["verdict"],
        "failed": ", ".join(check["name"] for check in verdict["checks"] if check["verdict"] == "invalid"),
        "vehicles": verdict["vehicles"],
        "emulated_s": verdict["emulated_s"],
        "packet_delivery_ratio": verdict["packet_delivery_ratio"],
        **{f"frames_{outcome}": count for outcome, count in frames.items()},
        **verdict["figures"],
        "trace_sha256": verdict["trace_sha256"],
        "metrics_sha256": verdict["metrics_sha256"],
        **{name: verdict[name] for name in WALL_CLOCK},
    }
    for name, figure in verdict["reported"].items():
        if figure["mean"] is not None:
            row[name if name not in row else f"reported.{name}"] = figure["mean"]
            row[f"last.{name}"] = figure["last"]
    for check in verdict["checks"]:
        if check["name"].startswith(PREFIX):
            figures = check.get("figures", {}).items()
            row |= {f"{check['name']}.{key}": value for key, value in figures if isinstance(value, int | float)}
    return row


REFERENCE = "reference_"
"""Prefix of the figures of a run's reference, and of the columns of a cell's metrics with those of each period."""


def measure(emulation: Emulation, from_s: float) -> tuple[dict[str, Any], pa.Table]:
    """Figures of a run from `from_s` on: roots of mean squares over the periods, in metres.

    Of the common error at the end of the period (`rmse_m`, `deviation_m`, by component), right after stacking
    (`stacked_…`), of positions; means of the consistency figures; `divergent` vehicles (MODEL 6); bytes a period;
    what `consistency_figures`, `others_figures` and, as `reference_…`, the run's reference have. Returned beside is
    the table of metrics, with the reference's figures of each period as further columns.
    """
    rows = [row for row in emulation.metrics.rows if row.time_ns >= from_s * 1e9]

    def rms(name: str) -> float | None:
        values = [getattr(row, name) for row in rows if getattr(row, name) is not None]
        return float(np.sqrt(np.mean(np.square(values)))) if values else None

    def mean(name: str) -> float | None:
        values = [getattr(row, name) for row in rows if getattr(row, name) is not None]
        return float(np.mean(values)) if values else None

    states = emulation.metrics.states_table()
    recorded = _recorded(emulation, states)
    reference, metrics = _reference(recorded), emulation.metrics.metrics_table()
    figures = {
        "rmse_m": rms("common_error_rmse_m"),
        "deviation_m": rms("deviation_m"),
        "bias_m": rms("bias_m"),
        "stacked_rmse_m": rms("stacked_rmse_m"),
        "stacked_deviation_m": rms("stacked_deviation_m"),
        "component_rmse_m": _rms_columns([row.component_rmse_m for row in rows]),
        "position_rmse_m": rms("position_rmse_m"),
        "fix_rmse_m": rms("fix_rmse_m"),
        "consensus_error_m": rms("consensus_error_m"),
        "common_error_anees": mean("common_error_anees"),
        "position_anees": mean("position_anees"),
        "divergent": _divergent(states, len(emulation.world.node_ids), emulation.world.period_ns),
        "bytes": _mean_value(states, "bytes"),
        "not_finite": sum(row.not_finite for row in rows),
        "metrics_sha256": emulation.metrics.sha256(),
        **consistency_figures(recorded, from_s),
        **others_figures(recorded, from_s),
    }
    settled = after(reference, math.ceil(from_s * NS_PER_S / emulation.world.period_ns))
    figures |= {REFERENCE + name: value for name, value in settled.items()}
    for name, series in reference.items():
        if series.ndim == 1:
            metrics = metrics.append_column(REFERENCE + name, pa.array(series, from_pandas=True))
    return figures, metrics


def _recorded(emulation: Emulation, states: pa.Table) -> RecordedRun:
    """Return the states of a run as those of its folder."""
    nothing, world = pa.table({}), RecordedWorld.of(emulation.world)
    return RecordedRun(emulation.scenario, nothing, states, nothing, (), world=world)


def _reference(recorded: RecordedRun) -> dict[str, Array]:
    """Return the figures of a run's reference in each period; none if it has no reference."""
    try:
        return reference_series(recorded)
    except VnetError:
        return {}


def _rms_columns(rows: list[list[float | None]]) -> list[float]:
    """Root mean square of each column; none where vehicles move and the number of components changes."""
    if len({len(row) for row in rows}) > 1:
        return []
    table = np.array([[np.nan if value is None else value for value in row] for row in rows], dtype=float)
    return [float(value) for value in np.sqrt(np.mean(table**2, axis=0))]


def _points(states: pa.Table, name: str) -> Array:
    return np.array([(np.nan, np.nan) if p is None else p for p in states[name].to_pylist()], dtype=float)


def _divergent(states: pa.Table, vehicles: int, period_ns: int) -> int:
    """The number of vehicles that diverged at any time."""
    error_m = np.hypot(*(_points(states, "common_error_estimate_m") - _points(states, "common_error_m")).T)
    return len(first_divergences(error_m.reshape(-1, vehicles), period_ns))


def _mean_value(states: pa.Table, name: str) -> float | None:
    figure = reported_figures(states).get(name)
    return None if figure is None else figure.mean
