"""LAS version, point format and CRS record of an output cloud.

The layout calls `choose_version`. PDAL, and all that reads with it, sees extra bytes only in LAS 1.4, and writers of
COPC take only point formats 6 to 8: so that is what a cloud gets, whatever the strip is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.las.geo_keys import convert_geotiff
from wavebatch.files.las.header import (
    GEOTIFF_ID,
    PROJECTION,
    WAVEFORM_RECORD_ID,
    WKT_ID,
    Evlr,
    LasHeader,
    find_evlrs,
    has_record,
)
from wavebatch.files.las.point_formats import MODERN, choose_format
from wavebatch.files.wkt import repair_evlr, repair_records

LAS_VERSIONS = ("1.4", "1.3", "keep")
"""Values of --las-version."""


@dataclass(frozen=True, slots=True)
class Version:
    """What `choose_version` chose."""

    version: tuple[int, int]
    point_format: int
    wkt: str | None = None
    """WKT record to write in place of those of the strip."""
    notes: tuple[str, ...] = ()
    """Lines for the user."""


def choose_version(path: Path, header: LasHeader, wanted: str, point_format: int | None, keep: bool) -> Version:
    """Return version and point format of the cloud of a strip.

    wanted: one of LAS_VERSIONS. point_format: that which the user wants, or None. keep: packets are kept, and with them
    the format's waveform fields. Raises ConfigError for options that contradict each other, InputError for a strip that
    cannot be written in this way.
    """
    if wanted not in LAS_VERSIONS:
        raise ConfigError(f"las_version {wanted!r}: must be one of {', '.join(LAS_VERSIONS)}")
    target = choose_format(path, header, point_format, keep)
    if wanted == "1.3":
        return _as_1_3(path, header, target)
    evlrs, _ = find_evlrs(path, header)
    records: list[Any] = [*header.vlrs, *evlrs]
    only_keys = has_record(records, PROJECTION, GEOTIFF_ID) and not has_record(records, PROJECTION, WKT_ID)
    repaired, notes = _repair(path, header, evlrs)
    if wanted == "1.4" and point_format is None and not keep:
        modern = MODERN.get(target, target)
        wkt = convert_geotiff(path, header.vlrs, asked=False) if only_keys else None
        if only_keys and wkt is None:
            return Version(max(header.version, (1, 4)), target, notes=(_explain_keys(target, modern), *notes))
        return Version(max(header.version, (1, 4)), modern, wkt or repaired, notes)
    wkt = repaired
    if only_keys and target >= 6:
        wkt = convert_geotiff(path, header.vlrs, asked=header.point_format < 6)
    oldest = (1, 4) if wanted == "1.4" or target >= 6 else header.version
    return Version(max(header.version, oldest), target, wkt, notes)


_REPAIRED = (
    "the strip's WKT says metres where it means degrees, as RiPROCESS writes it: GIS programs show the strip "
    "in a wrong place; the cloud's WKT is right"
)


def _repair(path: Path, header: LasHeader, evlrs: Sequence[Evlr] = ()) -> tuple[str | None, tuple[str, ...]]:
    """The repaired WKT of the header, None where it is right or not there, and the line for the user.

    The writer of the cloud repairs extended records as it copies them; the line is for them too.
    """
    pairs = zip(header.vlrs, repair_records(header.vlrs), strict=True)
    wkt = next((new.payload.rstrip(b"\0").decode() for old, new in pairs if new is not old), None)
    wrong = wkt is not None or any(repair_evlr(path, evlr) is not None for evlr in evlrs)
    return wkt, (_REPAIRED,) * wrong


def _explain_keys(target: int, modern: int) -> str:
    reason = "its CRS is given by GeoTIFF keys that wavebatch cannot turn into WKT, which point formats 6 to 10 need"
    if target < 6:
        return (
            f"written in point format {target} of LAS 1.4 in place of {modern}: {reason}; --point-format {modern} tries"
        )
    return f"{reason}: PDAL will not read the cloud unless readers.las gets nosrs=true; add a WKT record to the strip"


def _as_1_3(path: Path, header: LasHeader, target: int) -> Version:
    """LAS 1.3, if it can hold all that the strip has."""
    if target >= 6:
        needed = header.point_format >= 6
        what = "leave --las-version out" if needed else "leave one of the two out"
        reason = f", and the strip's points of format {header.point_format} fit into no other" if needed else ""
        raise ConfigError(f"{path}: --las-version 1.3 has no point format {target}{reason}; {what}")
    evlrs, _ = find_evlrs(path, header)
    if any(evlr.record_id != WAVEFORM_RECORD_ID for evlr in evlrs):
        raise InputError(f"{path}: has extended records, which LAS 1.3 cannot hold; leave --las-version out")
    if has_record(header.vlrs, PROJECTION, WKT_ID) and not has_record(header.vlrs, PROJECTION, GEOTIFF_ID):
        raise InputError(f"{path}: its CRS is given as WKT, which LAS 1.3 does not have; leave --las-version out")
    repaired, notes = _repair(path, header)
    return Version((1, 3), target, repaired, notes)
