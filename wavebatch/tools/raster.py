"""`wavebatch grid`: columns of clouds of any size as a GeoTIFF, in memory that does not grow with clouds or raster.

Clouds are read twice: here for the extent, then by `cells.compute_tiles`. Tiles without a point are not written at all.

Forest metrics of cells come from voxels: cover, heights of light, leaf area density and index, each with its error.
Formulas and sources: docs/forest.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from wavebatch import __version__
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.schema import Above, CheckedOptions, Range, check_options, option
from wavebatch.files.cloud.column_names import read_provenance
from wavebatch.files.cloud.point_filter import EVERY, PointFilter
from wavebatch.files.geotiff_file import Band, RasterLayout, RasterWriter, find_crs_unit, parse_crs
from wavebatch.files.las.crs import read_crs, read_crs_definition
from wavebatch.files.las.header import read_header
from wavebatch.files.las.read_points import read_checked_header
from wavebatch.kernels.physics.gap_probability import ASSUMED_ERROR
from wavebatch.tools import cells

COLUMNS = ("x", "y", "height", "light", "path", "share", "ground", "free_path", "attenuation", "attenuation_error")
"""Columns of voxels that are used."""

QUANTILES = (25, 50, 75, 95)
"""Parts of the light that plants catch, in percent."""

LEAST_LIGHT = 10.0
"""Rays that must end in a cell: of fewer, the error of a cover of one half is larger than .16."""

LEAST_GROUND = 1.0
"""Rays that must reach the ground of a cell: else nothing tells how much light the lowest leaves got, or where the
ground is."""

LEAST_SIDE = 4
"""Voxels along a cell: fewer columns of voxels do not show how much they differ."""

TALLEST = 150.0
"""No tree is higher [m]: voxels above are noise, birds or clouds."""

KNOWN, FEW_RAYS, NO_GROUND = range(3)
"""Values of the last band: why the others have no data."""


@frozen
class ForestOptions(CheckedOptions):
    """How metrics are computed."""

    leaf_projection: Annotated[float, Range(0.1, 1.0)] = option(
        0.5, "Area of a leaf that the light sees, over its area: 0.5 for leaves without a preferred direction, 1 for "
        "level ones below the sensor.", form="G",
    )  # fmt: skip
    layer: Annotated[float, Above(0.0, TALLEST)] = option(
        5.0, "Height of the layers that leaf area density is written for [m].", form="M"
    )


class _Voxels(NamedTuple):
    """Voxels, each once, sorted by column, then layer: arrays (n,)."""

    cell: np.ndarray
    column: np.ndarray
    layer: np.ndarray
    """Counted from the ground of the column."""
    x: np.ndarray
    y: np.ndarray
    height: np.ndarray
    path: np.ndarray
    light: np.ndarray
    caught: np.ndarray
    """Light, by plants and ground."""
    plants: np.ndarray
    free_path: np.ndarray
    attenuation: np.ndarray
    error: np.ndarray


class _Sums(NamedTuple):
    """What layers add to a leaf area, f8 (n,)."""

    near: np.ndarray
    """With the attenuation of each voxel."""
    clumped: np.ndarray
    """By how much less it is with the attenuation of blocks of voxels, which extrapolates to voxels without size."""
    variance: np.ndarray
    """Of `near`, by the errors of the voxels."""
    unknown: np.ndarray
    """Part of `near` that stands for voxels which too little light reached."""

    def total(self, group: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Leaf area, and its variance, of each group, f8 (number,)."""
        near, clumped, variance, unknown = (np.bincount(group, part, number) for part in self)
        return np.maximum(near + clumped, 0.0), variance + clumped**2 + unknown**2


