"""GeoTIFF files, written tile by tile with rasterio (optional extra `gis`), so that a raster never is in memory.

`tools/raster.py` writes with it. rasterio is imported only here, when a raster is written.
"""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import ConfigError, InputError, advise_install
from wavebatch.core.frozen import frozen
from wavebatch.files.disk.publish import Draft, check_target
from wavebatch.files.disk.raw_bytes import Closing, hiding_failures
from wavebatch.files.las.crs import read_wkt

TILE = 256
"""Cells along a side of a tile: usual for web viewers and cloud storage."""


@frozen
class Band:
    """One band of a raster."""

    description: str
    unit: str
    """Empty where it has none."""


@frozen
class RasterLayout:
    """Size and place of a raster: square cells, the first row is the northernmost."""

    west: float
    north: float
    size: float
    """Side of a cell, in units of the CRS."""
    rows: int
    columns: int
    dtype: str
    no_data: float
    crs: str | None
    """WKT or `EPSG:n`."""
    unit: str = "m"
    """Of the coordinates."""


def check_raster(target: Path, *, overwrite: bool) -> None:
    """Raise ConfigError if the suffix is not that of a GeoTIFF or rasterio is missing, InputError if it exists."""
    if target.suffix.lower() not in (".tif", ".tiff"):
        raise ConfigError(f"{target}: unknown kind of raster; use .tif")
    if importlib.util.find_spec("rasterio") is None:
        raise ConfigError(f"{target}: rasters need rasterio: {advise_install('rasterio')}")
    check_target(target, overwrite=overwrite)


def find_crs_unit(text: str, where: str) -> str:
    """Return the unit of a CRS: m, ft, degree ...; ConfigError if it is not known, or not of plane coordinates."""
    found = parse_crs(text, where)
    if found.is_geographic:
        return "degree"
    names = {"metre": "m", "meter": "m", "unknown": "m"}
    unit = str(found.linear_units or "metre")
    return names.get(unit.lower(), unit)


def parse_crs(text: str, where: str) -> Any:
    """Return a CRS as rasterio has it; ConfigError if it cannot be read, or is geocentric."""
    from rasterio.crs import CRS
    from rasterio.env import Env

    with Env():
        try:
            found = CRS.from_user_input(text)
            wkt = found.to_wkt()
        except Exception as error:  # of GDAL and PROJ, for whatever a file may hold
            raise _complain(where, "read", error) from error
        if wkt.upper().startswith("GEOCCS"):
            raise ConfigError(f"{where}: coordinates are geocentric; a raster needs plane coordinates")
        return found


def _complain(where: str, what: str, error: BaseException) -> ConfigError:
    why = " ".join(str(error).split())
    remedy = "write the code of a CRS, e.g. EPSG:32632" if where == "--crs" else "give it with --crs EPSG:n"
    return ConfigError(f"{where}: the CRS cannot be {what} ({why[:120]}); {remedy}")


def _flatten(crs: Any) -> Any:
    """The CRS without its third axis: keys of a GeoTIFF have no place for one, and GDAL then writes no CRS at all.

    RiPROCESS gives its UTM zones an axis of height.
    """
    from rasterio.crs import CRS

    text = crs.to_wkt(version="WKT2_2019")
    axes = [node for node in read_wkt(text) if node.word == "AXIS"] if text.startswith("PROJCRS[") else []
    third = next((axis for axis in axes if (order := axis.find("ORDER")) and order.values == ["3"]), None)
    if third is None:
        return crs
    start = text.rindex(",", 0, third.start)
    return CRS.from_wkt((text[:start] + text[third.end :]).replace("CS[Cartesian,3]", "CS[Cartesian,2]"))


@contextlib.contextmanager
def _writing(target: Path) -> Iterator[None]:
    """Settings of GDAL: what a GeoTIFF cannot hold goes to no .aux.xml, which would have the temporary file's name.

    Errors of GDAL and of the disk become InputError.
    """
    import rasterio

    try:
        with hiding_failures(), rasterio.Env(GDAL_PAM_ENABLED="NO"):
            yield
    except (rasterio.errors.RasterioError, OSError) as error:
        reason = str(error.__cause__ or error).removesuffix(".")
        raise InputError(f"{target}: cannot be written: {reason}; free space or check permissions") from error


class RasterWriter(Closing):
    """Writes the tiles of a GeoTIFF; it appears at `publish`, whole, or not at all. A context manager.

    Tiles that are never written take no room and read as no-data. Raises InputError if the file cannot be written.
    """

    def __init__(
        self, target: Path, layout: RasterLayout, bands: Sequence[Band], tags: dict[str, str], *, overwrite: bool
    ) -> None:
        import rasterio
        from rasterio import Affine

        self._draft = Draft(target, overwrite=overwrite)
        self._target = target
        self._layout = layout
        try:
            with _writing(target):
                crs = None if layout.crs is None else _flatten(parse_crs(layout.crs, str(target)))
                self._file = rasterio.open(
                    self._draft.path, "w", driver="GTiff", width=layout.columns, height=layout.rows, count=len(bands),
                    dtype=layout.dtype, nodata=layout.no_data, crs=crs, tiled=True, blockxsize=TILE, blockysize=TILE,
                    transform=Affine(layout.size, 0, layout.west, 0, -layout.size, layout.north), interleave="band",
                    compress="deflate", predictor=3, zlevel=6, bigtiff="if_safer", sparse_ok=True,
                )  # fmt: skip
                self._file.update_tags(**tags)
                for number, band in enumerate(bands, 1):
                    self._file.set_band_description(number, band.description)
                    self._file.set_band_unit(number, band.unit)
        except BaseException as error:
            self._draft.discard()
            if layout.crs is not None and type(error).__module__.startswith("rasterio"):
                # GDAL has no keys for some numbers that it has read.
                raise _complain(str(target), "written", error) from error
            raise

    def write_tile(self, row: int, column: int, values: np.ndarray) -> None:
        """Write a tile by its place: values (bands, TILE, TILE), NaN for no-data; what lies outside is cut off."""
        from rasterio.windows import Window

        rows = min(TILE, self._layout.rows - row * TILE)
        columns = min(TILE, self._layout.columns - column * TILE)
        cut = values[:, :rows, :columns]
        if (cut == self._layout.no_data).any():
            raise ConfigError(
                f"{self._target}: a cell has the value {self._layout.no_data:g}, which stands for no data; choose "
                "another with --no-data"
            )
        stored = np.where(np.isnan(cut), self._layout.no_data, cut).astype(self._layout.dtype)
        with _writing(self._target):
            self._file.write(stored, window=Window(column * TILE, row * TILE, columns, rows))

    def publish(self) -> None:
        """End the file and give it its name."""
        import rasterio

        with _writing(self._target):
            self._file.close()
            with rasterio.open(self._draft.path) as written:
                lost = self._layout.crs is not None and written.crs is None
        if lost:
            raise ConfigError(f"{self._target}: a GeoTIFF cannot hold the CRS of the clouds; use --crs EPSG:n")
        self._draft.publish()

    def close(self) -> None:
        """Remove what was not published; may be called twice."""
        if not self._file.closed:
            with _writing(self._target):
                self._file.close()
        self._draft.discard()
