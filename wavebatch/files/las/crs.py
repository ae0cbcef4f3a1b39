"""Coordinate reference systems as far as units go: what WKT and GeoTIFF keys say a coordinate of 1 is.

Bytes of these records may be anything: what cannot be read counts as not said.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from wavebatch.files.las.header import EVLR_HEADER_SIZE, GEOTIFF_ID, WKT_ID, LasHeader, find_evlrs, is_projection
from wavebatch.files.strip.packets import MAX_EVLRS

DOUBLES_ID, CITATION_ID = 34736, 34737
_IDS = (WKT_ID, GEOTIFF_ID, DOUBLES_ID, CITATION_ID)
_MAX_RECORD = 1 << 20
_MAX_DEPTH = 64

_TOKEN = re.compile(r'"((?:[^"]|"")*)"|([A-Za-z_][A-Za-z_0-9]*)|([-+]?[0-9.][-+0-9.eE]*)|([\[(])|([\])])|,|\s+')

_MODEL, _LINEAR, _LINEAR_SIZE, _VERTICAL = 1024, 3076, 3077, 4099
_MODELS = {1: "projected", 2: "geographic", 3: "geocentric"}
_USER_DEFINED, _UNIT_CODES = 32767, range(9001, 9200)
METRES = {
    9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937, 9004: 0.3048122529845059, 9005: 0.3047972654, 9006: 0.3047995142,
    9014: 1.8288, 9015: 1853.248, 9030: 1852.0, 9036: 1000.0, 9037: 0.9143917963, 9060: 0.30479951024814694,
    9093: 1609.344, 9096: 0.9144,
}  # fmt: skip
"""Metres per unit by EPSG code of the unit."""

_NAMES = {1.0: "metres", 0.3048: "international feet", 1200 / 3937: "US survey feet"}


@dataclass(frozen=True, slots=True)
class CrsUnits:
    """What a CRS says of its coordinates; None where it says nothing."""

    kind: str | None = None
    """`projected`, `geographic`, `geocentric` or None."""
    horizontal: float | None = None
    """Metres per unit; NaN where it is a unit that nobody knows."""
    vertical: float | None = None
    """The same of heights; None: as horizontally."""

    @property
    def is_metric(self) -> bool:
        """Whether all coordinates are metres, or nothing else is said, on a plane with heights above it."""
        metric = all(value is None or abs(value - 1.0) < 1e-9 for value in (self.horizontal, self.vertical))
        return metric and self.kind in (None, "projected")

    def describe(self) -> str:
        """The units in words."""
        if self.kind == "geographic":
            return "degrees"
        if self.kind == "geocentric":
            return "geocentric (ECEF), where heights are no coordinate"
        along, up = (_name_unit(value) for value in (self.horizontal, self.vertical))
        return along if self.vertical is None or up == along else f"{along} with heights in {up}"


def _name_unit(metres: float | None) -> str:
    if metres is None:
        return "metres"
    for known, name in _NAMES.items():
        if abs(metres / known - 1.0) < 1e-7:
            return name
    return f"units of {metres:.10g} m" if math.isfinite(metres) else "a unit that is not known"


def read_crs(path: Path, header: LasHeader) -> tuple[str | None, tuple[CrsUnits, ...]]:
    """The WKT of a strip, else the names its GeoTIFF keys give, else None; and the units that each of the two says."""
    records = _read_records(path, header)
    units, text = [], None
    if WKT_ID in records:
        text = records[WKT_ID].split(b"\0")[0].decode("utf-8", "replace") or None
        units.append(parse_wkt(text or ""))
    if GEOTIFF_ID in records:
        citation = records.get(CITATION_ID, b"").split(b"\0")[0].decode("latin-1").strip("| ")
        text = text or (f"GeoTIFF: {citation}" if citation else "GeoTIFF keys")
        units.append(parse_geotiff(records[GEOTIFF_ID], records.get(DOUBLES_ID, b""), records.get(CITATION_ID, b"")))
    return text, tuple(units)


def _read_records(path: Path, header: LasHeader) -> dict[int, bytes]:
    """Payloads of the projection's records by number, those of the header before those behind the points."""
    found = {vlr.record_id: vlr.payload for vlr in header.vlrs if is_projection(vlr)}
    evlrs, _ = find_evlrs(path, replace(header, evlr_count=min(header.evlr_count, MAX_EVLRS)))
    for evlr in evlrs:
        new = is_projection(evlr) and evlr.record_id in _IDS and evlr.record_id not in found
        if new and evlr.length <= _MAX_RECORD:
            with open(path, "rb") as file:
                file.seek(evlr.start + EVLR_HEADER_SIZE)
                found[evlr.record_id] = file.read(evlr.length)
    return found


