"""The CRS and the units of any LAS file in short words, for pictures and tables.

`wavebatch plot` shows them and refuses to draw clouds of different CRS in one picture.
"""

from __future__ import annotations

import re
from pathlib import Path

from wavebatch.files.las.crs import find_epsg, read_crs
from wavebatch.files.las.geotiff_wkt import find_code
from wavebatch.files.las.header import read_header

_SHORT = {"metres": "m", "international feet": "ft", "US survey feet": "us-ft", "degrees": "deg"}


def describe_crs(path: Path) -> tuple[str, str]:
    """Return the name of a file's CRS, empty if it gives none, and the unit of x and y.

    The unit is m if the file gives none: most strips without a CRS are in metres. Raises InputError for a file that is
    not LAS.
    """
    header = read_header(path)
    text, units = read_crs(path, header)
    along = next((one for one in units if one.kind == "geographic" or one.horizontal is not None), None)
    words = "metres" if along is None else along.describe().split(" with ")[0]
    code = find_code(header.vlrs)
    if text and text.rstrip().endswith("]"):
        name = name_crs(text)
    else:
        name = f"EPSG:{code}" if code else text or ""
    return name, _SHORT.get(words, "m" if words == "metres" else "units")


def name_crs(text: str) -> str:
    """Return the name of a CRS in WKT with its EPSG code; other text as it is."""
    named = re.match(r'\s*\w+\s*[\[(]\s*"([^"]*)"', text)
    if named is None:
        return " ".join(text.split())
    code = find_epsg(text)
    return named[1] + (f" (EPSG:{code})" if code else "")
