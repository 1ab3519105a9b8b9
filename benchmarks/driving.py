"""A hundred vehicles that programs drive on a ring and through a city, simulated: how much faster than time."""

import tempfile
import time
from pathlib import Path
from typing import Any

from emulator.drivers.session import Session
from emulator.scenario.scenario import Scenario

SCENARIO: dict[str, Any] = {
    "run": {"name": "driving", "duration_s": 20.0},
    "network": {
        "kind": "driven",
        "vehicles": 100,
        "driven": {"road": "ring", "length_m": 3000.0, "lanes": 3, "gap_m": 40.0},
    },
    "world": {"ranging": {}},
    "radio": {"range_m": 150.0, "loss": 0.1},
    "program": {"entry": "docs.examples.platoon.platoon:main"},
}
CITY: dict[str, Any] = {
    "network": {
        "kind": "driven",
        "vehicles": 100,
        "size_m": 1500.0,
        "driven": {"road": "map", "speed_mps": 10.0, "gap_m": 10.0},
    },
    "radio": {"range_m": 380.0, "loss": 0.1},
}


def measure() -> dict[str, float]:
    """Return the figures of a ring, and those of a city."""
    city = measured(Scenario.model_validate(SCENARIO | CITY))
    return measured(Scenario.model_validate(SCENARIO)) | {f"city_{name}": value for name, value in city.items()}


def measured(scenario: Scenario) -> dict[str, float]:
    """Return emulated by processor time, and the share of the vehicles' motion in it."""
    with tempfile.TemporaryDirectory(prefix="vnet-bench-") as folder:
        session = Session(scenario, Path(folder) / "run").open()
        emulation = session.emulation
        advance, moving_s = emulation.driving.advance_to, [0.0]

        def timed(time_ns: int) -> bool:
            begun_s = time.process_time()
            moved = advance(time_ns)
            moving_s[0] += time.process_time() - begun_s
            return moved

        emulation.driving.advance_to = timed  # type: ignore[method-assign]
        begun_s = time.process_time()
        session.run()
        cpu_s = time.process_time() - begun_s
    return {
        "emulated_by_cpu_time": scenario.run.duration_s / cpu_s,
        "motion_share": moving_s[0] / cpu_s,
        "delivered_per_s": emulation.engine.counts[
            next(o for o in emulation.engine.counts if o.name == "delivered")
        ]
        / scenario.run.duration_s,
    }