def parse_geotiff(directory: bytes, doubles: bytes = b"", texts: bytes = b"") -> CrsUnits:
    """What a GeoKeyDirectory (34735) says; doubles, texts: the records 34736 and 34737 that it points into.

    A citation that speaks of feet counts where no key names the unit: a code of a projected CRS implies one that only
    the EPSG's tables know.
    """
    keys = dict(_read_keys(directory))
    kind = _MODELS.get(keys.get(_MODEL, (0, 0))[1])
    horizontal = _read_unit(keys, _LINEAR, doubles)
    if horizontal is None and kind != "geographic":
        horizontal = _guess_unit(texts.decode("latin-1"))
    return CrsUnits(kind, horizontal, _read_unit(keys, _VERTICAL, doubles))


def _read_keys(directory: bytes) -> Iterator[tuple[int, tuple[int, int]]]:
    """Key -> (record it lies in, value or offset there); the number of keys is that of the bytes, if that is less."""
    if len(directory) < 8:
        return
    count = min(struct.unpack_from("<4H", directory)[3], len(directory) // 8 - 1)
    for number in range(count):
        key, place, _, value = struct.unpack_from("<4H", directory, 8 + 8 * number)
        yield key, (place, value)


def _read_unit(keys: Mapping[int, tuple[int, int]], key: int, doubles: bytes) -> float | None:
    if key not in keys or keys[key][0] != 0 or keys[key][1] == 0:
        return None
    code = keys[key][1]
    if code != _USER_DEFINED:
        # Leica's ALSPP writes the code of the CRS here.
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


@dataclass(slots=True)
class _Node:
    word: str
    children: list[_Node] = field(default_factory=list)
    values: list[str] = field(default_factory=list)

    def find(self, *words: str) -> _Node | None:
        return next((child for child in self.children if child.word in words), None)


_PROJECTED = ("PROJCS", "PROJCRS", "PROJECTEDCRS", "LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")
_GEOGRAPHIC = ("GEOGCS", "GEOGCRS", "GEOGRAPHICCRS")
_GEODETIC = ("GEOCCS", "GEODCRS", "GEODETICCRS")
_UPRIGHT = ("VERT_CS", "VERTCRS", "VERTICALCRS")
_COMPOUND = ("COMPD_CS", "COMPOUNDCRS")
_BOUND = {"BOUNDCRS": "SOURCECRS"}


def parse_wkt(text: str) -> CrsUnits:
    """What the WKT (1 or 2) of a CRS says."""
    root = _parse_nodes(text)
    if root is None:
        return CrsUnits()
    systems = [_unwrap(node) for node in (root.children if root.word in _COMPOUND else [root])]
    upright = next((node for node in systems if node.word in _UPRIGHT), None)
    vertical = None if upright is None else _find_unit(upright)
    for node in systems:
        if node.word in _GEOGRAPHIC:
            return CrsUnits("geographic", None, vertical)
        if node.word in _GEODETIC:
            shape = node.find("CS")
            flat = shape is not None and "ellipsoidal" in [value.lower() for value in shape.values]
            return CrsUnits("geographic" if flat else "geocentric", None, vertical)
        if node.word in _PROJECTED:
            vertical = _find_unit(node, last=True) if vertical is None else vertical
            return CrsUnits("projected", _find_unit(node), vertical)
    return CrsUnits(None, None, vertical)


def _unwrap(node: _Node) -> _Node:
    """The CRS in a bound one, or the node itself."""
    source = node.find(_BOUND[node.word]) if node.word in _BOUND else None
    return source.children[0] if source is not None and source.children else node


def _find_unit(node: _Node, *, last: bool = False) -> float | None:
    """Metres per unit of a CRS: its own unit, else that of its first axis; last: of its third axis only."""
    axes = [axis.find("LENGTHUNIT", "UNIT") for axis in node.children if axis.word == "AXIS"]
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


def _parse_nodes(text: str) -> _Node | None:
    """The outermost keyword of WKT with all that is in it; None where the text is not WKT."""
    top = _Node("")
    stack, at = [top], 0
    while at < len(text):
        token = _TOKEN.match(text, at)
        if token is None:
            return None
        at = token.end()
        quoted, word, number, opens, closes = token.groups()
        if quoted is not None or number:
            stack[-1].values.append(number or quoted or "")
        elif word and text[at : at + 1] in ("[", "("):
            stack.append(_Node(word.upper()))
            at += 1
        elif word:
            stack[-1].values.append(word)
        elif opens or (closes and len(stack) == 1) or len(stack) > _MAX_DEPTH:
            return None
        elif closes:
            done = stack.pop()
            stack[-1].children.append(done)
    return top.children[0] if len(stack) == 1 and top.children else None
