"""The reference that a run's program declares: an estimator that is told more than any vehicle, run over a run.

The declared module names its class as `REFERENCE = "module:class"`. Its figures stand beside those of the run that
have their names.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from emulator.radio.topology import component_links
from emulator.records.recorded_run import RecordedRun
from emulator.scenario.own_functions import declared, load_entry
from emulator.scenario.scenario import Scenario
from emulator.world.world import components
from vnet.errors import VnetError
from vnet.types import Array


@dataclass(frozen=True)
class Setting:
    """The inputs of a reference.

    `component` (N,) labels each vehicle's component; `periods` is the number of a run that is over.
    """

    scenario: Scenario
    component: NDArray[np.integer[Any]]
    lane_point_m: Array
    lane_heading_rad: Array
    periods: int | None = None


class Reference(Protocol):
    """A reference. It raises VnetError in one line for a setting in which there is none."""

    NAME: ClassVar[str]
    """Its name in legends."""
    TEXT: ClassVar[str]
    """Its description, a noun phrase."""
    COLUMNS: ClassVar[tuple[str, ...]]
    """The columns of the states that it needs."""

    def __init__(self, setting: Setting) -> None: ...

    def step(self, time_ns: int, states: Mapping[str, Array]) -> Mapping[str, float | list[float]]:
        """Take a period, in which each column has a row for each vehicle; returns figures by name.

        A figure with a value for each component is a list. No figures where there is nothing to compare with.
        """


def reference_of(scenario: Scenario) -> type[Reference]:
    """Return the reference that a scenario's programs declare. Raises VnetError if they declare none."""
    entries = declared(scenario.program, "REFERENCE")
    if not entries:
        raise VnetError("the program declares no reference")
    return load_entry(entries[0])  # type: ignore[no-any-return]


def reference_series(recorded: RecordedRun) -> dict[str, Array]:
    """Return the figures of a run's reference by name, (periods,) or (periods, components); NaN where it has none.

    Of the states the columns that the reference names are needed. Raises VnetError with the reason if the run has
    no reference.
    """
    scenario, world = recorded.scenario, recorded.world
    made = reference_of(scenario)
    if world is None:
        raise VnetError("the lanes of the run were not recorded")
    links = component_links(scenario, world.radio_inputs, world.position_m)
    component = components(world.position_m, scenario.radio.range_m, links)
    setting = Setting(scenario, component, world.lane_point_m, world.lane_heading_rad, recorded.periods)
    reference = made(setting)
    columns = {name: recorded.by_period(name) for name in made.COLUMNS}
    rows = [
        reference.step(k * scenario.period_ns, {name: column[k] for name, column in columns.items()})
        for k in range(recorded.periods)
    ]
    some = next(filter(None, rows), None)
    if some is None:
        raise VnetError(f"no program reported what the {made.NAME} is compared with")
    missing = {name: np.full_like(value, np.nan, dtype=float) for name, value in some.items()}
    return {name: np.array([row.get(name, missing[name]) for row in rows], dtype=float) for name in some}
