"""GeoTIFF keys of a LAS file: the kind, the EPSG codes and the units of its CRS.

`crs` and `geotiff_wkt` read the keys here. The records may hold any bytes: what cannot be read counts as missing.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from wavebatch.files.las.epsg_units import find_unit
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

        If no key gives the unit, the EPSG code of the CRS does (`epsg_units`), then a citation that names feet.
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
