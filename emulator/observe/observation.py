"""What the emulator tells those who watch: plain messages on `observe/scene` and `observe/period`.

Numbers, text, bytes and tables only, so that any language reads them. Arrays are little-endian float32 bytes, row
by row, in the order of `node_ids`; NaN stands for what a node did not report.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emulator.engine import Deliveries
from emulator.observe.metrics import PeriodFigures
from emulator.world.world import Instant, World
from vnet.link.node import Report
from vnet.scenario import Scenario


def pack(array: ArrayLike) -> bytes:
    """An array as float32 bytes."""
    return np.ascontiguousarray(array, dtype="<f4").tobytes()


def unpack(data: bytes, columns: int = 1) -> NDArray[np.float32]:
    """Restore `pack`, as (n, columns)."""
    return np.frombuffer(data, dtype="<f4").reshape(-1, columns)


def scene_message(world: World, scenario: Scenario) -> dict[str, Any]:
    """What does not change during a run: `node_ids`, lanes (`lane_point_m`, `lane_heading_rad`), `range_m`.

    `range_m` is None where the scenario gives links or a path loss, and it says nothing about who hears whom.
    """
    radio = scenario.radio
    return {
        "name": scenario.run.name,
        "node_ids": list(world.node_ids),
        "lane_point_m": pack(world.lane_map.point_m),
        "lane_heading_rad": pack(world.lane_map.heading_rad),
        "range_m": radio.range_m if radio.links is None and radio.path_loss is None else None,
        "period_ns": world.period_ns,
    }


def period_message(
    node_ids: Sequence[str],
    instant: Instant,
    reports: Iterable[Report],
    figures: PeriodFigures,
    counts: dict[str, int],
    deliveries: Sequence[Deliveries],
) -> dict[str, Any]:
    """One period: truth, fixes, what was reported, `figures`, `counts` by outcome so far, and `links` (int16 pairs
    sender, receiver of what was delivered).
    """
    last = {report.node: report for report in reports}
    heard = np.concatenate([np.zeros((0, 2), np.int64), *(some.pairs() for some in deliveries)])
    return {
        "period": instant.period,
        "time_ns": instant.time_ns,
        "position_m": pack(instant.position_m),
        "fix_m": pack(instant.fix_m),
        "common_error_m": pack(instant.common_error_m),
        "estimate_m": pack([_pair(last.get(node), None) for node in node_ids]),
        "common_error_estimate_m": pack([_pair(last.get(node), "common_error_m") for node in node_ids]),
        "clouds": {
            node: pack(cloud)
            for node, report in last.items()
            if isinstance(cloud := report.values.get("cloud_m"), list) and len(cloud) % 2 == 0
        },
        "figures": asdict(figures),
        "counts": counts,
        "links": np.unique(heard, axis=0).astype("<i2").tobytes(),
    }


def _pair(report: Report | None, name: str | None) -> Sequence[float]:
    value = None if report is None else (report.estimate_m if name is None else report.values.get(name))
    return value if isinstance(value, (list, tuple)) and len(value) == 2 else (np.nan, np.nan)
