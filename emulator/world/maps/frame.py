"""Where a map's local east-north metres are on the earth, by pyproj."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from vnet.errors import ScenarioError, printable
from vnet.roads.lanes import Array

if TYPE_CHECKING:
    from pyproj import Transformer

WIDEST_M = 1_000_000.0
"""A map may span so much. A file that spans more mixes projections, or has points at 0°, 0°."""
_PROJ = re.compile(r"(\+[a-z_0-9]+(=[A-Za-z0-9_.+-]*)?\s*)+")
_LONGEST_PROJ = 1000


@dataclass(frozen=True)
class Frame:
    """Local metres are what the projection `proj` (as PROJ writes it) gives, plus `offset_m`."""

    proj: str
    offset_m: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def around(cls, lat_deg: float, lon_deg: float) -> Frame:
        """Metres east and north of a point, true to distance from it (azimuthal equidistant)."""
        return cls(f"+proj=aeqd +lat_0={lat_deg!r} +lon_0={lon_deg!r} +datum=WGS84 +units=m +no_defs")

    @cached_property
    def _transformer(self) -> Transformer:
        try:
            from pyproj import Transformer
            from pyproj.exceptions import ProjError
        except ImportError:
            raise ScenarioError(
                "positions in degrees need pyproj, which is not installed: pip install 'vnet-emulator[maps]'"
            ) from None
        if len(self.proj) > _LONGEST_PROJ or not _PROJ.fullmatch(self.proj):
            raise ScenarioError(f"projection {printable(self.proj)}: not one that PROJ knows")
        try:
            return Transformer.from_crs("OGC:CRS84", self.proj, always_xy=True)
        except ProjError:
            raise ScenarioError(f"projection {printable(self.proj)}: not one that PROJ knows") from None

    def to_local(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> Array:
        """Metres (…, 2) of positions in WGS-84 degrees (…). Raises ScenarioError without pyproj."""
        x, y = self._transformer.transform(np.asarray(lon_deg, dtype=float), np.asarray(lat_deg, dtype=float))
        return np.stack([x, y], axis=-1) + self.offset_m

    def to_wgs84(self, position_m: Array) -> tuple[Array, Array]:
        """Latitudes and longitudes (…) in degrees of metres (…, 2). Raises ScenarioError without pyproj."""
        x, y = np.moveaxis(np.asarray(position_m, dtype=float) - self.offset_m, -1, 0)
        lon, lat = self._transformer.transform(x, y, direction="INVERSE")
        return np.asarray(lat), np.asarray(lon)


def frame_around(lat_deg: Array, lon_deg: Array) -> Frame:
    """The frame around the middle of some positions (n,)."""
    return Frame.around(float(lat_deg.min() + lat_deg.max()) / 2, float(lon_deg.min() + lon_deg.max()) / 2)
