"""Latitude, longitude and altitude as metres in the local tangent plane (east, north, up) at the first of them.

By WGS 84: to cartesian coordinates that turn with the earth, then turned at the first place.
"""

from typing import Final

import numpy as np

from bufgym.traces.trace import Float64Array

_RADIUS_M: Final = 6_378_137.0  # at the equator
_SQUARED_ECCENTRICITY: Final = 6.69437999014e-3


def local_plane(places: Float64Array) -> Float64Array:
    """East, north and up of float64[n, 3] of latitude and longitude, degrees, and altitude, m."""
    latitude, longitude = np.radians(places[:, 0]), np.radians(places[:, 1])
    curvature_m = _RADIUS_M / np.sqrt(1 - _SQUARED_ECCENTRICITY * np.sin(latitude) ** 2)
    level_m = (curvature_m + places[:, 2]) * np.cos(latitude)
    north_m = (curvature_m * (1 - _SQUARED_ECCENTRICITY) + places[:, 2]) * np.sin(latitude)
    cartesian = np.stack([level_m * np.cos(longitude), level_m * np.sin(longitude), north_m], axis=1)
    (sin_lat, sin_lon), (cos_lat, cos_lon) = ((f(latitude[0]), f(longitude[0])) for f in (np.sin, np.cos))
    turn = np.array(
        [
            [-sin_lon, cos_lon, 0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
    return np.asarray((cartesian - cartesian[0]) @ turn.T, np.float64)
