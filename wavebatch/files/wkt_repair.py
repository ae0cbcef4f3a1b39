"""The WKT of RIEGL's RiPROCESS, which gives metres as the unit of longitudes.

PROJ then takes a central meridian of 15 for 15 radians: a strip in Austria would lie in Siberia. All that reads a WKT
for other programs, and all that copies one into an output, takes it from here. Before you change it: a WKT that is
right must stay as it is, byte for byte. Only a unit that is a direct member of GEOGCS is that of the longitudes; a unit
after it belongs to the projected CRS or to the heights, in any order.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from wavebatch.files.las.header import EVLR_HEADER_SIZE, WKT_ID, Evlr, Vlr, build_wkt, is_projection
from wavebatch.files.wkt import read_wkt

LONGEST_WKT = 1 << 20
"""Longest record that is read as a WKT: those of real files have a few kilobytes."""

_METRE = re.compile(r'UNIT\s*[\[(]\s*"(?:met(?:er|re)s?|m)"\s*,\s*([-+0-9.eE]+)\s*[,\])]', re.IGNORECASE)
_DEGREE = 'UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]]'


def repair_wkt(wkt: str) -> str:
    """Return a WKT with degrees as the unit of its geographic CRS.

    Parameters
    ----------
    wkt : str
        Any text.

    Returns
    -------
    str
        The same text where nothing is wrong, and where it is not well formed.
    """
    repaired = wkt
    for node in reversed(read_wkt(wkt)):
        units = [one for one in node.nodes if one.word == "UNIT"] if node.word == "GEOGCS" else []
        if len(units) != 1:
            continue
        start, end = units[0].start, units[0].end
        found = _METRE.match(wkt, start, end)
        if found and _is_one(found[1]):
            repaired = repaired[:start] + _DEGREE + repaired[end:]
    return wkt if repaired == wkt else drop_empty_codes(repaired)


def drop_empty_codes(wkt: str) -> str:
    """Return a WKT without the code 0 of RiPROCESS: GDAL looks it up in vain, and a GeoTIFF then has no projection."""
    return re.sub(r',\s*AUTHORITY\["EPSG","0"\]', "", wkt)


def _is_one(number: str) -> bool:
    try:
        return float(number) == 1.0
    except ValueError:
        return False


def repair_records(vlrs: Iterable[Vlr]) -> list[Vlr]:
    """Return the records with the WKT among them as `repair_wkt` gives it; records that are right stay as they are."""
    found = []
    for vlr in vlrs:
        wrong = is_projection(vlr) and vlr.record_id == WKT_ID
        text = _repair_payload(vlr.payload) if wrong else None
        found.append(vlr if text is None else build_wkt(text))
    return found


def repair_evlr(path: Path, evlr: Evlr) -> bytes | None:
    """Return the payload of an extended record with the WKT as `repair_wkt` gives it.

    Parameters
    ----------
    path : Path
        Of the file that has the record.
    evlr : Evlr

    Returns
    -------
    bytes or None
        None where the record is right, or no WKT.
    """
    if not is_projection(evlr) or evlr.record_id != WKT_ID or evlr.length > LONGEST_WKT:
        return None
    with open(path, "rb") as file:
        file.seek(evlr.start + EVLR_HEADER_SIZE)
        text = _repair_payload(file.read(evlr.length))
    return None if text is None else build_wkt(text).payload


def _repair_payload(payload: bytes) -> str | None:
    """The repaired WKT of a record; None where it is right."""
    text = payload.split(b"\0")[0].decode("utf-8", "replace")
    repaired = repair_wkt(text)
    return None if repaired == text else repaired
