"""The CRS of GeoJSON that is written: WGS 84, which is all that the standard (RFC 7946) knows, or that of the strip.

`wavebatch slice` writes with it. Heights stay those of the strip: only pyproj's grids could change their datum.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.optional import need
from wavebatch.files.las.crs import find_epsg
from wavebatch.files.wkt import drop_empty_codes

GEOJSON_CRS = ("wgs84", "keep")
"""Values of --geojson-crs."""

_DEGREES, _METRES = 9, 4
"""Decimals of coordinates: a tenth of a millimetre."""


@dataclass(frozen=True, slots=True)
class GeoJsonCrs:
    """How points of a strip are written."""

    member: dict[str, Any] | None
    """Value of the member `crs` of the file; None for none."""
    project: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]] | None
    """Longitude and latitude of x and y; None: coordinates stay as they are."""

    def place(self, points: np.ndarray) -> list[list[float]]:
        """Return coordinates of points (n, 3) as they are written."""
        points = np.array(points, np.float64)
        if self.project is not None:
            points[:, 0], points[:, 1] = self.project(points[:, 0], points[:, 1])
        decimals = _METRES if self.project is None else _DEGREES
        return [[round(x, decimals), round(y, decimals), round(z, _METRES)] for x, y, z in points.tolist()]


def plan_crs(path: Path, crs: str | None, mode: str) -> GeoJsonCrs:
    """Return how points of a strip are written as GeoJSON.

    path: of the strip, for messages. crs: from `read_crs_definition`. mode: one of GEOJSON_CRS.
    Raises InputError for a strip whose CRS is missing or unknown, ConfigError without pyproj.
    """
    if mode not in GEOJSON_CRS:
        raise ConfigError(f"geojson_crs {mode!r}: must be one of {', '.join(GEOJSON_CRS)}")
    if mode == "keep":
        return GeoJsonCrs(None if crs is None else _name(crs), None)
    if crs is None:
        raise InputError(
            f"{path}: has no CRS, so its points have no longitude and latitude, which GeoJSON needs; write .csv, or "
            "--geojson-crs keep for the coordinates of the strip"
        )
    pyproj = need("pyproj", lambda advice: ConfigError(
        f"{path}: GeoJSON in WGS 84 needs pyproj: {advice}; or write .csv, or --geojson-crs keep for the coordinates "
        "of the strip"
    ))  # fmt: skip
    try:
        source = pyproj.CRS.from_user_input(crs)
        transformer = pyproj.Transformer.from_crs(source.to_2d(), "EPSG:4326", always_xy=True)
    except pyproj.exceptions.ProjError as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: its CRS is not understood ({reason}); write --geojson-crs keep") from error
    return GeoJsonCrs(None, transformer.transform)


def _name(crs: str) -> dict[str, Any]:
    """The member `crs` of GeoJSON 2008, which GDAL and QGIS read: an EPSG code, or else the WKT."""
    short = re.fullmatch(r"EPSG:(\d+)", crs)
    code = int(short[1]) if short else find_epsg(crs)
    name = f"urn:ogc:def:crs:EPSG::{code}" if code else drop_empty_codes(crs)
    return {"type": "name", "properties": {"name": name}}
