"""Reads the segments that `wavebatch slice` wrote, and measures how much of them lies at each height.

`wavebatch plot profile` calls `profile_segments`. A segment is not a point: it counts in every bin that it crosses, by
the share of its height that lies there; a level segment counts in one.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.suggest import nearest
from wavebatch.files.cloud.cloud_reader import ColumnFacts
from wavebatch.tools.plots.sections import Profile, place_heights
from wavebatch.tools.plots.values import Tally, check_statistic, name_paths
from wavebatch.tools.slices.output import SEGMENT_SUFFIXES

UNIT = "units of the strip"
"""Of lengths and heights: the file does not say which they are."""

_COLUMNS = {
    "length": ("units", ""), "slope": ("deg", "angle above the horizontal"),
    "residual": ("-", "rms distance of the centroids from the line"), "pulses": ("-", "pulses of a segment"),
    "weight": ("DN", "sum of the samples"),
}  # fmt: skip
"""Columns that can be summed or averaged, with unit and meaning."""

REMEDY = "make it again with `wavebatch slice`"
"""What to do about a damaged file."""

_PIECE = 100_000


def is_segments(path: Path) -> bool:
    """Whether a file is one of segments, by its name."""
    return path.suffix.lower() in SEGMENT_SUFFIXES


def read_segments(path: Path, column: str | None) -> tuple[np.ndarray, np.ndarray]:
    """Heights of both ends f8 (n, 2), and the values of a column (n,), ones without a column.

    Raises InputError for a file that cannot be read or holds no segments, ConfigError for another column.
    """
    if column is not None and column not in _COLUMNS:
        raise ConfigError(f"{path}: has no column {column!r}; {nearest(column, _COLUMNS)}")
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = _read_features(json.load(file)) if path.suffix.lower() == ".geojson" else csv.DictReader(file)
            found = [_read_row(row, column) for row in rows]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}; check the name and the access") from error
    except KeyError as error:
        raise InputError(f"{path}: holds no segments of `wavebatch slice`: {error} is missing; {REMEDY}") from error
    except (ValueError, TypeError, AttributeError, IndexError, RecursionError, csv.Error) as error:
        raise InputError(f"{path}: holds no segments of `wavebatch slice` ({error}); {REMEDY}") from error
    values = np.array(found, np.float64).reshape(-1, 3)
    if not np.isfinite(values).all():
        bad = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0]) + 1
        raise InputError(f"{path}: segment {bad} holds a value that is no finite number; {REMEDY}")
    return values[:, :2], values[:, 2]


def _read_row(row: dict[str, str], column: str | None) -> tuple[float, float, float]:
    return float(row["z1"]), float(row["z2"]), 1.0 if column is None else float(row[column])


def _read_features(document: dict) -> Iterable[dict]:
    """Segments of a GeoJSON file as rows of the table."""
    for feature in document["features"]:
        start, end = feature["geometry"]["coordinates"]
        yield {**feature["properties"], "z1": start[2], "z2": end[2]}


def profile_segments(
    paths: Sequence[Path], column: str | None, statistic: str, *, size: float | None = None, each: bool = False
) -> Profile:
    """The number of segments, or the sum or mean of a column, per height.

    Arguments and errors as `sections.measure_profile`; sums and means weight a segment by the share of its height
    in a bin.
    """
    check_statistic(column, statistic)
    files = [read_segments(path, column) for path in paths]
    heights = np.concatenate([ends for ends, _ in files])
    if not len(heights):
        raise InputError(f"{paths[0]}: holds no segment: nothing to draw")
    edges = place_heights(heights.ravel(), float(heights.min()), float(heights.max()), size, 0.0)
    series = len(paths) if each else 1
    sums, numbers = np.zeros((series, len(edges) - 1)), np.zeros((series, len(edges) - 1))
    for number, (ends, values) in enumerate(files):
        for start in range(0, len(ends), _PIECE // len(edges) + 1):
            part = slice(start, start + _PIECE // len(edges) + 1)
            share = share_heights(ends[part], edges)
            numbers[number if each else 0] += share.sum(axis=0)
            sums[number if each else 0] += values[part] @ share
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(numbers > 0, sums / numbers, np.nan)
    unit, meaning = _COLUMNS[column] if column else ("-", "")
    names = name_paths(paths)
    outside = int(np.count_nonzero((heights.max(axis=1) < edges[0]) | (heights.min(axis=1) >= edges[-1])))
    return Profile(
        facts=ColumnFacts(column or "segments", unit, meaning, 0.0),
        statistic=statistic,
        names=names if each or len(paths) == 1 else (f"{len(paths)} files",),
        edges=edges,
        values={"count": numbers, "sum": sums, "mean": mean}[statistic],
        outside=outside,
        total=Tally(len(heights), 0, 0, len(heights)),
        unit=UNIT,
        noun="segments",
    )


def share_heights(ends: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Share of the height of each segment in each bin, f8 (n, b).

    ends: heights of both ends, f8 (n, 2). Bins hold their lower edge; a level segment lies in one bin.
    """
    low, high = ends.min(axis=1), ends.max(axis=1)
    span = high - low
    level = span < 1e-9 * max(float(np.abs(edges).max()), 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        below = np.clip((edges - low[:, None]) / span[:, None], 0.0, 1.0)
    below[level] = low[level, None] < edges
    return np.diff(below, axis=1)


def check_alone(paths: Sequence[Path], options: dict) -> None:
    """Raises ConfigError where segments come with clouds, or with options that select points."""
    mixed = [path for path in paths if not is_segments(path)]
    if mixed:
        raise ConfigError(f"{mixed[0]}: segments are drawn without clouds; draw these in another picture")
    for name in ("flags", "drop_flags", "where"):
        if options[name]:
            raise ConfigError(f"{paths[0]}: --{name.replace('_', '-')} selects points; segments have none")
