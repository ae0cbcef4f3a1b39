"""Longitude and latitude to UTM, the transverse Mercator projection of GRS80 and WGS 84; `frame` uses it."""

from __future__ import annotations

import numpy as np

_AXIS, _FLATTENING = 6_378_137.0, 1 / 298.257222101
"""GRS80 [m]; WGS 84 differs by 0.1 mm."""
_SCALE, _EASTING, _NORTHING = 0.9996, 500_000.0, 10_000_000.0


def find_utm_zone(longitude: float) -> int:
    """Return the UTM zone, 1 to 60, of a longitude in degrees (-180 to 360)."""
    return int((longitude + 180) // 6) % 60 + 1


def project_utm(longitude: np.ndarray, latitude: np.ndarray, zone: int, *, south: bool) -> tuple[np.ndarray, ...]:
    """Return easting and northing in a UTM zone.

    Parameters
    ----------
    longitude, latitude : float64 (n,), degrees
    zone : int
    south : bool
        With the false northing of the southern hemisphere.

    Returns
    -------
    east, north : float64 (n,), m

    References
    ----------
    Karney (2011), Transverse Mercator with an accuracy of a few nanometers, J. Geodesy 85: Krueger's series, equations
    7 to 11 and 35, to the third order: 0.1 mm within 6 degrees of the central meridian.
    """
    n = _FLATTENING / (2 - _FLATTENING)
    eccentricity = np.sqrt(_FLATTENING * (2 - _FLATTENING))
    away = np.radians((longitude - (6 * zone - 183) + 180) % 360 - 180)
    # The poles themselves have no place in the series.
    sine = np.clip(np.sin(np.radians(latitude)), -1 + 1e-15, 1 - 1e-15)
    conformal = np.sinh(np.arctanh(sine) - eccentricity * np.arctanh(eccentricity * sine))
    xi = np.arctan2(conformal, np.cos(away))
    eta = np.arcsinh(np.sin(away) / np.hypot(conformal, np.cos(away)))
    alpha = (
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16,
        13 * n**2 / 48 - 3 * n**3 / 5,
        61 * n**3 / 240,
    )
    north, east = xi.copy(), eta.copy()
    for order, factor in enumerate(alpha, 1):
        north += factor * np.sin(2 * order * xi) * np.cosh(2 * order * eta)
        east += factor * np.cos(2 * order * xi) * np.sinh(2 * order * eta)
    radius = _SCALE * _AXIS / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    return _EASTING + radius * east, (_NORTHING if south else 0.0) + radius * north
