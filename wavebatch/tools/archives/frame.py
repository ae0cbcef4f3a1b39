"""Coordinates of an imported strip: the CRS of its file, and longitude and latitude projected to UTM.

Packets need metres in all three directions, so pulses in degrees are projected: by the transverse Mercator projection
of GRS80 and WGS 84. Others stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from wavebatch.files.las.geo_keys import GeoKeys, build_utm
from wavebatch.files.las.header import GEOTIFF_ID, Vlr
from wavebatch.files.pulsewaves_file import PulsePiece, PulseReader

SCALE = 0.001
"""Largest unit of stored coordinates [m]: coarser ones would shift samples by as much."""
ROUND = 1000.0
"""Offsets of coordinates are multiples of this [m]."""

_NO_WKT = (
    "the CRS stays as GeoTIFF keys: it is no UTM zone that wavebatch writes as WKT, which programs expect in LAS 1.4: "
    "give them the CRS by hand"
)

_ZONES = {4326: 32600, 4979: 32600, 4258: 25800, 4269: 26900}
"""EPSG code of zone 0 north by the code of the geographic CRS."""


@dataclass(frozen=True, slots=True)
class Frame:
    """How coordinates of a file become those of a strip."""

    zone: int
    """UTM zone; 0: coordinates stay as they are."""
    south: bool
    scales: tuple[float, float, float]
    offsets: tuple[float, float, float]
    wkt: str | None
    records: tuple[Vlr, ...]
    """GeoTIFF keys that still hold."""
    notes: tuple[str, ...]

    def place(self, piece: PulsePiece) -> PulsePiece:
        """Return the piece with its pulses in the coordinates of the strip."""
        if not self.zone:
            return piece
        target = piece.anchor + 1000 * piece.direction
        anchor, target = (self._project(one) for one in (piece.anchor, target))
        return replace(piece, anchor=anchor, direction=(target - anchor) / 1000)

    def _project(self, xyz: np.ndarray) -> np.ndarray:
        east, north = project_utm(xyz[:, 0], xyz[:, 1], self.zone, south=self.south)
        return np.stack([east, north, xyz[:, 2]], axis=1)


def find_frame(reader: PulseReader) -> Frame:
    """Decide on the coordinates of a file from its GeoTIFF keys and its first pulse."""
    header = reader.header
    directory = next((vlr.payload for vlr in header.projection if vlr.record_id == GEOTIFF_ID), b"")
    keys = GeoKeys.parse(directory)
    first = next(iter(reader.pieces())).anchor[:1] if header.count else np.zeros((1, 3))
    zero = _ZONES.get(keys.code or 4326)
    if keys.kind == "geographic" and zero is not None:
        zone, south = find_utm_zone(float(first[0, 0])), bool(first[0, 1] < 0) and zero == 32600
        code = zero + zone + (100 if south else 0)
        note = f"coordinates are degrees; they are projected to UTM zone {zone}{'S' if south else 'N'} (EPSG:{code})"
        frame = Frame(zone, south, (SCALE,) * 3, (0.0,) * 3, build_utm(code), (), (note,))
        first = frame._project(first)
    else:
        code = keys.sure_code
        scales = tuple(min(abs(float(scale)), SCALE) for scale in header.scales)
        wkt = build_utm(code) if code else None
        notes = _note(keys) or (() if wkt else (_NO_WKT,))
        frame = Frame(0, False, scales, (0.0,) * 3, wkt, header.projection, notes)
    return replace(frame, offsets=tuple(float(value) for value in np.floor(first[0] / ROUND) * ROUND))


def _note(keys: GeoKeys) -> tuple[str, ...]:
    if keys.kind == "geocentric":
        return ("coordinates are geocentric and stay so: project the strip before steps that need heights",)
    if keys.kind == "geographic":
        return ("coordinates are degrees of a datum that wavebatch does not project; packets need metres",)
    return () if keys.keys else ("the file names no CRS",)


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
