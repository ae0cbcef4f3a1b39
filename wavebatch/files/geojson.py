"""Polygons of a GeoJSON file, and the test which points lie inside.

Used for the areas of `wavebatch stats` and for reference targets of the calibration. Coordinates are those of the
clouds; nothing is projected.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.files.text_file import read_text


@dataclass(frozen=True, slots=True, eq=False)
class Polygon:
    """An area with a name; several parts or holes give several rings."""

    name: str
    rings: tuple[np.ndarray, ...]
    """Corners of each ring, f8 (k, 2)."""


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
    for number, (properties, rings) in enumerate(read_features(read_text(path, "polygon file", 1 << 30), path), 1):
        for ring in rings:
            if len(ring) < 3 or not np.isfinite(ring).all():
                raise ConfigError(f"{path}: polygon {number}: a ring needs three corners with finite coordinates")
        polygons.append(Polygon(str(properties.get("name") or number), tuple(rings)))
    if not polygons:
        raise ConfigError(f"{path}: holds no polygon; give a GeoJSON FeatureCollection of polygons")
    return polygons


def read_features(text: str, path: Path | str) -> list[tuple[dict[str, Any], list[np.ndarray]]]:
    """Return properties and rings, f8 (k, 2) each, of all features of a GeoJSON document.

    path: name for messages. Raises ConfigError for anything else than polygons.
    """
    try:
        features = []
        for feature in json.loads(text)["features"]:
            shape = feature["geometry"]
            if shape["type"] not in ("Polygon", "MultiPolygon"):
                raise ConfigError(f"{path}: a feature is a {shape['type']}; give polygons only")
            parts = [shape["coordinates"]] if shape["type"] == "Polygon" else shape["coordinates"]
            rings = [np.array([[float(x), float(y)] for x, y, *_ in ring]) for part in parts for ring in part]
            if not rings:
                raise ConfigError(f"{path}: a {shape['type']} has no ring")
            features.append((dict(feature.get("properties") or {}), rings))
    except (json.JSONDecodeError, KeyError, TypeError, ValueError, IndexError, AttributeError, RecursionError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{path}: not GeoJSON with a list of polygons: {type(error).__name__}: {error}") from error
    return features
