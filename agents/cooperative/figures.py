"""Figures of the cooperative program's periods, and what of its reports they are made of.

The declaration of docs/how-to/results.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np


@dataclass(frozen=True)
class Figures:
    """Figures of a period. Lengths in metres; None where no node reported what is needed.

    x_i is vehicle i's estimate of the common error c, x̄ the mean of all x_i, m_i what vehicle i takes for the mean.
    The order of the fields is that of the hash of the metrics.
    """

    COLUMNS: ClassVar = {
        "common_error_m": ("common_error_estimate_m", 2, "`common_error_m` of its report"),
        "common_error_covariance_m2": (
            "common_error_covariance_m2",
            4,
            "of its report: a 2 × 2 matrix by rows",
        ),
        "mean_m": (
            "mean_m",
            2,
            "of its report: what it takes for the mean of all estimates of the common error",
        ),
        "stacked_common_error_m": (
            "stacked_common_error_m",
            2,
            "of its report: the common error right after fusion, before the map",
        ),
        "cloud_m": ("cloud_m", None, "of its report: some hypotheses of the common error, x and y in turns"),
    }
    PEERS: ClassVar = ("weight",)
    KEY_FIGURES: ClassVar = (
        {
            "name": "common_error_rmse_m",
            "title": "common error, RMSE",
            "chart": ("common-error", "Common error", "RMSE of the common error (m)"),
            "column": "RMSE (m)",
            "live": ("common error", "RMSE"),
        },
        {
            "name": "deviation_m",
            "title": "deviation between vehicles",
            "chart": ("deviation", "Deviation", "deviation (m)"),
            "column": "deviation (m)",
            "is_less": True,
            "of_agreement": True,
            "live": ("deviation", "between vehicles"),
        },
        {
            "name": "consensus_error_m",
            "title": "consensus error",
            "chart": ("consensus", "Consensus error", "consensus error (m)"),
        },
    )
    CHARTS: ClassVar = (
        {
            "id": "common-error",
            "title": "Common error",
            "axis": "common error (m)",
            "lines": {"RMSE": "common_error_rmse_m", "deviation": "deviation_m"},
            "text": "Distance of the vehicles' estimates from the true common error (RMSE) and from their mean "
            "(deviation).",
        },
        {
            "id": "consensus",
            "title": "Consensus error",
            "axis": "consensus error (m)",
            "lines": {"consensus error": "consensus_error_m", "error of the network's mean": "bias_m"},
            "text": "Distance of the means that vehicles hold from the mean of all estimates of their component, "
            "and of the mean of all estimates from the truth.",
        },
    )
    ESTIMATES: ClassVar = (
        {
            "name": "common",
            "title": "common error",
            "estimate": "common_error_estimate_m",
            "covariance": "common_error_covariance_m2",
            "truth": "common_error_m",
            "cloud": "cloud_m",
            "rings_m": (0.5, 1.0, 2.0, 5.0, 10.0),
            "view_m": 1.15,
        },
    )

    period: int
    time_ns: int
    reporting: int
    common_error_rmse_m: float | None
    """√(mean‖x_i − c‖²) over the network."""
    deviation_m: float | None
    """√(mean‖x_i − x̄‖²): how far the vehicles are from agreeing."""
    bias_m: float | None
    """‖x̄ − c‖."""
    stacked_rmse_m: float | None
    """As `common_error_rmse_m`, right after fusion, before the map."""
    stacked_deviation_m: float | None
    """As `deviation_m`, right after fusion, before the map."""
    component_rmse_m: list[float | None]
    """`common_error_rmse_m` of each connected component of the network: of the period's, where links change."""
    component_deviation_m: list[float | None]
    """`deviation_m` of each connected component, from its own mean."""
    position_rmse_m: float | None
    fix_rmse_m: float | None
    consensus_error_m: float | None
    """√(mean‖m_i − x̄‖²), with x̄ of the vehicle's component."""
    common_error_anees: float | None
    """ANEES of the common error."""
    position_anees: float | None
    not_finite: int

    @staticmethod
    def compute(periods: Any) -> dict[str, Sequence[Any]]:
        """Return the program's own figures of each of K periods."""
        truth, common = periods["common_error_m"], periods["common_error_estimate_m"]
        stacked, components = periods["stacked_common_error_m"], periods.components
        error, mean = common - truth, periods.mean(common)
        of_component = np.full_like(common, np.nan)
        for some in components:
            of_component[:, some] = periods.mean(common[:, some])
        bias = (mean - truth)[:, 0]
        bias_m = np.hypot(bias[:, 0], bias[:, 1]).tolist()
        return {
            "common_error_rmse_m": periods.rms(error),
            "deviation_m": periods.rms(common - mean),
            "bias_m": [value if math.isfinite(value) else None for value in bias_m],
            "stacked_rmse_m": periods.rms(stacked - truth),
            "stacked_deviation_m": periods.rms(stacked - periods.mean(stacked)),
            "component_rmse_m": _by_period([periods.rms(error[:, some]) for some in components], len(truth)),
            "component_deviation_m": _by_period(
                [periods.rms(common[:, some] - periods.mean(common[:, some])) for some in components], len(truth)
            ),
            "consensus_error_m": periods.rms(periods["mean_m"] - of_component),
            "common_error_anees": periods.anees(error, periods["common_error_covariance_m2"]),
        }


def _by_period(figures: list[list[float | None]], periods: int) -> list[list[float | None]]:
    """Turn the figures of each component in each period into those of each period by component."""
    return [[figure[number] for figure in figures] for number in range(periods)]
