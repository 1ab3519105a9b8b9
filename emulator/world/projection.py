"""WGS-84 to the local east-north frame of a run: a transverse Mercator whose zero is a stated origin.

It is conformal, so that headings are kept, and within 50 km of its origin true to scale within 3 in 100 000.
"""

from __future__ import annotations

import numpy as np

from vnet.roads.lanes import Array


def middle_deg(latitude_deg: Array, longitude_deg: Array) -> tuple[float, float]:
    """The middle of the box that holds these points, as (latitude, longitude) in degrees."""
    low_lat, high_lat = float(latitude_deg.min()), float(latitude_deg.max())
    low_lon, high_lon = float(longitude_deg.min()), float(longitude_deg.max())
    return (low_lat + high_lat) / 2, (low_lon + high_lon) / 2


def to_local_m(latitude_deg: Array, longitude_deg: Array, origin_deg: tuple[float, float]) -> Array:
    """Points (n,) in degrees as (n, 2) metres east and north of the origin (latitude, longitude)."""
    from pyproj import Transformer  # slow to import, and only points in degrees need it

    latitude, longitude = origin_deg
    plane = f"+proj=tmerc +lat_0={latitude!r} +lon_0={longitude!r} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m"
    transformer = Transformer.from_crs("EPSG:4326", plane, always_xy=True)
    east_m, north_m = transformer.transform(longitude_deg, latitude_deg)
    return np.column_stack([east_m, north_m])
