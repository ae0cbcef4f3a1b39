"""Units of coordinates, from the WKT and the GeoTIFF keys of a strip.

`find_facts` reads them once; the survey refuses strips that are not in metres. The records may hold any bytes: what
cannot be read counts as missing, and nothing here raises an error for it.
"""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from wavebatch.files.las.epsg_units import find_unit
from wavebatch.files.las.header import (
    EVLR_HEADER_SIZE,
    GEOTIFF_ID,
    WKT_ID,
    LasHeader,
    find_evlrs,
    is_projection,
)
from wavebatch.files.wkt_repair import LONGEST_WKT, repair_wkt

DOUBLES_ID, CITATION_ID = 34736, 34737
_IDS = (WKT_ID, GEOTIFF_ID, DOUBLES_ID, CITATION_ID)

_TOKEN = re.compile(r'"((?:[^"]|"")*)"|([A-Za-z_][A-Za-z_0-9]*)([\[(])?|([-+]?[0-9.][-+0-9.eE]*)|([\])])|,|\s+')

_MODEL, _LINEAR, _LINEAR_SIZE, _VERTICAL = 1024, 3076, 3077, 4099
_GEOGRAPHIC_CODE, _PROJECTED_CODE, _VERTICAL_CODE = 2048, 3072, 4096
_MODELS = {1: "projected", 2: "geographic", 3: "geocentric"}
_USER_DEFINED, _UNIT_CODES = 32767, range(9001, 9200)
_LEAST_CODE = 1024
"""Least EPSG code; smaller values are those of other tables."""
METRES = {
    9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937, 9004: 0.3048122529845059, 9005: 0.3047972654, 9006: 0.3047995142,
    9014: 1.8288, 9015: 1853.248, 9030: 1852.0, 9036: 1000.0, 9037: 0.9143917963, 9060: 0.30479951024814694,
    9093: 1609.344, 9096: 0.9144,
}  # fmt: skip
"""Metres per unit by EPSG code of the unit (GeoTIFF specification 6.3.1.3)."""

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
            return "geocentric (ECEF) without a height coordinate"
        along, up = (_name_unit(value) for value in (self.horizontal, self.vertical))
        return along if self.vertical is None or up == along else f"{along} with heights in {up}"


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
        text = text or _read_code(records[GEOTIFF_ID]) or (f"GeoTIFF: {citation}" if citation else "GeoTIFF keys")
        units.append(parse_geotiff(records[GEOTIFF_ID], records.get(DOUBLES_ID, b""), records.get(CITATION_ID, b"")))
    if all(unit == CrsUnits() for unit in units) and looks_geocentric(header.mins, header.maxs):
        units.append(CrsUnits("geocentric"))
    return text, tuple(units)


def read_crs_definition(path: Path, header: LasHeader) -> str | None:
    """Return the CRS of a file as GIS libraries take it: its WKT, else `EPSG:n` from its GeoTIFF keys, else None.

    The WKT is that of `repair_wkt`.
    """
    records = _read_records(path, header)
    text = records.get(WKT_ID, b"").split(b"\0")[0].decode("utf-8", "replace").strip()
    if text:
        return repair_wkt(text)
    code = _read_code(records.get(GEOTIFF_ID, b""))
    return None if code is None else code.partition("+")[0]  # heights have no place in a raster


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


def parse_geotiff(directory: bytes, doubles: bytes = b"", texts: bytes = b"") -> CrsUnits:
    """Return the units of a GeoKeyDirectory (34735); `doubles` and `texts` are the records 34736 and 34737.

    If no key gives the unit, the EPSG code of the CRS does (`epsg_units`), then a citation that names feet.
    """
    keys = _list_keys(directory)
    kind = _MODELS.get(keys.get(_MODEL, (0, 0))[1])
    horizontal, vertical = _read_unit(keys, _LINEAR, doubles), _read_unit(keys, _VERTICAL, doubles)
    if horizontal is None and kind != "geographic":
        horizontal = find_unit(_find_code(keys, _PROJECTED_CODE)) or _guess_unit(texts.decode("latin-1"))
    if vertical is None:
        vertical = find_unit(_find_code(keys, _VERTICAL_CODE), vertical=True)
    return CrsUnits(kind, horizontal, vertical)


