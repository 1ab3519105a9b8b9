"""Scenarios in which vehicles move, for tests: made of a function for each vehicle."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from emulator.scenario.scenario import Scenario

Course = Callable[[float], tuple[float, float]]
Stay = tuple[float, float, Course]
"""From when until when (s) a vehicle is there, and where it is at a time."""


def still(x_m: float, y_m: float = 0.0) -> Course:
    return lambda time_s: (x_m, y_m)


def along(x_m: float, speed_mps: float, y_m: float = 0.0) -> Course:
    return lambda time_s: (x_m + speed_mps * time_s, y_m)


def write_trips(path: Path, vehicles: Mapping[str, Sequence[Stay]], rate_hz: float = 5.0) -> Path:
    """A CSV file in which each vehicle has its stays, sampled at `rate_hz`."""
    rows = ["id,time_s,x_m,y_m"]
    for name, stays in vehicles.items():
        for start_s, end_s, course in stays:
            for time_s in np.arange(round(start_s * rate_hz), round(end_s * rate_hz) + 1) / rate_hz:
                rows.append(f"{name},{time_s:.6f},{','.join(f'{value:.6f}' for value in course(time_s))}")
    path.write_text("\n".join(rows) + "\n")
    return path


def scenario_of_trips(
    path: Path,
    duration_s: float,
    program: str = "agents.beacon:main",
    faults: Sequence[dict[str, Any]] = (),
    **sections: dict[str, Any],
) -> Scenario:
    """A run over these trips, at 5 Hz, from time 0; absences are longer than two seconds."""
    data: dict[str, Any] = {
        "run": {"duration_s": duration_s, "settle_s": 0.5},
        "network": {"kind": "trips", "path": str(path), "start_s": 0.0, "longest_gap_s": 2.0},
        "world": {"gnss": {"rate_hz": 5}},
        "radio": {"loss": 0.1},
        "program": {"entry": program},
        "fault": list(faults),
    }
    for name, section in sections.items():
        data[name] = {**data[name], **section}
    return Scenario.model_validate(data)
