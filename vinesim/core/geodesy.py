"""Positions on the Earth: from a local tangent plane (x east, y north, z up) to WGS 84 and back, exactly.

Formulas: IOGP guidance note 7-2, sections 4.1.1 (geographic to geocentric) and 4.1.2 (geocentric to topocentric).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

SEMI_MAJOR = 6378137.0
"""Semi-major axis of WGS 84 [m]."""
FLATTENING = 1.0 / 298.257223563
"""Flattening of WGS 84 [1]."""
_ECCENTRICITY = FLATTENING * (2.0 - FLATTENING)
"""Square of the first eccentricity of WGS 84 [1]."""
_ITERATIONS = 6
"""Number of iterations for the latitude. Each divides the error by more than a hundred near the ground."""


class Geodetic(NamedTuple):
    """A position on WGS 84."""

    latitude: float
    """Latitude [deg], positive to the north."""
    longitude: float
    """Longitude [deg], positive to the east."""
    altitude: float
    """Height above the ellipsoid [m]."""


APRILIA = Geodetic(41.6, 12.65, 80.0)
"""Near Aprilia, Italy, where CANOPIES picks: the datum of scenes that have none. A round figure, not a vineyard."""


def geocentric(place: Geodetic) -> np.ndarray:
    """Returns the geocentric coordinates [3] m of a position."""
    latitude, longitude = np.radians(place.latitude), np.radians(place.longitude)
    normal = SEMI_MAJOR / np.sqrt(1.0 - _ECCENTRICITY * np.sin(latitude) ** 2)
    level = (normal + place.altitude) * np.cos(latitude)
    up = (normal * (1.0 - _ECCENTRICITY) + place.altitude) * np.sin(latitude)
    return np.array([level * np.cos(longitude), level * np.sin(longitude), up])


def geodetic(position: np.ndarray) -> Geodetic:
    """Returns the position with the geocentric coordinates ``position`` [3] m, which must not be near the Earth's
    centre."""
    x, y, z = position
    level = np.hypot(x, y)
    latitude = np.arctan2(z, level * (1.0 - _ECCENTRICITY))
    normal = SEMI_MAJOR
    for _ in range(_ITERATIONS):
        normal = SEMI_MAJOR / np.sqrt(1.0 - _ECCENTRICITY * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + _ECCENTRICITY * normal * np.sin(latitude), level)
    # of the two usual formulas, this one also holds at the poles
    altitude = level * np.cos(latitude) + z * np.sin(latitude) - SEMI_MAJOR**2 / normal
    return Geodetic(float(np.degrees(latitude)), float(np.degrees(np.arctan2(y, x))), float(altitude))


def _axes(datum: Geodetic) -> np.ndarray:
    """Returns the axes east, north and up of the tangent plane at ``datum`` as rows [3, 3], in geocentric axes."""
    latitude, longitude = np.radians(datum.latitude), np.radians(datum.longitude)
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def from_local(local: np.ndarray, datum: Geodetic) -> Geodetic:
    """Returns the position at ``local`` [3] m, east, north and up of the ``datum``."""
    return geodetic(geocentric(datum) + np.asarray(local, float) @ _axes(datum))


def to_local(place: Geodetic, datum: Geodetic) -> np.ndarray:
    """Returns a position as [3] m, east, north and up of the ``datum``."""
    return _axes(datum) @ (geocentric(place) - geocentric(datum))
