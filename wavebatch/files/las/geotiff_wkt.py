"""WKT of a CRS that a strip gives by GeoTIFF keys only, because point formats 6 to 10 need WKT.

The output layout calls `convert_geotiff`. UTM zones of four datums are converted here, so that the same strip gives the
same bytes on every machine; all others only with pyproj, where the user asks for it. Before you change it: a wrong CRS
is worse than none. What is not sure is None.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from wavebatch.core.errors import InputError
from wavebatch.core.optional import advise_install
from wavebatch.files.las.geo_keys import find_code
from wavebatch.files.las.header import Vlr

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
