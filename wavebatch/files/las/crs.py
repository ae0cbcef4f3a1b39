"""The CRS of a LAS file and the units of its coordinates, from its WKT and its GeoTIFF keys; the repair of a wrong WKT.

`find_facts` reads them once; the survey refuses strips that are not in metres. `describe_crs` has short words for
pictures and tables. The records may hold any bytes: what cannot be read counts as missing, nothing here raises an
error for it, and the scanner `read_wkt` does not recurse.

RIEGL's RiPROCESS gives metres as the unit of longitudes. PROJ then takes a central meridian of 15 for 15 radians: a
strip in Austria would lie in Siberia. All that reads a WKT for other programs, and all that copies one into an output,
takes it from here. Before you change it: a WKT that is right must stay as it is, byte for byte. Only a unit that is a
direct member of GEOGCS is that of the longitudes; a unit after it belongs to the projected CRS or to the heights, in
any order.

`GeoKeys` are the GeoTIFF keys: kind, EPSG codes and units. Units that they do not give are those of the EPSG data set
as PROJ 9 holds it (units.toml); a code that is not listed there is taken for metres, as most are. The output layout
calls `convert_geotiff`, because point formats 6 to 10 need WKT. UTM zones of four datums are converted here, so that
the same strip gives the same bytes on every machine; all others only with pyproj, where the user asks for it. Before
you change it: a wrong CRS is worse than none. What is not sure is None.
"""

from __future__ import annotations

import functools
import math
import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from wavebatch.core.errors import InputError, advise_install
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.files.las import header as las

DOUBLES_ID = 34736

_MODEL, _LINEAR, _LINEAR_SIZE, _VERTICAL = 1024, 3076, 3077, 4099
_GEOGRAPHIC_CODE, _PROJECTED_CODE, _VERTICAL_CODE = 2048, 3072, 4096
_MODELS = {1: "projected", 2: "geographic", 3: "geocentric"}
_USER_DEFINED, _UNIT_CODES, _METRE = 32767, range(9001, 9200), 9001
_LEAST_CODE = 1024
"""Least EPSG code; smaller values are those of other tables."""
_ELLIPSOIDAL = range(5001, 5034)
"""Codes of heights above an ellipsoid (GeoTIFF specification 6.3.4.1); the projected CRS says which ellipsoid."""

METRES = {
    9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937, 9004: 0.3048122529845059, 9005: 0.3047972654, 9006: 0.3047995142,
    9014: 1.8288, 9015: 1853.248, 9030: 1852.0, 9036: 1000.0, 9037: 0.9143917963, 9060: 0.30479951024814694,
    9093: 1609.344, 9096: 0.9144,
}  # fmt: skip
"""Metres per unit by EPSG code of the unit (GeoTIFF specification 6.3.1.3)."""


