"""WGS-84 and the local east-north metres of runs and maps: a transverse Mercator projection around an origin.

It is conformal, so headings are preserved; within 50 km of its origin its scale error is at most 3 in 100 000. Maps
in another projection (SUMO's) keep theirs, and state it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from vnet.errors import ScenarioError, printable
from vnet.extras import require
from vnet.types import Array

if TYPE_CHECKING:
    from pyproj import Transformer

MAX_FROM_ORIGIN_M = 200_000.0
"""Greatest distance from the origin at which points in degrees are projected."""
_PROJ = re.compile(r"(\+[a-z_0-9]+(=[A-Za-z0-9_.+-]*)?\s*)+|EPSG:\d{4,6}")
_LONGEST_PROJ = 1000
"""Characters of a projection's definition."""


@dataclass(frozen=True)
class CoordinateFrame:
    """A coordinate frame in metres: the projection `proj` (a PROJ definition), plus `offset_m`."""

    proj: str
    offset_m: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def around(cls, latitude_deg: float, longitude_deg: float) -> CoordinateFrame:
        """Return the frame of metres east and north of an origin."""
        return cls(
            f"+proj=tmerc +lat_0={latitude_deg!r} +lon_0={longitude_deg!r} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m"
        )

    @classmethod
    def named(cls, proj: str, offset_m: tuple[float, float]) -> CoordinateFrame:
        """Return the frame that a file states. Raise ScenarioError unless PROJ knows it, and it is in metres."""
        frame = cls(proj, offset_m)
        target = frame._transformer.target_crs
        if target is None or [axis.unit_name for axis in target.axis_info] != ["metre"] * 2:
            raise ScenarioError(f"projection {printable(proj)}: not of two axes in metres")
        return frame

    @cached_property
    def _transformer(self) -> Transformer:
        require("a place in degrees", "pyproj", error=ScenarioError)
        from pyproj import Transformer  # slow to import, and only points in degrees need it
        from pyproj.exceptions import ProjError

        if len(self.proj) <= _LONGEST_PROJ and _PROJ.fullmatch(self.proj):
            with suppress(ProjError):
                return Transformer.from_crs("EPSG:4326", self.proj, always_xy=True)
        raise ScenarioError(f"projection {printable(self.proj)}: not one that PROJ knows")

    def to_local(self, latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> Array:
        """Return metres (…, 2) of points in WGS-84 degrees (…); infinite outside the projection."""
        longitude, latitude = np.asarray(longitude_deg, dtype=float), np.asarray(latitude_deg, dtype=float)
        east_m, north_m = self._transformer.transform(longitude, latitude)
        position_m = np.stack([east_m, north_m], axis=-1)
        return position_m + self.offset_m if any(self.offset_m) else position_m

    def to_wgs84(self, position_m: Array) -> tuple[Array, Array]:
        """Return latitudes and longitudes (…) in degrees of points in metres (…, 2)."""
        east_m, north_m = np.moveaxis(np.asarray(position_m, dtype=float) - self.offset_m, -1, 0)
        longitude, latitude = self._transformer.transform(east_m, north_m, direction="INVERSE")
        return np.asarray(latitude), np.asarray(longitude)


def project(
    source: object,
    latitude_deg: Array,
    longitude_deg: Array,
    origin_deg: tuple[float, float] | None,
    name: Callable[[int], str] | None = None,
) -> tuple[CoordinateFrame, Array]:
    """Return the frame around `origin_deg`, or around the points' centre, and the points (n, 2) in metres.

    Points (n,) are in degrees; there is at least one. Raise ScenarioError if one is further than
    `MAX_FROM_ORIGIN_M` from the origin; it names `source`, and `name` of the greatest outlier.
    """
    origin = origin_deg or middle_deg(latitude_deg, longitude_deg)
    frame = CoordinateFrame.around(*origin)
    position_m = frame.to_local(latitude_deg, longitude_deg)
    farthest_m = float(np.abs(position_m).max())
    if not farthest_m <= MAX_FROM_ORIGIN_M:
        where = f"{name(outlier_index(np.column_stack([latitude_deg, longitude_deg])))}: " if name else ""
        raise ScenarioError(
            f"{source}: {where}{farthest_m / 1000:,.0f} km from the origin {origin[0]:.4f}, {origin[1]:.4f}: "
            f"at most {MAX_FROM_ORIGIN_M / 1000:g} km allowed; check latitudes and longitudes"
        )
    return frame, position_m


def middle_deg(latitude_deg: Array, longitude_deg: Array) -> tuple[float, float]:
    """Return the centre of the bounding box of these points (n,), of which there is at least one.

    Where longitudes are more than half of the earth apart, the box lies across the antimeridian.
    """
    if np.ptp(longitude_deg) > 180.0:
        middle = _middle(np.mod(longitude_deg, 360.0))
        return _middle(latitude_deg), middle - 360.0 if middle > 180.0 else middle
    return _middle(latitude_deg), _middle(longitude_deg)


def outlier_index(point: Array) -> int:
    """Return the index of the point (n, 2) that is furthest from the median."""
    return int(np.abs(point - np.median(point, axis=0)).max(axis=1).argmax())


def _middle(values: Array) -> float:
    return (float(values.min()) + float(values.max())) / 2
