"""Polygons of GeoJSON files, their place in a strip, and the CRS of GeoJSON that is written.

`run --polygon`, `stats --polygon` and `calibrate --targets` read areas here and place them with `place_rings`, once per
strip; `wavebatch slice` writes with `plan_crs`. The standard of GeoJSON (RFC 7946) knows longitude and latitude in
WGS 84 only. Files of GDAL, QGIS and wavebatch with another CRS name it in the member `crs`; others, which have
coordinates of the strip and do not say so, are known by where they lie. Before you change it: areas in the wrong place
are worse than none. Coordinates that name another CRS are projected or refused, never used as they are. Heights that
are written stay those of the strip: only pyproj's grids could change their datum.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import ConfigError, InputError, need
from wavebatch.core.frozen import frozen
from wavebatch.files.las.crs import CrsUnits, drop_empty_codes, find_epsg, parse_wkt, read_crs_definition
from wavebatch.files.las.header import LasHeader
from wavebatch.files.text_file import MOST_LIST, read_text

WGS84 = "OGC:CRS84"
"""Longitude and latitude, in this order."""

_SAME_DEGREES = (WGS84, "EPSG:4326")
"""Names of WGS 84 in files of GIS: x is the longitude in all of them."""

_LONGEST_NAME = 80
"""Most characters of a CRS in a message."""

_STEP = 100.0
"""Longest edge that is projected as one [m]: a straight line of degrees bends by less than a millimetre over it."""

_MOST_PIECES = 10_000
"""Most parts of an edge."""

_METRES_PER_DEGREE = 111_320.0

_LONGEST_STRIP = 150_000.0
"""Longest side of a strip whose extent is believed: one point at the origin makes that of a UTM zone longer."""

_CODE = (
    r"(?i)urn:(?:x-)?ogc:def:crs:(\w+):[^:]*:(\w+)|https?://www\.opengis\.net/def/crs/(\w+)/[^/]*/(\w+)|"
    r"(EPSG|OGC):(\w+)"
)
"""A CRS by its code as GDAL, QGIS and OGC write it: as a URN, as an address, or EPSG:n."""


@frozen
class AreaFile:
    """How the coordinates of a file of areas are meant."""

    path: str
    crs: str | None
    """That of the member `crs`; None: the file has none."""
    extent: tuple[float, float, float, float] | None
    """West, south, east and north of all its corners, also of those of other areas; None: it has none."""


def read_area_file(path: Path | str, member: Any, rings: Sequence[np.ndarray]) -> AreaFile:
    """Describe a file of areas.

    member: value of the member `crs` of the file, None without. rings: all corners, f8 (k, 2) each.
    Raises ConfigError for a member that gives no name.
    """
    return AreaFile(str(path), read_crs_name(path, member), _bound(rings))


def read_crs_name(path: Path | str, member: Any) -> str | None:
    """Return the name of a CRS in the member `crs` of GeoJSON, `EPSG:n` where it is a code; None without the member.

    path: for messages. Raises ConfigError for a member that gives no name.
    """
    if member is None:
        return None
    try:
        name = str(member["properties"]["name"]).strip()
    except (KeyError, TypeError) as error:
        raise ConfigError(f"{path}: its member crs has no name; write it in WGS 84, without that member") from error
    found = re.fullmatch(_CODE, name)
    return ":".join(part.upper() for part in found.groups() if part) if found else name


def place_rings(file: AreaFile | None, rings: Sequence[np.ndarray], strip: Path, header: LasHeader) -> list[np.ndarray]:
    """Return the rings in the coordinates of a strip.

    Rings are projected where the file names another CRS than that of the strip, or where its corners can only be
    degrees. Edges get more corners where they are long.

    Parameters
    ----------
    file : AreaFile or None
        None: the rings are in the coordinates of the strip.
    rings : sequence of f8 (k, 2)
    strip : Path
    header : LasHeader
        Of the strip.

    Returns
    -------
    list of f8 (k, 2)

    Raises
    ------
    InputError
        Where the strip has no CRS, or the areas cannot be placed in it.
    ConfigError
        Without pyproj.
    """
    rings = [np.asarray(ring, np.float64) for ring in rings]
    if file is None or not rings:
        return rings
    source = file.crs
    west, south, east, north = file.extent or (0.0, 0.0, 0.0, 0.0)
    maybe_degrees = west >= -180 and south >= -90 and east <= 180 and north <= 90
    if source is None:
        # Areas of a file without a CRS that lie in the strip are in its coordinates, be they small ones: the strip may
        # have a local grid. All areas of a file are in the same CRS, so its whole extent counts.
        sides = [high - low for low, high in zip(header.mins[:2], header.maxs[:2], strict=True)]
        inside = file.extent is not None and max(sides) <= _LONGEST_STRIP and _overlaps(file.extent, header)
        # Degrees fit a strip that is in degrees itself, or in local metres near the origin.
        values = [*header.mins[:2], *header.maxs[:2]]
        fits = all(abs(value) <= most for value, most in zip(values, (180, 90, 180, 90), strict=True))
        if not maybe_degrees or inside or fits:
            return rings
        source = WGS84
    definition = read_crs_definition(strip, header)
    if definition is None:
        if not maybe_degrees:
            return rings  # nothing says that the CRS is not the strip's
        what = f"in degrees ({source})" if source in _SAME_DEGREES else f"in {source[:_LONGEST_NAME]}"
        raise InputError(
            f"{file.path}: is {what}, and {strip} has no CRS to project it into; write it in the coordinates of the "
            "strip, without a member crs"
        )
    # `EPSG:n` of a definition that names a projected CRS by its code.
    number = find_epsg(definition)
    other = f"EPSG:{number}" if number and parse_wkt(definition) != CrsUnits() else ""
    other = definition if definition.startswith("EPSG:") else other
    code = other or definition
    if source in (definition, code) or (source in _SAME_DEGREES and code in _SAME_DEGREES):
        return rings
    stated = f"is in {other}" if other else "does not name its CRS by a code"
    pyproj = need("pyproj", lambda advice: ConfigError(
        f"{file.path}: is in {source[:_LONGEST_NAME]}, and {strip} {stated}; projecting it needs pyproj: {advice}; or "
        "write it in the coordinates of the strip, without a member crs"
    ))  # fmt: skip
    try:
        target = pyproj.CRS.from_user_input(definition).to_2d()
        transformer = pyproj.Transformer.from_crs(pyproj.CRS.from_user_input(source).to_2d(), target, always_xy=True)
        step = _STEP / _METRES_PER_DEGREE if transformer.source_crs.is_geographic else math.inf
        placed = [np.stack(transformer.transform(*_densify(ring, step).T), axis=1) for ring in rings]
    except pyproj.exceptions.ProjError as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{file.path}: cannot be projected into the CRS of {strip} ({reason})") from error
    if not all(np.isfinite(ring).all() for ring in placed):
        raise InputError(
            f"{file.path}: has corners that have no place in the CRS of {strip}; cut the areas to the flight"
        )
    return placed


def describe_miss(rings: Sequence[np.ndarray], header: LasHeader) -> str:
    """Say, with both extents, that all rings lie outside a strip by its header; empty where they do not."""
    extent = _bound(rings)
    (west, south, _), (east, north, _) = header.mins, header.maxs
    if extent is None or not all(map(math.isfinite, (west, south, east, north))) or _overlaps(extent, header):
        return ""
    left, low, right, high = extent
    return (
        f"the area (x {left:.10g} to {right:.10g}, y {low:.10g} to {high:.10g}) lies outside the strip, which by its "
        f"header has x {west:.10g} to {east:.10g}, y {south:.10g} to {north:.10g}; is it in another CRS?"
    )


def _bound(rings: Sequence[np.ndarray]) -> tuple[float, float, float, float] | None:
    """West, south, east and north of all rings; None without a corner."""
    corners = np.concatenate([*rings, np.zeros((0, 2))])
    return (*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist()) if len(corners) else None


def _overlaps(extent: tuple[float, float, float, float], header: LasHeader) -> bool:
    """Whether an extent and that of a strip by its header have a point in common."""
    (west, south, _), (east, north, _) = header.mins, header.maxs
    left, low, right, high = extent
    return left <= east and right >= west and low <= north and high >= south


def _densify(ring: np.ndarray, step: float) -> np.ndarray:
    """The ring with more corners, at most `step` apart; an edge gets the same ones in either direction."""
    if not math.isfinite(step):
        return ring
    parts = []
    for one, other in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        number = min(max(math.ceil(float(np.abs(other - one).max()) / step), 1), _MOST_PIECES)
        low, high = (one, other) if tuple(one) <= tuple(other) else (other, one)
        rank = np.arange(number)[:, None]
        share = (rank if low is one else number - rank) / number
        part = low + share * (high - low)
        part[0] = one
        parts.append(part)
    return np.concatenate(parts)


GEOJSON_CRS = ("wgs84", "keep")
"""Values of --geojson-crs."""

_DEGREES, _METRES = 9, 4
"""Decimals of coordinates: a tenth of a millimetre."""


@frozen
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
    if mode == "keep":
        if crs is None:
            return GeoJsonCrs(None, None)
        # The member `crs` of GeoJSON 2008, which GDAL and QGIS read: an EPSG code, or else the WKT.
        short = re.fullmatch(r"EPSG:(\d+)", crs)
        code = int(short[1]) if short else find_epsg(crs)
        name = f"urn:ogc:def:crs:EPSG::{code}" if code else drop_empty_codes(crs)
        return GeoJsonCrs({"type": "name", "properties": {"name": name}}, None)
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


_WANTED = 'it needs "features", each with "properties", and a "geometry" with "type" and "coordinates"'

LARGEST_COORDINATE = 1e12
"""Largest coordinate of a corner; squares and products of larger ones overflow."""


@frozen(eq=False)
class Polygon:
    """An area with a name; several parts or holes give several rings."""

    name: str
    rings: tuple[np.ndarray, ...]
    """Corners of each ring, f8 (k, 2)."""
    file: AreaFile | None = None
    """Where its coordinates lie; None: in the strip's CRS."""

    def place(self, strip: Path, header: LasHeader) -> Polygon:
        """Return the polygon in the coordinates of a strip; raises as `place_rings`."""
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
            if len(ring) < 3 or not (np.abs(ring) <= LARGEST_COORDINATE).all():
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
    # GDAL and QGIS write the member crs into the document, PostGIS into each geometry. The innermost one of an area
    # counts; they must be the same for all.
    found: dict[str | None, Any] = {}
    for feature in listed:
        levels = (feature["geometry"].get("crs"), feature.get("crs"), document.get("crs"))
        member = next((level for level in levels if level is not None), None)
        found[read_crs_name(path, member)] = member
    if len(found) > 1:
        names = ", ".join("none" if name is None else name[:40] for name in list(found)[:3])
        raise ConfigError(f"{path}: its areas name more than one CRS ({names}); write one file for each")
    return features, read_area_file(path, next(iter(found.values()), document.get("crs")), rings)


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