@frozen
class GeoKeys:
    """The keys of a GeoKeyDirectory (record 34735)."""

    keys: Mapping[int, tuple[int, int]]
    """Place and value of each key; place 0: the value is the number itself."""
    doubles: bytes = b""
    """Record 34736."""
    texts: bytes = b""
    """Record 34737."""

    @classmethod
    def parse(cls, directory: bytes, doubles: bytes = b"", texts: bytes = b"") -> GeoKeys:
        """Read the records."""
        rows = list(struct.iter_unpack("<4H", directory[: len(directory) // 8 * 8]))
        found = {key: (place, value) for key, place, _, value in rows[1 : rows[0][3] + 1]} if rows else {}
        return cls(found, doubles, texts)

    def number(self, key: int, missing: int = 0) -> int:
        """Return the number that a key holds itself."""
        place, value = self.keys.get(key, (1, 0))
        return missing if place else value

    @property
    def kind(self) -> str | None:
        """`projected`, `geographic`, `geocentric` or None."""
        return _MODELS.get(self.keys.get(_MODEL, (0, 0))[1])

    @property
    def code(self) -> int:
        """EPSG code of the CRS without its heights; 0 without one."""
        return self._find_code(_GEOGRAPHIC_CODE if self.kind == "geographic" else _PROJECTED_CODE)

    @property
    def name(self) -> str | None:
        """`EPSG:n` of the CRS, with `+` and the code of the heights if there is one; None without a code."""
        upright = self._find_code(_VERTICAL_CODE)
        return None if not self.code else f"EPSG:{self.code}+{upright}" if upright else f"EPSG:{self.code}"

    @property
    def sure_code(self) -> int | None:
        """EPSG code of a projected CRS in metres, if nothing else is in the keys that the code does not say."""
        vertical = self.number(_VERTICAL_CODE)
        if self.number(_MODEL) != 1 or vertical and vertical not in _ELLIPSOIDAL:
            return None
        code, unit = self.number(_PROJECTED_CODE), self.number(_LINEAR, _METRE)
        if not code and unit not in _UNIT_CODES:
            code, unit = unit, _METRE  # Leica's ALSPP writes the code of the CRS where that of the unit belongs
        if (unit, self.number(_VERTICAL, _METRE)) != (_METRE, _METRE):
            return None
        return code if 0 < code != _USER_DEFINED else None

    def read_units(self) -> tuple[float | None, float | None]:
        """Return metres per unit of x and y, and of z; None where the keys do not say, NaN for an unknown unit.

        If no key gives the unit, the EPSG code of the CRS does, then a citation that names feet.
        """
        horizontal, vertical = self._read_unit(_LINEAR), self._read_unit(_VERTICAL)
        if horizontal is None and self.kind != "geographic":
            horizontal = _units("projected").get(self._find_code(_PROJECTED_CODE))
            words = self.texts.decode("latin-1").lower()
            if horizontal is None and any(part in words for part in ("ftus", "us survey f", "us_survey_f", "us feet")):
                horizontal = 1200 / 3937
            elif horizontal is None and re.search(r"\b(feet|foot|ft)\b", words):
                horizontal = 0.3048
        if vertical is None:
            vertical = _units("vertical").get(self._find_code(_VERTICAL_CODE))
        return horizontal, vertical

    def _find_code(self, key: int) -> int:
        code = self.number(key)
        return code if _LEAST_CODE <= code < _USER_DEFINED else 0

    def _read_unit(self, key: int) -> float | None:
        code = self.number(key)
        if not code:
            return None
        if code != _USER_DEFINED:
            # Leica's ALSPP writes the EPSG code of the CRS here, which is not a unit.
            return METRES.get(code, math.nan) if code in _UNIT_CODES else None
        place, at = self.keys.get(_LINEAR_SIZE, (0, 0)) if key == _LINEAR else (0, 0)
        if place != DOUBLES_ID or 8 * at + 8 > len(self.doubles):
            return math.nan
        size = struct.unpack_from("<d", self.doubles, 8 * at)[0]
        return size if math.isfinite(size) and size > 0 else math.nan


def find_code(vlrs: Iterable[las.Vlr]) -> int | None:
    """Return the `sure_code` of the GeoTIFF keys in the records of a header."""
    directory = next((v.payload for v in vlrs if las.is_projection(v) and v.record_id == las.GEOTIFF_ID), b"")
    return GeoKeys.parse(directory).sure_code


@functools.cache
def _units(kind: str) -> dict[int, float]:
    """Metres per unit of a `projected` or `vertical` CRS by its EPSG code; those in metres are not among them."""
    import tomllib  # most strips give their unit

    table = tomllib.loads(Path(__file__).with_name("units.toml").read_text("utf-8"))[kind]
    found: dict[int, float] = {}
    for unit, codes in table.items():
        for text in codes.split():
            span, _, step = text.partition("/")
            first, _, last = span.partition("-")
            found |= dict.fromkeys(range(int(first), int(last or first) + 1, int(step or 1)), float(unit))
    return found


_GRS80 = 'SPHEROID["GRS 1980",6378137,298.257222101,AUTHORITY["EPSG","7019"]]'
_WGS84 = (
    "WGS 84", "4326",
    'DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],AUTHORITY["EPSG","6326"]]',
)  # fmt: skip
_ETRS89 = (
    "ETRS89", "4258", f'DATUM["European_Terrestrial_Reference_System_1989",{_GRS80},AUTHORITY["EPSG","6258"]]',
)  # fmt: skip
_NAD83 = ("NAD83", "4269", f'DATUM["North_American_Datum_1983",{_GRS80},AUTHORITY["EPSG","6269"]]')
_UTM = (
    (range(32601, 32661), 32600, "N", _WGS84),
    (range(32701, 32761), 32700, "S", _WGS84),
    (range(25828, 25839), 25800, "N", _ETRS89),
    (range(26901, 26924), 26900, "N", _NAD83),
)
"""EPSG codes of UTM zones, the code of zone 0, the hemisphere and the datum."""


def convert_geotiff(path: Path, vlrs: Iterable[las.Vlr], *, asked: bool) -> str | None:
    """Return the WKT of the CRS in the GeoTIFF keys of `vlrs`; None where it cannot be converted surely.

    asked: the user wants a format that needs WKT, so pyproj is used where wavebatch does not know the CRS.
    Raises InputError where that was asked for and does not work.
    """
    code = find_code(vlrs)
    wkt = None if code is None else build_utm(code)
    if wkt is not None or not asked:
        return wkt
    if code is not None:
        try:
            import pyproj

            return pyproj.CRS.from_epsg(code).to_wkt("WKT1_GDAL")
        except ImportError:
            reason = f"EPSG:{code}, which pyproj would convert: {advise_install('pyproj')}"
        except pyproj.exceptions.CRSError as error:
            reason = f"EPSG:{code}, which pyproj does not know ({error})"
    else:
        reason = "keys without one EPSG code for all of it"
    raise InputError(
        f"{path}: its CRS is given by GeoTIFF keys only, point formats 6 to 10 need WKT, and it is {reason}; leave "
        "--point-format out, or add a WKT record to the strip first"
    )


def build_utm(code: int) -> str | None:
    """Return the WKT of a UTM zone by its EPSG code, of WGS 84, ETRS89 or NAD83; None for other codes."""
    for codes, zero, side, (name, geographic, datum) in _UTM:
        if code in codes:
            zone = code - zero
            return (
                f'PROJCS["{name} / UTM zone {zone}{side}",GEOGCS["{name}",{datum},'
                'PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
                'UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],'
                f'AUTHORITY["EPSG","{geographic}"]],PROJECTION["Transverse_Mercator"],'
                f'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",{6 * zone - 183}],'
                'PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],'
                f'PARAMETER["false_northing",{0 if side == "N" else 10000000}],'
                'UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Easting",EAST],AXIS["Northing",NORTH],'
                f'AUTHORITY["EPSG","{code}"]]'
            )
    return None


_TOKEN = r'(?s)"((?:[^"]|"")*)"|([A-Za-z_][A-Za-z_0-9]*)\s*([\[(])?|([-+]?[0-9.][-+0-9.eE]*)|([\])])|,|\s+|(.)'


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
    for token in re.finditer(_TOKEN, text):
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

_METRE_UNIT = r'(?i)UNIT\s*[\[(]\s*"(?:met(?:er|re)s?|m)"\s*,\s*\+?0*1(?:\.0*)?(?:E[-+]?0+)?\s*[,\])]'
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
        if re.compile(_METRE_UNIT).match(wkt, start, end):
            repaired = repaired[:start] + _DEGREE + repaired[end:]
    return wkt if repaired == wkt else drop_empty_codes(repaired)


def drop_empty_codes(wkt: str) -> str:
    """Return a WKT without the code 0 of RiPROCESS: GDAL looks it up in vain, and a GeoTIFF then has no projection."""
    return re.sub(r',\s*AUTHORITY\["EPSG","0"\]', "", wkt)


def repair_records(vlrs: Iterable[las.Vlr]) -> list[las.Vlr]:
    """Return the records with the WKT among them as `repair_wkt` gives it; records that are right stay as they are."""
    found = []
    for vlr in vlrs:
        wrong = las.is_projection(vlr) and vlr.record_id == las.WKT_ID
        text = _repair_payload(vlr.payload) if wrong else None
        found.append(vlr if text is None else las.build_wkt(text))
    return found


def repair_evlr(path: Path, evlr: las.Evlr) -> bytes | None:
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
    if not las.is_projection(evlr) or evlr.record_id != las.WKT_ID or evlr.length > LONGEST_WKT:
        return None
    text = _repair_payload(las.read_evlr(path, evlr))
    return None if text is None else las.build_wkt(text).payload


def _repair_payload(payload: bytes) -> str | None:
    """The repaired WKT of a record; None where it is right."""
    text = payload.split(b"\0")[0].decode("utf-8", "replace")
    repaired = repair_wkt(text)
    return None if repaired == text else repaired


CITATION_ID = 34737
_IDS = (las.WKT_ID, las.GEOTIFF_ID, DOUBLES_ID, CITATION_ID)

_SHORT = {"metres": "m", "international feet": "ft", "US survey feet": "us-ft"}
"""Units of pictures and tables."""

_EARTH = (6.34e6, 6.40e6)
"""Distance of land from the centre of the Earth [m]: 6,357 km at the poles to 6,378 km at the equator, and room for
mountains.
"""

_HIGHEST = 3e4
"""Height that no projected strip has, be it in metres or feet."""

_NAMES = {1.0: "metres", 0.3048: "international feet", 1200 / 3937: "US survey feet"}


@frozen
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


_EPSG = r'(?:AUTHORITY|ID)\s*\[\s*"EPSG"\s*,\s*"?(\d{1,9})"?\s*\]\s*\]\s*$'


def find_epsg(wkt: str) -> int | None:
    """Return the EPSG code of the CRS that a WKT describes; None where it gives none, or 0 as RiPROCESS does."""
    found = re.search(_EPSG, wkt)
    return int(found[1]) or None if found else None


def _name_unit(metres: float | None) -> str:
    if metres is None:
        return "metres"
    for known, name in _NAMES.items():
        if abs(metres / known - 1.0) < 1e-7:
            return name
    return f"units of {metres:.10g} m" if math.isfinite(metres) else "an unknown unit"


def read_crs(path: Path, header: las.LasHeader) -> tuple[str | None, tuple[CrsUnits, ...]]:
    """Return the WKT of a strip, else code or name of its GeoTIFF keys, else None, and the units that each gives.

    Where none gives a kind or a unit, coordinates that are geocentric by their size are one more entry.
    """
    # VLRs of the header come before EVLRs after the points.
    records = {vlr.record_id: vlr.payload for vlr in header.vlrs if las.is_projection(vlr)}
    evlrs, _ = las.find_evlrs(path, header)
    for evlr in evlrs:
        new = las.is_projection(evlr) and evlr.record_id in _IDS and evlr.record_id not in records
        if new and evlr.length <= LONGEST_WKT:
            records[evlr.record_id] = las.read_evlr(path, evlr)
    units, text = [], None
    if las.WKT_ID in records:
        text = records[las.WKT_ID].split(b"\0")[0].decode("utf-8", "replace") or None
        units.append(parse_wkt(text or ""))
    if las.GEOTIFF_ID in records:
        citation = records.get(CITATION_ID, b"").split(b"\0")[0].decode("latin-1").strip("| ")
        keys = GeoKeys.parse(records[las.GEOTIFF_ID], records.get(DOUBLES_ID, b""), records.get(CITATION_ID, b""))
        text = text or keys.name or (f"GeoTIFF: {citation}" if citation else "GeoTIFF keys")
        units.append(CrsUnits(keys.kind, *keys.read_units()))
    middle = [0.5 * (low + high) for low, high in zip(header.mins, header.maxs, strict=True)]
    distance = math.hypot(*middle)
    # On the surface of the Earth as seen from its centre: projected coordinates may be as far from their origin, but
    # none has heights of tens of kilometres.
    geocentric = _EARTH[0] < distance < _EARTH[1] and abs(middle[2]) > _HIGHEST
    if geocentric and all(unit == CrsUnits() for unit in units):
        units.append(CrsUnits("geocentric"))
    return text, tuple(units)


def read_crs_definition(path: Path, header: las.LasHeader, *, heights: bool = False) -> str | None:
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
    systems = []
    for node in root.nodes if root.word in _COMPOUND else [root]:
        source = node.find("SOURCECRS") if node.word == "BOUNDCRS" else None
        systems.append(source.nodes[0] if source is not None and source.nodes else node)
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
    header = las.read_header(path)
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
