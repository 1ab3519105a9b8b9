"""Divergence of the default profile (MODEL 6): many seeds on each network, and the worst of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from emulator.cells.cells import Cell
from studies.measure import DIVERGENT_M, DIVERGENT_S, DIVERGENT_SIGMAS, study_cell
from studies.paper import DEFAULT_ROWS, Labels, counted_from, default_scenario
from studies.reports import MISSING, Result, column, markdown_table, select, unique

LENGTH_S = 30.0
"""Length of a run: a vehicle that diverges does so at first, before any vehicle knows the common error."""


def divergence_cells(
    networks: dict[str, dict[str, Any]], seeds: Sequence[int], duration_s: float = LENGTH_S
) -> list[Cell]:
    """Optimized weights on all networks, for `duration_s`."""
    cells = []
    for network, section in networks.items():
        for seed in seeds:
            labels: Labels = {"network": network, "mechanism": "optimized", "seed": seed, "duration_s": duration_s}
            scenario = default_scenario(section, seed, DEFAULT_ROWS["optimized"], duration_s)
            cells.append(study_cell(labels, scenario, counted_from(duration_s)))
    return cells


def report(results: Sequence[Result]) -> str:
    """Return the number of divergent vehicles and the RMSE over the seeds, in Markdown."""
    header = [
        "network",
        "runs",
        "emulated [s]",
        "counted from [s]",
        "divergent vehicles",
        "runs with any",
        "beyond stated deviations",
    ]
    header += ["RMSE, median [m]", "95th percentile [m]", "worst [m]"]
    rows = [_row(select(results, network=network)) for network in unique(results, "network")]
    return (
        "# Divergence: the default profile over many seeds\n\n"
        f"{markdown_table(header, rows)}\n\n"
        f"{_summary(results)} A vehicle is divergent whose common error is over {DIVERGENT_M:g} m for "
        f"{DIVERGENT_S:g} s at any time of the run; beyond stated deviations are vehicles whose common error is "
        f"over {DIVERGENT_SIGMAS:g} of those that they state, for as long. RMSE is that of the common error over "
        "all vehicles of a run, and its percentiles are over the seeds. "
        f"{sum(row['not_finite'] for row in results)} reports were not finite.\n"
    )


def _summary(results: Sequence[Result]) -> str:
    """The number of runs with a divergent vehicle; if none, an upper bound on their share."""
    diverged = sum(row["divergent"] > 0 for row in results)
    text = f"{diverged} of {len(results)} runs had a vehicle that diverged"
    if diverged:
        return f"{text}."
    least = min(len(select(results, network=network)) for network in unique(results, "network"))
    return f"{text}: with 95 % confidence, less than {100 * (1 - 0.05 ** (1 / least)):.2g} % on each network do."


def _row(rows: Sequence[Result]) -> list[str]:
    durations = unique(rows, "duration_s")
    known = [row for row in rows if row["rmse_m"] is not None]
    error = np.array(column(known, "rmse_m"), dtype=float)
    worst = max(known, key=lambda row: float(row["rmse_m"]), default=None)
    return [
        rows[0]["network"].upper(),
        str(len(rows)),
        " ".join(f"{duration_s:g}" for duration_s in durations),
        " ".join(f"{counted_from(duration_s):g}" for duration_s in durations),
        str(sum(column(rows, "divergent"))),
        str(sum(row["divergent"] > 0 for row in rows)),
        str(sum(row["divergent_sigmas"] for row in rows)),
        f"{np.median(error):.3f}" if worst else MISSING,
        f"{np.percentile(error, 95):.3f}" if worst else MISSING,
        f"{worst['rmse_m']:.3f} (seed {worst['seed']})" if worst else MISSING,
    ]
