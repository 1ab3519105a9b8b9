"""WGS-84 and the local east-north metres of runs and maps: a transverse Mercator whose zero is a stated origin.

It is conformal, so that headings are kept, and within 50 km of its origin true to scale within 3 in 100 000. Maps
in another projection (SUMO's) keep it, and say which one it is.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from vnet.errors import ScenarioError, printable
from vnet.types import Array

if TYPE_CHECKING:
    from pyproj import Transformer

WIDEST_M = 200_000.0
"""How far from its origin the plane of metres is used for points in degrees."""
_PROJ = re.compile(r"(\+[a-z_0-9]+(=[A-Za-z0-9_.+-]*)?\s*)+")
_LONGEST_PROJ = 1000


@dataclass(frozen=True)
class Frame:
    """Where metres are on the earth: what the projection `proj` (as PROJ writes it) gives, plus `offset_m`."""

    proj: str
    offset_m: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def around(cls, latitude_deg: float, longitude_deg: float) -> Frame:
        """Metres east and north of an origin."""
        return cls(
            f"+proj=tmerc +lat_0={latitude_deg!r} +lon_0={longitude_deg!r} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m"
        )

    @classmethod
    def named(cls, proj: str, offset_m: tuple[float, float]) -> Frame:
        """A frame that a file states. Raises ScenarioError unless PROJ knows it, and it is in metres."""
        frame = cls(proj, offset_m)
        target = frame._transformer.target_crs
        if target is None or any(axis.unit_name != "metre" for axis in target.axis_info):
            raise ScenarioError(f"projection {printable(proj)}: not in metres")
        return frame

    @cached_property
    def _transformer(self) -> Transformer:
        from pyproj import Transformer  # slow to import, and only points in degrees need it
        from pyproj.exceptions import ProjError

        if len(self.proj) > _LONGEST_PROJ or not _PROJ.fullmatch(self.proj):
            raise ScenarioError(f"projection {printable(self.proj)}: not one that PROJ knows")
        try:
            return Transformer.from_crs("EPSG:4326", self.proj, always_xy=True)
        except ProjError:
            raise ScenarioError(f"projection {printable(self.proj)}: not one that PROJ knows") from None

    def to_local(self, latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> Array:
        """Metres (…, 2) of points in WGS-84 degrees (…); infinite where the projection does not reach."""
        longitude, latitude = np.asarray(longitude_deg, dtype=float), np.asarray(latitude_deg, dtype=float)
        east_m, north_m = self._transformer.transform(longitude, latitude)
        position_m = np.stack([east_m, north_m], axis=-1)
        return position_m + self.offset_m if any(self.offset_m) else position_m

    def to_wgs84(self, position_m: Array) -> tuple[Array, Array]:
        """Latitudes and longitudes (…) in degrees of metres (…, 2)."""
        east_m, north_m = np.moveaxis(np.asarray(position_m, dtype=float) - self.offset_m, -1, 0)
        longitude, latitude = self._transformer.transform(east_m, north_m, direction="INVERSE")
        return np.asarray(latitude), np.asarray(longitude)


def project(
    source: object,
    latitude_deg: Array,
    longitude_deg: Array,
    origin_deg: tuple[float, float] | None,
    name: Callable[[int], str] | None = None,
) -> tuple[Frame, Array]:
    """Points (n,), one at least, in degrees as metres (n, 2), and the frame around `origin_deg`, else their middle.

    Raises ScenarioError where they are further than `WIDEST_M` from there: it names `source`, and what `name` says
    of the point that is off most others.
    """
    origin = origin_deg or middle_deg(latitude_deg, longitude_deg)
    frame = Frame.around(*origin)
    position_m = frame.to_local(latitude_deg, longitude_deg)
    farthest_m = float(np.abs(position_m).max())
    if not farthest_m <= WIDEST_M:
        where = f"{name(most_off(np.column_stack([latitude_deg, longitude_deg])))}: " if name else ""
        raise ScenarioError(
            f"{source}: {where}{farthest_m / 1000:,.0f} km from the origin {origin[0]:.4f}, {origin[1]:.4f}: "
            f"at most {WIDEST_M / 1000:g} km; are latitudes and longitudes what they should be?"
        )
    return frame, position_m


def middle_deg(latitude_deg: Array, longitude_deg: Array) -> tuple[float, float]:
    """The middle of the box that holds these points (n,), one at least."""
    return _middle(latitude_deg), _middle(longitude_deg)


def most_off(place: Array) -> int:
    """Which of some places (n, 2) is the furthest from the middle one."""
    return int(np.abs(place - np.median(place, axis=0)).max(axis=1).argmax())


def _middle(values: Array) -> float:
    return (float(values.min()) + float(values.max())) / 2
