"""`[network.driven]` and `[world.ranging]`: vehicles that their programs drive, and how they see the one ahead."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from emulator.scenario.limits import WILD_M
from emulator.scenario.sections import Section
from vnet.units import NS_PER_S

Speed = Annotated[float, Field(ge=0, le=100)]
Place = Annotated[float, Field(ge=0, le=100_000)]


class Driven(Section):
    """`[network.driven]`: the road, where vehicles are at the start, and how they move (`kind = "driven"`)."""

    road: Literal["straight", "ring", "map"] = "straight"
    """Shape of the road. Vehicles that come to the end of a `straight` one leave the network; a `ring` has none.
    With `map` they drive on the roads of `[map]`, or without it in a generated city (`network.size_m`, `seed`)."""
    routes: tuple[Annotated[tuple[str, ...], Field(min_length=1)], ...] | None = Field(None, min_length=1)
    """`map`: roads that vehicles follow, by their names in the map's file, such as `["way 12", "-way 7"]`; `-` for
    one against its direction. Vehicles have the routes in turn. If left out, each vehicle starts anywhere, and
    takes any exit of each junction, but dead ends; `network.seed` draws them."""
    length_m: float = Field(5000.0, ge=100, le=100_000)
    """Length of the road: of a ring the circumference of its rightmost lane."""
    lanes: int = Field(1, ge=1, le=12)
    """Number of lanes, all in one direction; lane 0 is the rightmost. A map has lanes of its own."""
    lane_width_m: float = Field(3.5, ge=2, le=10)
    """Width of a lane. A map has widths of its own."""
    gap_m: float = Field(30.0, gt=0, le=10_000)
    """Clear distance at the start between a vehicle and the next in its lane, the first one being the foremost.
    Where routes are drawn it is the least distance between two in a street."""
    speed_mps: Speed | tuple[Speed, ...] = 20.0
    """Speed at the start, of all vehicles or of each."""
    start_m: tuple[Place, ...] | None = None
    """Position of each vehicle's centre along the road, or its route, at the start, in place of `gap_m`."""
    start_lanes: tuple[Annotated[int, Field(ge=0, le=11)], ...] | None = None
    """Lane of each vehicle at the start; if left out vehicles are put into the lanes in turn."""
    lag_s: float = Field(0.3, ge=0, le=10)
    """Time constant with which the acceleration follows what the program asks for."""
    max_acceleration_mps2: float = Field(3.0, gt=0, le=100)
    """Largest acceleration; what a program asks for beyond it is limited, with an event."""
    max_braking_mps2: float = Field(8.0, gt=0, le=100)
    """Largest deceleration."""
    max_speed_mps: float = Field(50.0, gt=0, le=100)
    """Largest speed. Vehicles do not reverse."""
    vehicle_length_m: float = Field(4.5, ge=1, le=30)
    """Length of a vehicle."""
    vehicle_width_m: float = Field(1.8, gt=0, le=4)
    """Width of a vehicle. Two collide where their rectangles overlap."""
    lane_change_s: float = Field(4.0, gt=0, le=60)
    """Duration of a lane change."""

    @model_validator(mode="after")
    def _fits_the_road(self) -> Driven:
        if any(speed > self.max_speed_mps for speed in self.speeds_mps(1)):
            raise ValueError(f"speed_mps: at most max_speed_mps = {self.max_speed_mps:g}")
        if self.road == "map":
            return self._fits_a_map()
        if self.routes is not None:
            raise ValueError(f'routes goes with road = "map", not with "{self.road}"')
        if any(lane >= self.lanes for lane in self.start_lanes or ()):
            raise ValueError(f"start_lanes: the lanes are 0 to {self.lanes - 1}")
        if any(place > self.length_m for place in self.start_m or ()):
            raise ValueError(f"start_m: at most length_m = {self.length_m:g}")
        if self.vehicle_width_m > self.lane_width_m:
            raise ValueError(f"vehicle_width_m: at most lane_width_m = {self.lane_width_m:g}")
        if self.road == "ring" and self.length_m / (2 * math.pi) <= self.lanes * self.lane_width_m:
            raise ValueError(f"length_m = {self.length_m:g}: too short for a ring of {self.lanes} lanes")
        return self

    def _fits_a_map(self) -> Driven:
        fields = type(self).model_fields
        for name in ("length_m", "lanes", "lane_width_m"):
            if getattr(self, name) != fields[name].default:
                raise ValueError(
                    f'{name} goes with road = "straight" or "ring": a map has roads and lanes of its own'
                )
        if self.routes is None and (self.start_m is not None or self.start_lanes is not None):
            raise ValueError('start_m and start_lanes need routes where road = "map"')
        return self

    def speeds_mps(self, vehicles: int) -> tuple[float, ...]:
        """Return the speed at the start of each of so many vehicles, if they have one in common."""
        return self.speed_mps if isinstance(self.speed_mps, tuple) else (self.speed_mps,) * vehicles


class Ranging(Section):
    """`[world.ranging]`: a sensor in each driven vehicle for the gap to the one ahead; without it there is none."""

    range_m: float = Field(150.0, gt=0, le=10_000)
    """Largest gap that is measured."""
    sigma_m: float = Field(0.1, ge=0, le=WILD_M)
    """Standard deviation of the gap: by default that of a radar for cars."""
    rate_sigma_mps: float = Field(0.1, ge=0, le=WILD_M)
    """Standard deviation of the gap's rate of change."""


def control_step_ns(control_hz: float) -> int:
    """Return the time between two control instants in nanoseconds."""
    return round(NS_PER_S / control_hz)
