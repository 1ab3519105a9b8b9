"""`[network.sumo]`: SUMO that is stepped with the run, and the build of it that is installed."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, distribution
from typing import Annotated

from pydantic import Field

from emulator.scenario.sections import Section

LIBSUMO = "libsumo"
"""The package that has SUMO as a library, and its name among the inputs of a run."""
VehicleId = Annotated[str, Field(min_length=1, max_length=200)]


class Sumo(Section):
    """`[network.sumo]`: which vehicles have programs, with `kind = "sumo"` and `step = true`."""

    nodes: tuple[VehicleId, ...] | None = Field(None, min_length=1)
    """Vehicles that have a program, by their ids in SUMO; if left out those that SUMO inserts first,
    `max_vehicles` of them, or all. The others drive, have no radio, and react."""
    lights_to: tuple[VehicleId, ...] = ()
    """Nodes that read the state of every traffic light with each fix, in `fix.sensors["traffic_lights"]`."""


def libsumo_build() -> str | None:
    """Return version and build of the libsumo that is installed, without importing it; None if there is none.

    The build is the wheel's platform: the same sources, built by another compiler, may round otherwise.
    """
    try:
        found = distribution(LIBSUMO)
    except PackageNotFoundError:
        return None
    tags = [line for line in (found.read_text("WHEEL") or "").splitlines() if line.startswith("Tag: ")]
    return " ".join([found.version, *sorted({tag.rpartition("-")[2] for tag in tags})])