class Forest:
    """Computes the metrics of cells from the voxels of files that `voxelize --forest` made.

    Raises ConfigError for other files, for voxels of several sizes, for cells smaller than LEAST_SIDE voxels, and for
    layers thinner than a voxel.
    """

    def __init__(self, paths: Sequence[Path], cell_size: float, options: ForestOptions) -> None:
        facts = []
        for path in paths:
            # The record that voxelize wrote.
            found = next((one for one in read_provenance(read_header(path)) if one.get("forest")), None)
            if found is None:
                raise ConfigError(
                    f"{path}: --forest needs voxels: wavebatch voxelize STRIP --size 1 --forest -o voxels.laz"
                )
            ratio = found.get("reflectance_ratio")
            ratio = ratio if isinstance(ratio, dict) else {}
            rest = ratio.get("error") or 1.0, found.get("footprint_m") or 1.0
            numbers = found.get("size_m"), ratio.get("ratio"), *rest
            if not all(isinstance(value, int | float) and 0 < value < np.inf for value in numbers):
                raise ConfigError(f"{path}: its record of voxels is damaged, at size_m, footprint_m or "
                                  "reflectance_ratio; make it anew with wavebatch voxelize --forest")  # fmt: skip
            facts.append((path, found))
        self.size = facts[0][1]["size_m"]
        for name, words in (("size_m", "--size"), ("ground_height_m", "--ground-height")):
            first = facts[0][1].get(name)
            other = next((path for path, one in facts if one.get(name) != first), None)
            if other is not None:
                raise ConfigError(f"{other}: has other voxels than {paths[0]}, of {words} {first}; give one")
        if cell_size < LEAST_SIDE * self.size:
            raise ConfigError(f"--size {cell_size:g}: cells need {LEAST_SIDE} voxels along a side; give "
                              f"{LEAST_SIDE * self.size:g} or more")  # fmt: skip
        if options.layer < self.size:
            raise ConfigError(f"--layer {options.layer:g}: layers are thinner than the voxels, so that some would have "
                              f"none; give {self.size:g} or more")  # fmt: skip
        self.options = options
        # Of footprints, in voxels: what is smeared over both is as wide as the root of the sum of their squares. Blocks
        # are twice that, so that clumps are compared on two scales that both are seen.
        wide = max(one.get("footprint_m") or 0.0 for _, one in facts) / self.size
        self.block = math.ceil(math.sqrt(4.0 + 3.0 * wide**2) - 1e-9)
        near, far = math.hypot(1.0, wide), math.hypot(self.block, wide)
        self.reach = near / (far - near)
        """Share of what the leaf area of blocks differs by from that of voxels: so far voxels are from size 0."""
        ratios = [one["reflectance_ratio"] for _, one in facts]
        errors = (ASSUMED_ERROR if one.get("source") == "assumed" else (one.get("error") or 0.0) / one["ratio"]
                  for one in ratios)  # fmt: skip
        self.ratio_error = max(errors)
        """Standard deviation of the logarithm of the ratio of reflectances, common to all cells."""
        self.layers = 0
        self.reasons = np.zeros(3, np.int64)
        """Cells by KNOWN, FEW_RAYS, NO_GROUND."""

    def compute(self, cell: np.ndarray, values: np.ndarray, number: int) -> np.ndarray:
        """Bands f8 (m, number) from the cell of each voxel i8 (n,) and its COLUMNS f8 (n, 10); NaN without voxels."""
        height = values[:, 2]
        inside = (height + 0.5 * self.size > 0) & (height < TALLEST)
        filled, cell = np.unique(cell, return_inverse=True)
        n, voxels = len(filled), _join(values[inside], cell[inside], self.size)
        columns, column = np.unique(voxels.column, return_inverse=True)
        owner = np.zeros(len(columns), np.int64)
        owner[column] = voxels.cell
        # Light that plants and ground caught, and that the ground caught.
        light, soil = (np.bincount(cell, values[:, 3] * _zeroed(values[:, part]), n) for part in (5, 6))
        plants = light - soil
        cover = plants / np.where(light > 0, light, 1.0)
        # Columns differ by what grows in them and by the rays that they got: the spread of their sums has both.
        rest = np.bincount(column, voxels.plants - cover[voxels.cell] * voxels.caught, len(columns))
        count = np.maximum(np.bincount(owner, minlength=n), 2)
        variance = np.bincount(owner, rest**2, n) * count / (count - 1) / np.where(light > 0, light, 1.0) ** 2
        cover_err = np.sqrt(variance + (cover * (1.0 - cover) * self.ratio_error) ** 2)
        heights = [_find_height(voxels, n, 0.01 * part) for part in QUANTILES]

        slot, sums = self._add_layers(voxels, columns, column, owner)
        projection, common = self.options.leaf_projection, cover * self.ratio_error
        area, variance = sums.total(slot[0], n)
        area_err = np.sqrt(variance + common**2) / projection
        # The layer that a height lies in.
        layer, place = (np.clip(height / self.options.layer, 0, self.layers - 1).astype(np.int64)
                        for height in (slot[1], voxels.height))  # fmt: skip
        dense, variance = (one.reshape(n, -1).T for one in sums.total(slot[0] * self.layers + layer, n * self.layers))
        caught = np.bincount(place * n + voxels.cell, voxels.plants, n * self.layers).reshape(-1, n)
        below = np.cumsum(caught, axis=0) - caught + soil
        lit = np.where(below > 0, below, 1.0)
        common = self.ratio_error * soil * (1.0 / lit - 1.0 / (lit + caught))
        per_metre = 1.0 / (projection * self.options.layer)
        bands = np.stack([cover, cover_err, *heights, area / projection, area_err, *(dense * per_metre),
                          *(np.sqrt(variance + common**2) * per_metre)])  # fmt: skip
        reason = np.where(light < LEAST_LIGHT, FEW_RAYS, np.where(soil < LEAST_GROUND, NO_GROUND, KNOWN))
        self.reasons += np.bincount(reason, minlength=3)
        result = np.full((len(bands) + 1, number), np.nan)
        result[:, filled] = np.concatenate([np.where(reason == KNOWN, bands, np.nan), reason[None]])
        return result

    def _add_layers(
        self, voxels: _Voxels, columns: np.ndarray, column: np.ndarray, owner: np.ndarray
    ) -> tuple[tuple[np.ndarray, np.ndarray], _Sums]:
        """Cell and mean height of each layer of voxels, i8 and f8 (k,) [m], and what it adds to the depth of its cell.

        A layer has the mean of its voxels. Above the highest voxel of a column is air. Voxels that too few rays reached
        count as the darkest others of their layer.
        """
        top = np.full(len(columns), -1)
        np.maximum.at(top, column, voxels.layer)
        most = int(top.max(initial=0)) + 2
        keys, slot = np.unique(voxels.cell * most + voxels.layer, return_inverse=True)
        cell, height = keys // most, np.bincount(slot, voxels.height) / np.bincount(slot)
        tops = np.sort(owner * most + top)
        air = np.searchsorted(tops, keys) - np.searchsorted(tops, cell * most)
        there = np.bincount(owner)[cell]
        known = np.isfinite(voxels.attenuation)
        # A corner that rays cut counts less: up to two rays across, by their path.
        weight = np.where(known, np.minimum(voxels.path / (2.0 * self.size), 1.0), 0.0)
        thick = np.clip(voxels.height + 0.5 * self.size, 0.0, self.size)
        whole = np.bincount(slot, weight, len(keys)) + air
        whole = np.where(whole > 0, whole, 1.0)
        part = np.stack([voxels.cell, voxels.x // self.block, voxels.y // self.block, voxels.layer // 2])
        block = np.unique(part, axis=1, return_inverse=True)[1].ravel()
        free, caught = (np.bincount(block, np.where(known, part, 0.0)) for part in (voxels.free_path, voxels.plants))
        both = (_zeroed(voxels.attenuation), (caught / np.where(free > 0, free, 1.0))[block])
        unknown = (1.0 - (air + np.bincount(slot, known, len(keys))) / there).clip(0.0, 1.0)
        seen = (1.0 - unknown) / whole
        # What too little light reached lies behind dense leaves, as the darkest of the known voxels do.
        dark = weight / np.where(voxels.light > 0, voxels.light, 1.0)
        divisor = np.bincount(slot, dark, len(keys))
        divisor = np.where(divisor > 0, divisor, 1.0)
        (near, hidden), (far, other) = ((np.bincount(slot, weight * thick * one, len(keys)) * seen,
                                         np.bincount(slot, dark * thick * one, len(keys)) * unknown / divisor)
                                        for one in both)  # fmt: skip
        variance = np.bincount(slot, (weight * thick * _zeroed(voxels.error)) ** 2, len(keys)) * seen**2
        clumped = self.reach * (near + hidden - far - other)
        return (cell, height), _Sums(near + hidden, clumped, variance, hidden)


def _join(values: np.ndarray, cell: np.ndarray, size: float) -> _Voxels:
    """Voxels of all files; those of several strips in the same place become one."""
    x, y = (np.floor(values[:, axis] / size).astype(np.int64) for axis in (0, 1))
    layer = np.floor(values[:, 2] / size + 0.5).astype(np.int64)
    column = (x << 32) + y
    order = np.lexsort((layer, column))
    new = np.append(True, (np.diff(column[order]) != 0) | (np.diff(layer[order]) != 0))[: len(order)]
    group = np.empty(len(order), np.int64)
    group[order] = np.cumsum(new) - 1
    first, n = order[new], int(new.sum())
    caught, free = values[:, 3] * _zeroed(values[:, 5]), np.where(np.isfinite(values[:, 8]), values[:, 7], 0.0)
    plants = caught - values[:, 3] * _zeroed(values[:, 6])
    sums = values[:, 4], values[:, 3], caught, plants, free
    path, light, caught, plants, whole = (np.bincount(group, one, n) for one in sums)
    divisor = np.where(whole > 0, whole, np.nan)
    attenuation = np.bincount(group, free * _zeroed(values[:, 8]), n) / divisor
    error = np.sqrt(np.bincount(group, (free * _zeroed(values[:, 9])) ** 2, n)) / divisor
    return _Voxels(cell[first], column[first], layer[first], x[first], y[first], values[first, 2], path, light, caught,
                   plants, whole, attenuation, error)  # fmt: skip


def _find_height(voxels: _Voxels, number: int, part: float) -> np.ndarray:
    """Height below which plants caught a part of their light, f8 (number,) [m]; between the middles of layers."""
    most = int(voxels.layer.max(initial=0)) + 1
    keys, slot = np.unique(voxels.cell * most + voxels.layer, return_inverse=True)
    light = np.bincount(slot, voxels.plants, len(keys))
    kept = light > 0
    height = (np.bincount(slot, voxels.plants * voxels.height, len(keys)) / np.where(kept, light, 1.0))[kept]
    cell, light = keys[kept] // most, light[kept]
    whole = np.bincount(cell, light, number)
    before = np.cumsum(light) - light
    start = np.full(number, np.inf)
    np.minimum.at(start, cell, before)
    # Cells follow each other on one axis: the part of the light below the middle of each layer, from 0 to 1.
    rank = cell + (before - start[cell] + 0.5 * light) / whole[cell]
    found = np.full(number, np.nan)
    filled = np.flatnonzero(whole > 0)
    if len(filled):
        first, last = np.searchsorted(cell, filled), np.searchsorted(cell, filled, "right") - 1
        at = np.searchsorted(rank, filled + part)
        low, high = np.clip(at - 1, first, last), np.clip(at, first, last)
        share = (filled + part - rank[low]) / np.where(high > low, rank[high] - rank[low], 1.0)
        found[filled] = height[low] + share.clip(0.0, 1.0) * (height[high] - height[low])
    return found


def _zeroed(values: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(values), values, 0.0)


def _find_common_crs(paths: Sequence[Path]) -> tuple[str | None, str, list[Path]]:
    """The CRS of all clouds, the unit of their coordinates, and those without a CRS where others have one."""
    unit, unnamed, first = "m", [], None
    for path in paths:
        found = read_crs_definition(path, read_checked_header(path, waveforms=False).header)
        if found is None:
            unnamed.append(path)
            continue
        unit = find_crs_unit(found, str(path))
        if first and first[1] != found and parse_crs(first[1], str(path)) != parse_crs(found, str(path)):
            raise ConfigError(f"{path}: has another CRS than {first[0]}; make a raster of each, or give --crs")
        first = first or (path, found)
    return (None, unit, []) if first is None else (first[1], unit, unnamed)


MOST_SIDE, MOST_CELLS = 2_000_000, 100_000_000_000
"""Most cells along a side, and of the raster (300 km x 300 km at 1 m): more is damage of coordinates, clouds of several
projects, or a size that was meant in another unit."""

_EXACT = float(1 << 23)
"""Steps of a column that float32 holds apart; larger values are written as float64."""


@frozen
class GridOptions:
    """What is written of which points."""

    columns: tuple[str, ...] = ()
    """A band for each; points are counted without one."""
    selection: PointFilter = EVERY
    """The points that are used."""
    statistic: Literal["mean", "median", "min", "max", "std", "count", "density"] = option(
        "mean", "Statistic of the values in a cell; density is points per area."
    )
    bbox: cells.Box | None = None
    """Only this part."""
    size: Annotated[float, Above(0.0, cells.LARGEST_SIZE)] = option(
        1.0, "Side of a cell, in the unit of the coordinates. Borders are multiples of it, so that neighbouring "
        "rasters fit together.", form="M",
    )  # fmt: skip
    crs: str | None = option(None, "CRS of the clouds, e.g. EPSG:32632.", form="CRS", unset="that of their headers")
    no_data: float = option(-9999.0, "Value of cells without data; nan is possible.", form="VALUE")
    forest: ForestOptions | None = None
    """Metrics of voxels, in place of columns and a statistic."""


@dataclass(slots=True, kw_only=True)
class GridResult(cells.Placed):
    """What was written."""

    layout: RasterLayout
    unnamed: tuple[Path, ...] = ()
    """Clouds without a CRS, if others have one."""
    filled: int = 0
    """Cells that have a value in a band at least."""
    bands: tuple[Band, ...] = ()
    """Name and unit of each band."""
    reasons: tuple[int, ...] = ()
    """Of a forest: cells with metrics, with too few rays, and without light on the ground."""


def write_grid(
    paths: Sequence[Path], target: Path, options: GridOptions, *, overwrite: bool = False,
    in_memory: int = cells.POINTS_IN_MEMORY,
) -> GridResult:
    """Write the raster; in_memory: points at a time.

    Raises ConfigError for wrong options, InputError for clouds that cannot be read or have no point to write.
    """
    metrics = None
    if options.forest is not None:
        if options.selection:
            raise ConfigError("--forest: metrics need all voxels of a cell: leave out --where, --class and flags; "
                              "--bbox takes whole cells")  # fmt: skip
        metrics = Forest(paths, options.size, options.forest)
        options = replace(options, columns=tuple(COLUMNS))
    cells.check_bounds(options.bbox, paths)
    cells.check_statistic(next(iter(options.columns), None), options.statistic)
    check_options(options)
    if not (math.isnan(options.no_data) or abs(options.no_data) <= float(np.finfo(np.float32).max)):
        raise ConfigError(f"--no-data must be nan or a number that float32 holds, got {options.no_data:g}")
    if options.bbox is not None:  # up to the next borders of cells, so that no cell holds a part of its points only
        west, south, east, north = (value / options.size for value in options.bbox)
        borders = math.floor(west), math.floor(south), math.ceil(east), math.ceil(north)
        options = replace(options, bbox=tuple(border * options.size for border in borders))
    for path in paths:
        units = read_crs(path, read_checked_header(path, waveforms=False).header)[1]
        if any(one.kind == "geocentric" for one in units):
            raise ConfigError(f"{path}: coordinates are geocentric (ECEF): x and y are no map; project the clouds")
    crs, unnamed = options.crs, []
    if crs is None:
        crs, unit, unnamed = _find_common_crs(paths)
    else:
        unit = find_crs_unit(crs, "--crs")
    if metrics is not None and unit != "m":
        raise ConfigError(f"{paths[0]}: --forest: voxels are measured in metres, and coordinates are in {unit}; "
                          "project the strip to a CRS in metres first")  # fmt: skip
    clouds = cells.Clouds(paths, options.columns or (None,), options.selection)
    for one in clouds.every:
        cells.check_statistic(one.name, options.statistic, one, paths[0])
    low, high, points = np.full(2, np.inf), np.full(2, -np.inf), 0
    largest = np.zeros(len(clouds.every))
    for _, rows, _ in clouds.read_all():
        rows = rows[cells.is_in_bounds(rows, options.bbox)]
        if len(rows):
            places = np.stack([rows["x"], rows["y"]], axis=1)
            low, high = np.minimum(low, places.min(axis=0)), np.maximum(high, places.max(axis=0))
            largest = np.maximum(largest, np.nan_to_num(np.abs(rows["values"])).max(axis=0, initial=0.0))
            points += len(rows)
    if not points:
        wanted, selection = ["a position within --bbox" if options.bbox else "a position"], options.selection
        wanted += ["the chosen flags"] if selection.flags or selection.drop_flags else []
        wanted += ["what --where asks for"] if selection.where is not None else []
        raise InputError(f"{clouds.paths[0]}: no raster: no point has {' and '.join(wanted)}")
    box = options.bbox or (*low.tolist(), *high.tolist())
    if unit == "degree" and options.size > max(box[2] - box[0], box[3] - box[1]):
        raise ConfigError(f"{paths[0]}: coordinates are degrees, and cells of {options.size:g} degrees are larger than "
                          "the clouds; --size 1e-05 gives cells of about 1 m")  # fmt: skip
    west, south, east, north = box
    size = options.size
    columns, rows = (east - west) / size, (north - south) / size
    if max(columns, rows) > MOST_SIDE or columns * rows > MOST_CELLS:
        raise ConfigError(
            f"{paths[0]}: {columns:.3g} x {rows:.3g} cells of {size:g} are too many (at most {MOST_CELLS:.0g}): points "
            f"lie from {west:.10g}, {south:.10g} to {east:.10g}, {north:.10g}; clouds far apart need a raster each; if "
            "a coordinate is damaged, give --bbox; or give a larger --size"
        )
    grid = cells.Grid.cover(box, size)
    if options.bbox is not None:  # its cells end at a border, where no other cell begins
        first = round(west / size), round(south / size)
        last = max(round(east / size) - 1, first[0]), max(round(north / size) - 1, first[1])
        grid = cells.Grid(size, *first, last[1] - first[1] + 1, last[0] - first[0] + 1)
    west, _, _, north = grid.extent
    # float32 where that holds neighbouring values of each column apart.
    wide = (one.name == "gps_time" or one.step > 0 and top > _EXACT * one.step
            for one, top in zip(clouds.every, largest, strict=True))  # fmt: skip
    dtype = "float64" if metrics is None and any(wide) else "float32"
    layout = RasterLayout(west, north, grid.size, grid.rows, grid.columns, dtype, options.no_data, crs, unit)
    if metrics is None:
        statistic = options.statistic
        units = {"count": "", "density": f"1/{unit}2"}
        bands = [Band(f"{statistic} of {one.name}", units.get(statistic, one.unit.strip("-"))) for one in clouds.every]
    else:
        step = metrics.options.layer
        top = min(largest[COLUMNS.index("height")] + 0.5 * metrics.size, TALLEST)
        metrics.layers = max(int(np.ceil(top / step)), 1)
        bands = [Band("cover", ""), Band("cover_err", ""), *(Band(f"light_height_{part}", "m") for part in QUANTILES)]
        bands += [Band("leaf_area_index", ""), Band("leaf_area_index_err", "")]
        for name in ("leaf_area_density", "leaf_area_density_err"):
            bands += [Band(f"{name} {i * step:g}-{(i + 1) * step:g} m", "1/m") for i in range(metrics.layers)]
        bands.append(Band("no_data_reason", ""))
        statistic = metrics.compute
    result = GridResult(layout=layout, bands=tuple(bands), unnamed=tuple(unnamed))
    tags = {"TIFFTAG_SOFTWARE": f"wavebatch {__version__}"}
    if metrics is None:
        tags["STATISTIC"] = options.statistic
    else:  # what the metrics assume
        tags |= {"LEAF_PROJECTION": f"{metrics.options.leaf_projection:g}", "VOXEL_SIZE": f"{metrics.size:g}"}
    with RasterWriter(target, layout, bands, tags, overwrite=overwrite) as writer:
        tiles = cells.compute_tiles(clouds, statistic, grid, points, result, options.bbox, in_memory=in_memory)
        for row, column, values in tiles:
            result.filled += int(np.isfinite(values).any(axis=0).sum())
            writer.write_tile(row, column, values)
        writer.publish()
    if metrics is not None:
        result.reasons = tuple(metrics.reasons.tolist())
        result.values = (*[result.reasons[KNOWN]] * (len(bands) - 1), result.filled)
    return result
