"""GeoTIFF keys of a LAS file: the kind, the EPSG codes and the units of its CRS, and the same CRS as WKT.

`crs` reads the keys here. The records may hold any bytes: what cannot be read counts as missing. Units that the keys
do not give are those of the EPSG data set as PROJ 9 holds it; a code that is not listed is taken for metres, as most
are.

The output layout calls `convert_geotiff`, because point formats 6 to 10 need WKT. UTM zones of four datums are
converted here, so that the same strip gives the same bytes on every machine; all others only with pyproj, where the
user asks for it. Before you change it: a wrong CRS is worse than none. What is not sure is None.
"""

from __future__ import annotations

import functools
import math
import re
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from wavebatch.core.errors import InputError
from wavebatch.core.optional import advise_install
from wavebatch.files.las.header import GEOTIFF_ID, Vlr, is_projection

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


@dataclass(frozen=True, slots=True)
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

        If no key gives the unit, the EPSG code of the CRS does (`find_unit`), then a citation that names feet.
        """
        horizontal, vertical = self._read_unit(_LINEAR), self._read_unit(_VERTICAL)
        if horizontal is None and self.kind != "geographic":
            horizontal = find_unit(self._find_code(_PROJECTED_CODE)) or _guess_unit(self.texts.decode("latin-1"))
        if vertical is None:
            vertical = find_unit(self._find_code(_VERTICAL_CODE), vertical=True)
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


def find_code(vlrs: Iterable[Vlr]) -> int | None:
    """Return the `sure_code` of the GeoTIFF keys in the records of a header."""
    directory = next((v.payload for v in vlrs if is_projection(v) and v.record_id == GEOTIFF_ID), b"")
    return GeoKeys.parse(directory).sure_code


def _guess_unit(text: str) -> float | None:
    words = text.lower()
    if "ftus" in words or "us survey f" in words or "us_survey_f" in words or "us feet" in words:
        return 1200 / 3937
    return 0.3048 if re.search(r"\b(feet|foot|ft)\b", words) else None


_PROJECTED_UNITS = {
    1200 / 3937: (
        "2155 2194 2204 2225-2250 2254-2255 2257-2264 2267-2268 2271-2272 2274-2279 2283-2289 2870-2895 2899-2900 "
        "2902-2908 2911-2912 2915-2920 2924-2930 2964-2968 3089 3091 3102 3363 3365 3404 3417-3438 3441-3446 "
        "3451-3459 3485 3487 3490-3512/2 3515-3553/2 3560-3570 3582-3586/2 3598 3600 3608-3632/2 3640 3642 "
        "3650-3654/2 3658-3664/2 3668-3674/2 3677 3680 3683 3686-3692/2 3696-3700/2 3728-3739 3753-3760 3991-3992 "
        "4217 4399-4413 4418-4433 4438-4457 5623-5625 5646 5654-5655 6200-6202 6411 6413 6416-6438/2 6441-6479/2 "
        "6484-6492/2 6501-6507/2 6510 6517-6543/2 6549-6555/2 6563 6565 6568 6572-6578/2 6582-6590/2 6593-6609/2 "
        "6612-6618/2 6625-6627 6633 6880 6923 6925 6966 6997 7057-7070 7128 7132 7258-7370/2 7587-7645 8035-8036 "
        "8091 8093 8096-8172/2 8177 8180 8182 8185 8189 8193 8197 8200-8210/2 8213 8216 8220 8224 8226 8380-8384/2 "
        "8387 8518-8540 9748-9749 10481-10516 10622 23301-23333 26729-26813 26847-26870 32001-32058 32064-32077 "
        "32099 32164-32167 32664-32667"
    ),
    0.3048: (
        "2222-2224 2251-2253 2256 2265-2266 2269-2270 2273 2280-2282 2867-2869 2896-2898 2901 2909-2910 2913-2914 "
        "2921-2923 2992 2994 3080 3359 3361 3479-3483/2 3588 3590 3593 3605 3634 3636 3644-3648/2 3656 3676 3679 "
        "3682 5588 6128-6141 6391 6405-6409/2 6494 6496 6499 6515 6545 6547 6557-6561/2 6570 6785-6863/2 6868 6885 "
        "6887 7119-7127 8065-8068 8312-8348/2 20050"
    ),
    1.0000135965: "29371-29385",
    0.9143985307444408: "24370-24374 24382",
    0.3047972654: "2314 3407 5589 24100",
    0.3047997101815088: "2136 2159-2160",
    0.201166195164: "2066 30200",
    0.201168: "3139-3140",
    0.9143984146160287: "27291-27292",
    0.3047994715386762: "29872",
    0.9143917962: "5472",
    20.116756: "3167",
    20.116765121552632: "29871",
    20.116782494375872: "24571",
    1000.0: "22300",
}
"""Codes of projected CRSs by the size of their unit [m]; `a-b`: all from a to b, `a-b/2`: every second one."""

_VERTICAL_UNITS = {
    0.3048: "5614 6130-6132 8050-8051 8228 8897",
    1200 / 3937: "5702 6358-6360 8052-8053",
    0.3048007491: "5754",
}
"""The same of vertical CRSs."""


def find_unit(code: int, *, vertical: bool = False) -> float | None:
    """Metres per unit of a CRS by its EPSG code; None for metres and for codes that are not known."""
    return _units(vertical).get(code)


@functools.cache
def _units(vertical: bool) -> dict[int, float]:
    table = _VERTICAL_UNITS if vertical else _PROJECTED_UNITS
    return {code: unit for unit, codes in table.items() for text in codes.split() for code in _expand(text)}


def _expand(text: str) -> Iterator[int]:
    span, _, step = text.partition("/")
    first, _, last = span.partition("-")
    return iter(range(int(first), int(last or first) + 1, int(step or 1)))


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


def convert_geotiff(path: Path, vlrs: Iterable[Vlr], *, asked: bool) -> str | None:
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
