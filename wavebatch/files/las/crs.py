"""The CRS of a LAS file and the units of its coordinates, from its WKT and its GeoTIFF keys; the repair of a wrong WKT.

`find_facts` reads them once; the survey refuses strips that are not in metres. `describe_crs` has short words for
pictures and tables. The records may hold any bytes: what cannot be read counts as missing, nothing here raises an
error for it, and the scanner `read_wkt` does not recurse.

RIEGL's RiPROCESS gives metres as the unit of longitudes. PROJ then takes a central meridian of 15 for 15 radians: a
strip in Austria would lie in Siberia. All that reads a WKT for other programs, and all that copies one into an output,
takes it from here. Before you change it: a WKT that is right must stay as it is, byte for byte. Only a unit that is a
direct member of GEOGCS is that of the longitudes; a unit after it belongs to the projected CRS or to the heights, in
any order.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from wavebatch.files.las.geo_keys import GeoKeys, find_code
from wavebatch.files.las.header import (
    EVLR_HEADER_SIZE,
    GEOTIFF_ID,
    WKT_ID,
    Evlr,
    LasHeader,
    Vlr,
    build_wkt,
    find_evlrs,
    is_projection,
    read_header,
)

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


DOUBLES_ID, CITATION_ID = 34736, 34737
_IDS = (WKT_ID, GEOTIFF_ID, DOUBLES_ID, CITATION_ID)

_SHORT = {"metres": "m", "international feet": "ft", "US survey feet": "us-ft"}
"""Units of pictures and tables."""

_EARTH = (6.34e6, 6.40e6)
"""Distance of land from the centre of the Earth [m]: 6,357 km at the poles to 6,378 km at the equator, and room for
mountains.
"""

_HIGHEST = 3e4
"""Height that no projected strip has, be it in metres or feet."""

_NAMES = {1.0: "metres", 0.3048: "international feet", 1200 / 3937: "US survey feet"}


@dataclass(frozen=True, slots=True)
class CrsUnits:
    """Kind and units of the coordinates of a CRS; None for what it does not give."""

    kind: str | None = None
    """`projected`, `geographic`, `geocentric` or None."""
    horizontal: float | None = None
    """Metres per unit; NaN for an unknown unit."""
    vertical: float | None = None
    """Metres per unit of heights; None: as horizontal."""

    @property
    def is_metric(self) -> bool:
        """Whether coordinates are projected and in metres, as far as the CRS gives this."""
        metric = all(value is None or abs(value - 1.0) < 1e-9 for value in (self.horizontal, self.vertical))
        return metric and self.kind in (None, "projected")

    def describe(self) -> str:
        """Return the units in words."""
        if self.kind == "geographic":
            return "degrees"
        if self.kind == "geocentric":
            return "geocentric (ECEF)"
        along, up = (_name_unit(value) for value in (self.horizontal, self.vertical))
        return along if self.vertical is None or up == along else f"{along} with heights in {up}"


def name_units(units: Sequence[CrsUnits]) -> str:
    """Return the units of coordinates in words."""
    return next((one.describe() for one in units if not one.is_metric), "metres")


def metres_per_unit(units: Sequence[CrsUnits]) -> tuple[float, float, float]:
    """Return the metres of a step of 1 in x, y and z; NaN where it has no length, as in degrees, or an unknown one.

    units: as `read_crs` gives them. Without a unit, coordinates are metres.
    """
    if any(unit.kind == "geographic" for unit in units):
        along = math.nan
    else:
        along = next((unit.horizontal for unit in units if unit.horizontal is not None), 1.0)
    default = 1.0 if math.isnan(along) else along
    up = next((unit.vertical for unit in units if unit.vertical is not None), default)
    return along, along, up


_EPSG = re.compile(r'(?:AUTHORITY|ID)\s*\[\s*"EPSG"\s*,\s*"?(\d+)"?\s*\]\s*\]\s*$')


def find_epsg(wkt: str) -> int | None:
    """Return the EPSG code of the CRS that a WKT describes; None where it gives none, or 0 as RiPROCESS does."""
    found = _EPSG.search(wkt)
    return int(found[1]) or None if found else None


def looks_geocentric(mins: Sequence[float], maxs: Sequence[float]) -> bool:
    """Whether the extent of a strip lies on the surface of the Earth as seen from its centre.

    Projected coordinates may be as far from their origin, but none has heights of tens of kilometres.
    """
    middle = [0.5 * (low + high) for low, high in zip(mins, maxs, strict=True)]
    distance = math.hypot(*middle)
    return _EARTH[0] < distance < _EARTH[1] and abs(middle[2]) > _HIGHEST


def _name_unit(metres: float | None) -> str:
    if metres is None:
        return "metres"
    for known, name in _NAMES.items():
        if abs(metres / known - 1.0) < 1e-7:
            return name
    return f"units of {metres:.10g} m" if math.isfinite(metres) else "an unknown unit"


def read_crs(path: Path, header: LasHeader) -> tuple[str | None, tuple[CrsUnits, ...]]:
    """Return the WKT of a strip, else code or name of its GeoTIFF keys, else None, and the units that each gives.

    Where none gives a kind or a unit, coordinates that are geocentric by their size are one more entry.
    """
    records = _read_records(path, header)
    units, text = [], None
    if WKT_ID in records:
        text = records[WKT_ID].split(b"\0")[0].decode("utf-8", "replace") or None
        units.append(parse_wkt(text or ""))
    if GEOTIFF_ID in records:
        citation = records.get(CITATION_ID, b"").split(b"\0")[0].decode("latin-1").strip("| ")
        keys = GeoKeys.parse(records[GEOTIFF_ID], records.get(DOUBLES_ID, b""), records.get(CITATION_ID, b""))
        text = text or keys.name or (f"GeoTIFF: {citation}" if citation else "GeoTIFF keys")
        units.append(CrsUnits(keys.kind, *keys.read_units()))
    if all(unit == CrsUnits() for unit in units) and looks_geocentric(header.mins, header.maxs):
        units.append(CrsUnits("geocentric"))
    return text, tuple(units)


def read_crs_definition(path: Path, header: LasHeader, *, heights: bool = False) -> str | None:
    """Return the CRS of a file as GIS libraries take it: its WKT, else `EPSG:n` from its GeoTIFF keys, else None.

    The WKT is that of `repair_wkt`. heights: with the code of the heights, `EPSG:n+m`; rasters have no place for it.
    """
    text = (read_crs(path, header)[0] or "").strip()
    if text.startswith("EPSG:"):
        return text if heights else text.partition("+")[0]
    if text and not text.startswith("GeoTIFF"):
        return repair_wkt(text)
    code = find_code(header.vlrs)
    return f"EPSG:{code}" if code else None


def _read_records(path: Path, header: LasHeader) -> dict[int, bytes]:
    """Payloads of the CRS records by number; VLRs of the header come before EVLRs after the points."""
    found = {vlr.record_id: vlr.payload for vlr in header.vlrs if is_projection(vlr)}
    evlrs, _ = find_evlrs(path, header)
    for evlr in evlrs:
        new = is_projection(evlr) and evlr.record_id in _IDS and evlr.record_id not in found
        if new and evlr.length <= LONGEST_WKT:
            with open(path, "rb") as file:
                file.seek(evlr.start + EVLR_HEADER_SIZE)
                found[evlr.record_id] = file.read(evlr.length)
    return found


_PROJECTED = ("PROJCS", "PROJCRS", "PROJECTEDCRS", "LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")
_GEOGRAPHIC = ("GEOGCS", "GEOGCRS", "GEOGRAPHICCRS")
_GEODETIC = ("GEOCCS", "GEODCRS", "GEODETICCRS")
_UPRIGHT = ("VERT_CS", "VERTCRS", "VERTICALCRS")
_COMPOUND = ("COMPD_CS", "COMPOUNDCRS")


def parse_wkt(text: str) -> CrsUnits:
    """Return kind and units of the WKT (version 1 or 2) of a CRS."""
    found = read_wkt(text)
    if not found:
        return CrsUnits()
    root = found[0]
    systems = [_unwrap(node) for node in (root.nodes if root.word in _COMPOUND else [root])]
    upright = next((node for node in systems if node.word in _UPRIGHT), None)
    vertical = None if upright is None else _find_unit(upright)
    for node in systems:
        if node.word in _GEOGRAPHIC:
            return CrsUnits("geographic", None, vertical)
        if node.word in _GEODETIC:
            shape = node.find("CS")
            is_geographic = shape is not None and "ellipsoidal" in map(str.lower, shape.values)
            return CrsUnits("geographic" if is_geographic else "geocentric", None, vertical)
        if node.word in _PROJECTED:
            vertical = _find_unit(node, last=True) if vertical is None else vertical
            return CrsUnits("projected", _find_unit(node), vertical)
    return CrsUnits(None, None, vertical)


def _unwrap(node: Node) -> Node:
    """The source CRS of a bound CRS, or the node itself."""
    source = node.find("SOURCECRS") if node.word == "BOUNDCRS" else None
    return source.nodes[0] if source is not None and source.nodes else node


def _find_unit(node: Node, *, last: bool = False) -> float | None:
    """Metres per unit of a CRS: its unit, else that of its first axis; last: only that of its third axis."""
    axes = [axis.find("LENGTHUNIT", "UNIT") for axis in node.nodes if axis.word == "AXIS"]
    unit = (axes[2] if len(axes) > 2 else None) if last else node.find("LENGTHUNIT", "UNIT") or next(iter(axes), None)
    if unit is None:
        return None
    for value in unit.values[1:]:
        try:
            metres = float(value)
        except ValueError:
            continue
        return metres if math.isfinite(metres) and metres > 0 else math.nan
    return math.nan


class CrsWords(NamedTuple):
    """What pictures say of a CRS."""

    name: str = ""
    """Empty if the file gives no CRS."""
    unit: str = "m"
    """Unit of x and y; m if the file gives none: most strips without a CRS are in metres."""
    upright_unit: str = "m"
    """Unit of z."""
    upright: str = "height"
    """What z is: no height in geocentric coordinates."""


def describe_crs(path: Path) -> CrsWords:
    """Return the words for a file's CRS; raises InputError for a file that is not LAS."""
    header = read_header(path)
    text, units = read_crs(path, header)
    kinds = {one.kind for one in units}
    along, _, up = (_SHORT.get(_name_unit(metres), "units") for metres in metres_per_unit(units))
    code = find_code(header.vlrs)
    if text and text.rstrip().endswith("]"):
        name = name_crs(text)
    else:
        name = f"EPSG:{code}" if code else text or ""
    return CrsWords(name, "deg" if "geographic" in kinds else along, up, "z" if "geocentric" in kinds else "height")


def name_crs(text: str) -> str:
    """Return the name of a CRS in WKT with its EPSG code; other text as it is."""
    named = re.match(r'\s*\w+\s*[\[(]\s*"([^"]*)"', text)
    if named is None:
        return " ".join(text.split())
    code = find_epsg(text)
    return named[1] + (f" (EPSG:{code})" if code else "")
