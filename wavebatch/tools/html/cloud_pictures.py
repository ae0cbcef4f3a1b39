"""Maps and histograms of the columns of a cloud for the pages, from an even sample of its points.

`strip_part` draws them. `wavebatch plot` and `wavebatch grid` show every point, and finer cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from wavebatch.files.cloud.cloud_reader import ColumnFacts, ColumnReader
from wavebatch.files.las.crs import describe_crs
from wavebatch.tools.even_sample import EvenSample
from wavebatch.tools.html.charts import draw_histogram, draw_map
from wavebatch.tools.plots.raster import Raster, choose_grid, find_shown
from wavebatch.tools.plots.values import Tally, robust_limits
from wavebatch.tools.rasters.cells import compute_cells

SAMPLED = 400_000
"""Most points of the sample."""

MOST_CELLS = 160
"""Cells along the longer side of a map, which is small."""

BINS = 60


def picture_cloud(path: Path, columns: Sequence[str]) -> tuple[list[str], list[str]]:
    """Histograms and maps (figures) of the columns that the cloud has; raises InputError if it cannot be read."""
    sample = EvenSample(SAMPLED)
    with ColumnReader(path, *columns, missing_ok=True) as reader:
        for rows in reader.read_pieces():
            good = np.isfinite(rows["x"]) & np.isfinite(rows["y"])
            sample.add({"place": np.stack([rows["x"], rows["y"]], axis=1)[good], "values": rows["values"][good]})
        facts = reader.facts
    seen = sample.read()
    if not seen or not len(seen["place"]):
        return [], []
    parts = [draw_column(one, values) for one, values in zip(facts, seen["values"].T, strict=True)]
    note = f"; every {sample.step}th point" if sample.step > 1 else ""
    return parts, [draw_map(one, note) for one in map_columns(path, facts, sample)]


def draw_column(facts: ColumnFacts, values: np.ndarray) -> str:
    """The histogram of a column without far outliers; empty without values."""
    values = values[np.isfinite(values)]
    if not len(values):
        return ""
    low, high = robust_limits(values, float(values.min()), float(values.max()))
    room = 0.5 * (high == low) * max(abs(high), 1.0)
    counts, edges = np.histogram(values, BINS, (low - room, high + room))
    beyond = len(values) - int(counts.sum())
    return draw_histogram(edges, counts, title=facts.name, label=f"{facts.name} [{facts.unit}]", beyond=beyond)


def map_columns(path: Path, facts: Sequence[ColumnFacts], sample: EvenSample) -> list[Raster]:
    """The density of the points, and the mean of each column that has values."""
    seen = sample.read()
    places = seen["place"]
    box = (*places.min(axis=0).tolist(), *places.max(axis=0).tolist())
    grid = choose_grid(str(path), sample, box, None, fixed=False, most=MOST_CELLS)
    crs = describe_crs(path)
    row, column, inside = grid.place(*places.T)
    cell = (row * grid.columns + column)[inside]
    every = np.full(len(places), float(sample.step))
    points = ColumnFacts("points", "-", "", 0.0)
    wanted = [("density", points, every)]
    wanted += [("mean", one, values) for one, values in zip(facts, seen["values"].T, strict=True)]
    maps, size = [], grid.rows * grid.columns
    for statistic, one, values in wanted:
        found = compute_cells(statistic, cell, values[inside], size, grid.size**2 / sample.step)
        if np.isfinite(found).any():
            found = found.reshape(grid.rows, grid.columns)
            maps.append(Raster((path.name,), one, statistic, grid, found, Tally(), 0, find_shown(found), crs))
    return maps
