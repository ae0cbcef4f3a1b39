"""WKT of a CRS as a list of its nodes: the one scanner of it; and the repair of RIEGL's RiPROCESS WKT.

`las/crs.py` finds units with it, `geotiff_file.py` a third axis. Before you change it: the text may hold anything, so
the scanner does not recurse, and what is not well formed has no nodes.

RiPROCESS gives metres as the unit of longitudes. PROJ then takes a central meridian of 15 for 15 radians: a strip in
Austria would lie in Siberia. All that reads a WKT for other programs, and all that copies one into an output, takes it
from here. Before you change it: a WKT that is right must stay as it is, byte for byte. Only a unit that is a direct
member of GEOGCS is that of the longitudes; a unit after it belongs to the projected CRS or to the heights, in any
order.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from wavebatch.files.las.header import EVLR_HEADER_SIZE, WKT_ID, Evlr, Vlr, build_wkt, is_projection

_TOKEN = re.compile(
    r'"((?:[^"]|"")*)"|([A-Za-z_][A-Za-z_0-9]*)\s*([\[(])?|([-+]?[0-9.][-+0-9.eE]*)|([\])])|,|\s+|(.)', re.DOTALL
)


@dataclass(slots=True, eq=False)
class Node:
    """A keyword with what stands in its brackets."""

    word: str
    """In upper case."""
    start: int
    """Place of the keyword in the text."""
    end: int = 0
    """Place after its closing bracket."""
    values: list[str] = field(default_factory=list)
    """Texts, numbers and words without brackets, in order."""
    nodes: list[Node] = field(default_factory=list)

    def find(self, *words: str) -> Node | None:
        """Return the first node in the brackets with one of these keywords."""
        return next((node for node in self.nodes if node.word in words), None)


def read_wkt(text: str) -> list[Node]:
    """Return all nodes of WKT (version 1 or 2) in the order of the text; empty where it is not well formed."""
    found: list[Node] = []
    nested: list[Node] = []
    for token in _TOKEN.finditer(text):
        quoted, word, opens, number, closes, other = token.groups()
        if opens:
            found.append(Node(word.upper(), token.start()))
            if nested:
                nested[-1].nodes.append(found[-1])
            nested.append(found[-1])
        elif other or closes and not nested:
            return []
        elif closes:
            nested.pop().end = token.end()
        elif nested:
            nested[-1].values += [value for value in (quoted, word, number) if value is not None]
    return [] if nested else found


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
