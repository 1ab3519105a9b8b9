"""`[network]` and `[map]`: which vehicles there are, where they are or how they drive, and on which roads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from emulator.scenario.driven import Driven
from emulator.scenario.limits import DAY_S, FAR_M, FAR_S, WILD_M
from emulator.scenario.program import Entry
from emulator.scenario.sections import Section
from emulator.scenario.sumo_loop import Sumo

OF_TRIPS = ("start_s", "max_vehicles", "disc", "origin_deg")
"""Keys of `[network]` for vehicles that move."""
NO_PATH = 'path is required with kind = "file", "trips" or "sumo", and only then'
Shift = Annotated[float, Field(ge=-FAR_M, le=FAR_M)]
OriginDeg = tuple[Annotated[float, Field(ge=-84, le=84)], Annotated[float, Field(ge=-180, le=180)]]


class Network(Section):
    """`[network]`: which vehicles there are and where they are, or how they drive."""

    kind: Literal["generated", "file", "trips", "sumo", "city", "driven", "own"] = "generated"
    """`generated` draws `vehicles` in a `layout`, `file` reads where they stand; `trips` reads how they drive,
    `sumo` has SUMO drive, and in a `city`, a generated one or that of `[map]`, `vehicles` drive anywhere; `driven`
    ones are driven by their programs. `own` ones are where a function of yours says; `FILE.py:function` or
    `module:function` in place of a kind is `own` with this `function`."""
    function: Entry | None = None
    """`own`: a function of seed, vehicles and duration_s that returns samples of each vehicle, by id."""
    path: Path | None = None
    """Relative to the scenario file. `file`: CSV with the columns id, x_m, y_m (east, north), heading_rad; `trips`:
    CSV, Parquet, NPZ, or SUMO's FCD (XML); `sumo`: a `.sumocfg`."""
    vehicles: int = Field(38, ge=1, le=10_000)
    """Number of generated vehicles; their ids are v01, v02, …, of 100 or more v001, v002, …"""
    layout: Literal["urban", "dense"] = "urban"
    """`urban` has the degrees and components of the published networks; `dense` packs all into 4.2 km by 4.2 km."""
    size_m: float = Field(3000.0, ge=1000, le=10_000)
    """Extent of the generated city, from one end to the other."""
    seed: int = Field(1, ge=0, lt=2**63)
    """Draws the generated network, the city and its traffic, or SUMO's traffic, and nothing of the run."""
    start_s: float | None = Field(None, ge=-FAR_S, le=FAR_S)
    """Trips: at which time of the file the run begins; at its first sample's, or SUMO's beginning, if left out."""
    max_vehicles: int | None = Field(None, ge=1, le=10_000)
    """Trips: no more than so many vehicles, those that enter first."""
    disc: tuple[float, float, Annotated[float, Field(gt=0, le=FAR_M)]] | None = None
    """Trips: vehicles are there only within this disc, x, y, radius in m."""
    origin_deg: OriginDeg | None = None
    """Trips in degrees: latitude and longitude of x = y = 0 m; the middle of the trips if left out."""
    fastest_mps: float = Field(70.0, gt=0, le=1000)
    """Trips: what is faster is a jump."""
    longest_gap_s: float = Field(10.0, gt=0, le=DAY_S)
    """Trips: so long without a sample a vehicle drives straight on; for longer it has left."""
    max_acceleration_mps2: float | None = Field(None, gt=0, le=FAR_M)
    """Trips: where a vehicle would need a greater acceleration, in the mean of half a second, it leaves, and enters
    again behind; such jumps are driven if left out. Vehicles reach 10."""
    impossible_trips: Literal["leave_out", "refuse"] = "leave_out"
    """Trips: a vehicle with many steps that no vehicle can make is left out, which one line says, or the run is
    refused. If most vehicles are so, units or ids are wrong, and the run is refused in any case."""

    step: bool = False
    """`sumo`: SUMO is stepped with the run, and programs drive their vehicles among its others; else it has driven
    all of them before the run begins."""

    driven: Driven | None = None
    """Road and dynamics of driven vehicles; `kind = "driven"` has them by default."""
    sumo: Sumo | None = None
    """Vehicles of SUMO that have programs; goes with `step`."""

    @property
    def moves(self) -> bool:
        """True if vehicles drive, enter and leave."""
        return self.kind in ("trips", "sumo", "city", "driven", "own")

    @property
    def programs_drive(self) -> bool:
        """True if programs drive their vehicles, so that the truth comes to be as the run goes on."""
        return self.kind == "driven" or self.step

    @model_validator(mode="before")
    @classmethod
    def _kind_may_be_a_function(cls, data: Any) -> Any:
        kind = data.get("kind") if isinstance(data, dict) else None
        if isinstance(kind, str) and (":" in kind or kind.endswith(".py")) and "function" not in data:
            return data | {"kind": "own", "function": kind}
        return data

    @model_validator(mode="after")
    def _keys_go_with_their_kind(self) -> Network:
        if (self.function is not None) != (self.kind == "own"):
            raise ValueError('function goes with kind = "own", and is required there')
        if (self.kind not in ("generated", "city", "driven", "own")) != (self.path is not None):
            raise ValueError(f'path is required with kind = "{self.kind}"' if self.path is None else NO_PATH)
        given = [name for name in OF_TRIPS if getattr(self, name) is not None]
        if given and self.kind not in ("trips", "sumo", "own"):
            raise ValueError(f'{given[0]} goes with kind = "trips" or "sumo", not with "{self.kind}"')
        if self.driven is not None and self.kind != "driven":
            raise ValueError(f'driven goes with kind = "driven", not with "{self.kind}"')
        if self.step and self.kind != "sumo":
            raise ValueError(f'step goes with kind = "sumo", not with "{self.kind}"')
        if self.sumo is not None and not self.step:
            raise ValueError("sumo goes with step = true")
        if self.step and self.disc is not None:
            raise ValueError("disc goes not with step = true: vehicles are there as long as SUMO has them")
        if self.sumo is not None and self.sumo.nodes is not None and self.max_vehicles is not None:
            raise ValueError("max_vehicles goes not with sumo.nodes, which names the vehicles")
        return self


class Map(Section):
    """`[map]`: the roads on which vehicles drive, as programs know them. Without it they know none."""

    path: Path
    """Relative to the scenario file: OpenStreetMap's XML or PBF, SUMO's `.net.xml`, GeoJSON or NPZ."""
    drive_on: Literal["right", "left"] = "right"
    """On which side of the road people drive."""
    origin_deg: OriginDeg | None = None
    """Latitude and longitude of x = y = 0 m, if the map is in degrees and the trips are not; else the trips'."""
    sigma_m: float = Field(0.0, ge=0, le=WILD_M)
    """Standard deviation by which true lanes stray from the map's: programs trust it no further."""
    aside_m: float = Field(0.0, ge=-FAR_M, le=FAR_M)
    """Mean distance of the driven line to the right of the map's lanes; negative: to the left."""
    datum_m: tuple[Shift, Shift] = (0.0, 0.0)
    """Shift of the map, east and north, before programs get it; `vnet map datum` finds it from trips."""
    datum_sigma_m: float = Field(0.0, ge=0, le=WILD_M)
    """Standard deviation in each axis by which the whole map may still be shifted. Nobody can tell that from the
    common error: programs add it to the covariances that they state, not to what they exchange."""
    margin_m: float = Field(300.0, ge=0, le=FAR_M)
    """Programs are given the roads within so much of the box in which vehicles drive."""
