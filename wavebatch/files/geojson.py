"""Polygons of a GeoJSON file, and the test which points lie inside.

Used for the areas of `wavebatch stats` and `run --polygon`, and for reference targets of the calibration. Coordinates
are those of the file: `area_crs` places them in a strip.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.files.area_crs import AreaFile, place_rings, read_area_file, read_crs_name
from wavebatch.files.las.header import LasHeader
from wavebatch.files.text_file import MOST_LIST, read_text

_WANTED = 'it needs "features", each with "properties", and a "geometry" with "type" and "coordinates"'

FARTHEST = 1e12
"""Largest coordinate of a corner; squares and products of larger ones overflow."""


@dataclass(frozen=True, slots=True, eq=False)
class Polygon:
    """An area with a name; several parts or holes give several rings."""

    name: str
    rings: tuple[np.ndarray, ...]
    """Corners of each ring, f8 (k, 2)."""
    file: AreaFile | None = None
    """Where its coordinates lie; None: in the strip's CRS."""

    def place(self, strip: Path, header: LasHeader) -> Polygon:
        """Return the polygon in the coordinates of a strip; raises as `area_crs.place_rings`."""
        return Polygon(self.name, tuple(place_rings(self.file, self.rings, strip, header)))


def find_inside(rings: Sequence[np.ndarray], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return which points lie inside an odd number of rings, so that a hole is a ring inside another.

    A point on the common border of two polygons lies in exactly one of them.

    Parameters
    ----------
    rings : sequence of f8 (k, 2), m
        Corners of each ring.
    x, y : f8 (n,), m
        Points; NaN lies in no polygon.

    Returns
    -------
    bool (n,)
    """
    corners = np.concatenate(rings)
    (left, low), (right, high) = corners.min(axis=0), corners.max(axis=0)
    near = np.flatnonzero((x >= left) & (x <= right) & (y >= low) & (y <= high))
    odd = np.zeros(len(near), bool)
    for ring in rings if len(near) else ():
        for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            if y0 != y1:
                crosses = (y0 > y[near]) != (y1 > y[near])
                odd ^= crosses & (x[near] < x0 + (y[near] - y0) * (x1 - x0) / (y1 - y0))
    inside = np.zeros(len(x), bool)
    inside[near] = odd
    return inside


def load_polygons(path: Path | str) -> list[Polygon]:
    """Return the polygons and multipolygons of a GeoJSON file, named by the property `name` or by their number.

    Raises ConfigError if the file cannot be read or holds anything else.
    """
    polygons = []
    features, file = read_features(read_text(path, "polygon file", MOST_LIST), path)
    for number, (properties, rings) in enumerate(features, 1):
        for ring in rings:
            if len(ring) < 3 or not (np.abs(ring) <= FARTHEST).all():
                raise ConfigError(f"{path}: polygon {number}: a ring needs three corners with finite coordinates")
        polygons.append(Polygon(str(properties.get("name") or number), tuple(rings), file))
    if not polygons:
        raise ConfigError(f"{path}: holds no polygon; give a GeoJSON FeatureCollection of polygons")
    return polygons


def read_features(text: str, path: Path | str) -> tuple[list[tuple[dict[str, Any], list[np.ndarray]]], AreaFile]:
    """Return properties and rings, f8 (k, 2) each, of all features of a GeoJSON document, and where these lie.

    path: name for messages. Raises ConfigError for anything else than polygons.
    """
    try:
        document = json.loads(text)
        if isinstance(document, dict) and document.get("type") in ("Polygon", "MultiPolygon"):
            document = {"features": [{"geometry": document}]}
        elif isinstance(document, dict) and document.get("type") == "Feature":
            document = {"features": [document]}
        listed = document["features"]
        listed = list(listed.values()) if isinstance(listed, dict) else list(listed)
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise ConfigError(f"{path}: not GeoJSON with a list of polygons: no JSON at {where}") from error
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not GeoJSON with a list of polygons: {_WANTED}") from error
    features = [_read_feature(feature, f"{path}: feature {number}") for number, feature in enumerate(listed, 1)]
    rings = [ring for _, rings in features for ring in rings]
    return features, read_area_file(path, _find_member(document, listed, path), rings)


def _find_member(document: dict[str, Any], listed: Sequence[dict[str, Any]], path: Path | str) -> Any:
    """The value of the member `crs` of a document; None without one.

    GDAL and QGIS write it into the document, PostGIS into each geometry. The innermost one of an area counts; they must
    be the same for all.
    """
    found: dict[str | None, Any] = {}
    for feature in listed:
        levels = (feature["geometry"].get("crs"), feature.get("crs"), document.get("crs"))
        member = next((level for level in levels if level is not None), None)
        found[read_crs_name(path, member)] = member
    if len(found) > 1:
        names = ", ".join("none" if name is None else name[:40] for name in list(found)[:3])
        raise ConfigError(f"{path}: its areas name more than one CRS ({names}); write one file for each")
    return next(iter(found.values()), document.get("crs"))


def _read_feature(feature: Any, where: str) -> tuple[dict[str, Any], list[np.ndarray]]:
    try:
        shape, properties = feature["geometry"], dict(feature.get("properties") or {})
        kind, parts = shape["type"], shape["coordinates"]
        if kind not in ("Polygon", "MultiPolygon"):
            raise ConfigError(f"{where} is a {str(kind)[:40]}; give polygons only")
        parts = [parts] if kind == "Polygon" else parts
        rings = [np.array([[float(x), float(y)] for x, y, *_ in ring]) for part in parts for ring in part]
    except ConfigError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise ConfigError(f"{where}: not GeoJSON of a polygon: {_WANTED}") from error
    if not rings or not all(len(ring) for ring in rings):
        raise ConfigError(f"{where}: a {kind} has no ring, or a ring has no corner")
    return properties, rings
