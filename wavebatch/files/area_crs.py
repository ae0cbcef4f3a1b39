"""Areas of a GeoJSON file in the coordinates of a strip or cloud.

`run --polygon`, `stats --polygon` and `calibrate --targets` place their areas with `place_rings`, once per strip. The
standard of GeoJSON (RFC 7946) knows longitude and latitude in WGS 84 only. Files of GDAL, QGIS and wavebatch with
another CRS name it in the member `crs`; others, which have coordinates of the strip and do not say so, are known by
where they lie. Before you change it: areas in the wrong place are worse than none. Coordinates that name another CRS
are projected or refused, never used as they are.
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
from wavebatch.core.optional import need
from wavebatch.files.las.crs import CrsUnits, find_epsg, parse_wkt, read_crs_definition
from wavebatch.files.las.header import LasHeader

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

_CODE = re.compile(
    r"urn:(?:x-)?ogc:def:crs:(\w+):[^:]*:(\w+)|https?://www\.opengis\.net/def/crs/(\w+)/[^/]*/(\w+)|(EPSG|OGC):(\w+)",
    re.IGNORECASE,
)
"""A CRS by its code as GDAL, QGIS and OGC write it: as a URN, as an address, or EPSG:n."""


@dataclass(frozen=True, slots=True)
class AreaFile:
    """How the coordinates of a file of areas are meant."""

    path: str
    crs: str | None
    """That of the member `crs`; None: the file has none."""
    extent: tuple[float, float, float, float] | None
    """West, south, east and north of all its corners, also of those of other areas; None: it has none."""

    @property
    def maybe_degrees(self) -> bool:
        """Whether all corners could be longitude and latitude."""
        if self.extent is None:
            return True
        west, south, east, north = self.extent
        return west >= -180 and south >= -90 and east <= 180 and north <= 90


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
    found = _CODE.fullmatch(name)
    return ":".join(part.upper() for part in found.groups() if part) if found else name


def place_rings(
    file: AreaFile | None, rings: Sequence[np.ndarray], strip: Path, header: LasHeader
) -> list[np.ndarray]:
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
    source = None if file is None or not rings else _find_source(file, header)
    if file is None or source is None:
        return rings
    definition = read_crs_definition(strip, header)
    if definition is None:
        if not file.maybe_degrees:
            return rings  # nothing says that the CRS is not the strip's
        what = f"in degrees ({source})" if source in _SAME_DEGREES else f"in {source[:_LONGEST_NAME]}"
        raise InputError(
            f"{file.path}: is {what}, and {strip} has no CRS to project it into; write it in the coordinates of the "
            "strip, without a member crs"
        )
    code = _code(definition) or definition
    if source in (definition, code) or (source in _SAME_DEGREES and code in _SAME_DEGREES):
        return rings
    return _project(file, rings, source, strip, definition)


def _find_source(file: AreaFile, header: LasHeader) -> str | None:
    """The CRS of a file of areas; None: that of the strip.

    Areas of a file without a CRS that lie in the strip are in its coordinates, be they small ones: the strip may have a
    local grid. All areas of a file are in the same CRS, so its whole extent counts.
    """
    if file.crs is not None:
        return file.crs
    sides = [high - low for low, high in zip(header.mins[:2], header.maxs[:2], strict=True)]
    inside = file.extent is not None and max(sides) <= _LONGEST_STRIP and _overlaps(file.extent, header)
    return WGS84 if file.maybe_degrees and not inside and not _holds_degrees(header) else None


def _project(
    file: AreaFile, rings: Sequence[np.ndarray], source: str, strip: Path, definition: str
) -> list[np.ndarray]:
    """Rings of the CRS `source` in that of a strip, `definition`."""
    other = _code(definition)
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
        f"the area (x {left:.10g} to {right:.10g}, y {low:.10g} to {high:.10g}) lies outside the strip (x {west:.10g} "
        f"to {east:.10g}, y {south:.10g} to {north:.10g}); is it in another CRS?"
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


def _holds_degrees(header: LasHeader) -> bool:
    """Whether the strip lies where degrees do: it is in degrees itself, or in local metres near the origin."""
    values = [*header.mins[:2], *header.maxs[:2]]
    return all(abs(value) <= most for value, most in zip(values, (180, 90, 180, 90), strict=True))


def _code(definition: str) -> str | None:
    """`EPSG:n` of a definition that names a projected CRS by its code."""
    if definition.startswith("EPSG:"):
        return definition
    code = find_epsg(definition)
    return f"EPSG:{code}" if code and parse_wkt(definition) != CrsUnits() else None


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