def _list_keys(directory: bytes) -> dict[int, tuple[int, int]]:
    """Place and value of each key."""
    rows = list(struct.iter_unpack("<4H", directory[: len(directory) // 8 * 8]))
    return {key: (place, value) for key, place, _, value in rows[1 : rows[0][3] + 1]} if rows else {}


def _find_code(keys: Mapping[int, tuple[int, int]], key: int) -> int:
    """The EPSG code in a key, 0 without one."""
    place, code = keys.get(key, (0, 0))
    return code if place == 0 and _LEAST_CODE <= code < _USER_DEFINED else 0


def _read_code(directory: bytes) -> str | None:
    """The EPSG code of the CRS, with `+` and that of the heights if there is one."""
    keys = _list_keys(directory)
    geographic = _MODELS.get(keys.get(_MODEL, (0, 0))[1]) == "geographic"
    code = _find_code(keys, _GEOGRAPHIC_CODE if geographic else _PROJECTED_CODE)
    upright = _find_code(keys, _VERTICAL_CODE)
    return None if not code else f"EPSG:{code}+{upright}" if upright else f"EPSG:{code}"


def _read_unit(keys: Mapping[int, tuple[int, int]], key: int, doubles: bytes) -> float | None:
    if key not in keys or keys[key][0] != 0 or keys[key][1] == 0:
        return None
    code = keys[key][1]
    if code != _USER_DEFINED:
        # Leica's ALSPP writes the EPSG code of the CRS here, which is not a unit.
        return METRES.get(code, math.nan) if code in _UNIT_CODES else None
    place, at = keys.get(_LINEAR_SIZE, (0, 0)) if key == _LINEAR else (0, 0)
    if place != DOUBLES_ID or 8 * at + 8 > len(doubles):
        return math.nan
    size = struct.unpack_from("<d", doubles, 8 * at)[0]
    return size if math.isfinite(size) and size > 0 else math.nan


def _guess_unit(text: str) -> float | None:
    words = text.lower()
    if "ftus" in words or "us survey f" in words or "us_survey_f" in words or "us feet" in words:
        return 1200 / 3937
    return 0.3048 if re.search(r"\b(feet|foot|ft)\b", words) else None


_PROJECTED = ("PROJCS", "PROJCRS", "PROJECTEDCRS", "LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")
_GEOGRAPHIC = ("GEOGCS", "GEOGCRS", "GEOGRAPHICCRS")
_GEODETIC = ("GEOCCS", "GEODCRS", "GEODETICCRS")
_UPRIGHT = ("VERT_CS", "VERTCRS", "VERTICALCRS")
_COMPOUND = ("COMPD_CS", "COMPOUNDCRS")


def parse_wkt(text: str) -> CrsUnits:
    """Return kind and units of the WKT (version 1 or 2) of a CRS."""
    root = _parse_wkt(text)
    if root is None:
        return CrsUnits()
    systems = [_unwrap(node) for node in (root if root[0] in _COMPOUND else [root]) if isinstance(node, list)]
    upright = _find(systems, *_UPRIGHT)
    vertical = None if upright is None else _find_unit(upright)
    for node in systems:
        if node[0] in _GEOGRAPHIC:
            return CrsUnits("geographic", None, vertical)
        if node[0] in _GEODETIC:
            shape = [value.lower() for value in _find(node, "CS") or () if isinstance(value, str)]
            return CrsUnits("geographic" if "ellipsoidal" in shape else "geocentric", None, vertical)
        if node[0] in _PROJECTED:
            vertical = _find_unit(node, last=True) if vertical is None else vertical
            return CrsUnits("projected", _find_unit(node), vertical)
    return CrsUnits(None, None, vertical)


def _unwrap(node: list) -> list:
    """The source CRS of a bound CRS, or the node itself."""
    source = _find(node, "SOURCECRS") if node[0] == "BOUNDCRS" else None
    return next((child for child in source or () if isinstance(child, list)), node)


def _find_unit(node: list, *, last: bool = False) -> float | None:
    """Metres per unit of a CRS: its unit, else that of its first axis; last: only that of its third axis."""
    axes = [_find(axis, "LENGTHUNIT", "UNIT") for axis in node if isinstance(axis, list) and axis[0] == "AXIS"]
    unit = (axes[2] if len(axes) > 2 else None) if last else _find(node, "LENGTHUNIT", "UNIT") or next(iter(axes), None)
    if unit is None:
        return None
    for value in [value for value in unit[1:] if isinstance(value, str)][1:]:
        try:
            metres = float(value)
        except ValueError:
            continue
        return metres if math.isfinite(metres) and metres > 0 else math.nan
    return math.nan


def _parse_wkt(text: str) -> list | None:
    """The outermost keyword of WKT as nested lists [keyword, text or list ...]; None if the text is not WKT.

    The text is turned into JSON: Python reads that fast, and reports what is not well formed or nested too deeply.
    """
    try:
        top = json.loads(f'[""{_TOKEN.sub(_to_json, text)}]')
    except (ValueError, RecursionError):
        return None
    return next((item for item in top if isinstance(item, list)), None)


def _to_json(token: re.Match) -> str:
    quoted, word, opens, number, closes = token.groups()
    if opens:
        return f',["{word.upper()}"'
    value = word or number or quoted
    return "]" if closes else "" if value is None else f",{json.dumps(value)}"


def _find(node: list, *words: str) -> list | None:
    return next((child for child in node if isinstance(child, list) and child[0] in words), None)
