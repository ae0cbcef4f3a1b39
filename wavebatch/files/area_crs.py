"""Areas of a GeoJSON file in the coordinates of a strip or cloud.

`run --polygon`, `stats --polygons` and `calibrate --targets` place their areas with `place_rings`, once per strip. The
standard of GeoJSON (RFC 7946) knows longitude and latitude in WGS 84 only. Files of GDAL, QGIS and wavebatch with
another CRS name it in the member `crs`; others, which have coordinates of the strip and do not say so, are known by
their size.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.optional import advise_install
from wavebatch.files.las.crs import CrsUnits, parse_wkt, read_crs_definition
from wavebatch.files.las.header import LasHeader

WGS84 = "OGC:CRS84"
"""Longitude and latitude, in this order."""

_STEP = 100.0
"""Longest edge that is projected as one [m]: a straight line of degrees bends by less than a millimetre over it."""

_MOST_PIECES = 10_000
"""Most parts of an edge."""

_METRES_PER_DEGREE = 111_320.0


@dataclass(frozen=True, slots=True)
class AreaFile:
    """How the coordinates of a file of areas are meant."""

    path: str
    crs: str | None
    """That of the member `crs`; None: the file has none."""
    maybe_degrees: bool
    """Whether all corners could be longitude and latitude."""


def read_area_file(path: Path | str, member: Any, rings: Sequence[np.ndarray]) -> AreaFile:
    """Describe a file of areas.

    member: value of the member `crs` of the file, None without. rings: all corners, f8 (k, 2) each.
    Raises ConfigError for a member that gives no name.
    """
    name = None
    if member is not None:
        try:
            name = str(member["properties"]["name"]).strip()
        except (KeyError, TypeError) as error:
            raise ConfigError(f"{path}: its member crs has no name; write it in WGS 84, without that member") from error
        found = re.fullmatch(r"urn:(?:x-)?ogc:def:crs:(\w+):[^:]*:(\w+)", name, re.IGNORECASE)
        name = f"{found[1].upper()}:{found[2].upper()}" if found else name
    corners = np.concatenate([*rings, np.zeros((0, 2))])
    degrees = bool(((np.abs(corners[:, 0]) <= 180) & (np.abs(corners[:, 1]) <= 90)).all())
    return AreaFile(str(path), name, degrees)


def place_rings(
    file: AreaFile | None, rings: Sequence[np.ndarray], strip: Path, header: LasHeader
) -> list[np.ndarray]:
    """Return the rings in the coordinates of a strip.

    Rings are projected where the file names another CRS than that of the strip, or where its corners can only be
    degrees: the strip does not lie there. Edges get more corners where they are long.

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
    if file is None or not rings or (file.crs is None and not (file.maybe_degrees and not _holds_degrees(header))):
        return rings
    overlap = not describe_miss(rings, header)
    definition = read_crs_definition(strip, header)
    source = file.crs or WGS84
    if definition is None:
        if file.crs is not None and not file.maybe_degrees:
            return rings  # nothing says that it is not the strip's
        raise InputError(
            f"{file.path}: is in degrees ({source}), and {strip} has no CRS to project it into; write it in the "
            "coordinates of the strip"
        )
    if _code(definition) == source or definition == source:
        return rings
    try:
        import pyproj
    except ImportError as error:
        if overlap:
            return rings
        raise ConfigError(
            f"{file.path}: is in {source}, and {strip} is not; projecting it needs pyproj: {advise_install('pyproj')}; "
            "or write it in the coordinates of the strip"
        ) from error
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
    (west, south, _), (east, north, _) = header.mins, header.maxs
    corners = np.concatenate([*rings, np.zeros((0, 2))])
    if not len(corners) or not all(map(math.isfinite, (west, south, east, north))):
        return ""
    (left, low), (right, high) = corners.min(axis=0), corners.max(axis=0)
    if left <= east and right >= west and low <= north and high >= south:
        return ""
    return (
        f"the area (x {left:.10g} to {right:.10g}, y {low:.10g} to {high:.10g}) lies outside the strip (x {west:.10g} "
        f"to {east:.10g}, y {south:.10g} to {north:.10g}); is it in another CRS?"
    )


def _holds_degrees(header: LasHeader) -> bool:
    """Whether the strip lies where degrees do: it is in degrees itself, or in local metres near the origin."""
    values = [*header.mins[:2], *header.maxs[:2]]
    return all(abs(value) <= most for value, most in zip(values, (180, 90, 180, 90), strict=True))


def _code(definition: str) -> str | None:
    """`EPSG:n` of a definition that names a projected CRS by its code."""
    if definition.startswith("EPSG:"):
        return definition
    found = re.search(r'(?:AUTHORITY|ID)\s*\[\s*"EPSG"\s*,\s*"?(\d+)"?\s*\]\s*\]\s*$', definition)
    known = found and parse_wkt(definition) != CrsUnits()
    return f"EPSG:{found[1]}" if found and known else None


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
