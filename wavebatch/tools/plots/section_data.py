"""Sections and height profiles of clouds and of voxels, as arrays.

`wavebatch plot section` and `plot profile` read them here and draw them with `draw_section`. Clouds of any size: a
section keeps an even sample of its points, a profile only sums.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.cloud.column_reader import ColumnFacts
from wavebatch.files.las.crs import CrsWords
from wavebatch.tools.plots.raster import check_crs, survey_places
from wavebatch.tools.plots.values import (
    MARGIN,
    Clouds,
    Selection,
    Tally,
    check_statistic,
    name_paths,
    robust_limits,
    round_up,
    sample_points,
)
from wavebatch.tools.voxels.voxel_points import VoxelFile

MOST_POINTS = 200_000
"""Most points of a section that are drawn: more would only cover each other."""

MOST_BINS = 5000
"""Most bins of a profile."""

LEAST = 20
"""Least number of heights among which one can be an outlier."""

_CHOSEN_BINS = 60
"""Bins of a profile, about, if their size is not given."""


def open_heights(paths: Sequence[Path], selection: Selection) -> Clouds | VoxelFile:
    """Clouds or one file of voxels, whose rows have the height as second value."""
    voxels = [path for path in paths if path.suffix.lower() == ".npz"]
    if voxels and len(paths) > 1:
        raise ConfigError(f"{voxels[0]}: a file of voxels is drawn alone")
    return VoxelFile(paths[0], selection) if voxels else Clouds(paths, replace(selection, others=("z",)))


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """The points of a vertical section along a line."""

    facts: ColumnFacts
    names: tuple[str, ...]
    line: tuple[float, float, float, float]
    """x and y of both ends."""
    width: float
    """Of the strip of ground whose points are shown: half of it on each side of the line."""
    along: np.ndarray
    """Distance from the first end, f8 (n,)."""
    height: np.ndarray
    value: np.ndarray
    total: Tally
    """Counts of all points of the clouds."""
    inside: int
    """Points with a value in the section; at most MOST_POINTS are here."""
    outside: int
    """Of these, far outliers in height, which are not here: they would press all others into a line."""
    shown: tuple[float, float]
    """Limits of the colours."""
    voxel: float
    """Edge of a voxel; 0 for points."""
    crs: CrsWords


def cut_section(
    paths: Sequence[Path],
    selection: Selection,
    *,
    line: tuple[float, float, float, float] | None = None,
    width: float | None = None,
) -> Section:
    """The points within half of `width` from a line, as distance along it and height.

    line: x0, y0, x1, y1; by default along the longer extent of the points, through their middle. width: by default a
    fiftieth of the line, for voxels at least one voxel. Raises InputError if no point lies there.
    """
    clouds = open_heights(paths, selection)
    voxel = clouds.size if isinstance(clouds, VoxelFile) else 0.0
    crs = _find_crs(clouds)
    if crs.unit == "deg":
        raise ConfigError(f"{paths[0]}: coordinates are degrees, heights are not: project the cloud to draw a section")
    line = line or _choose_line(clouds)
    start, end = np.array(line[:2]), np.array(line[2:])
    length = float(np.hypot(*(end - start)))
    if not (math.isfinite(length) and length > 0):
        raise ConfigError("--line: the ends must be two different points: x0,y0,x1,y1")
    width = max(length / 50, voxel) if width is None else width
    if not (math.isfinite(width) and width > 0):
        raise ConfigError(f"--width {width:g}: must be above 0")

    def cut(rows: np.ndarray) -> np.ndarray:
        return _cut_rows(rows, start, (end - start) / length, length, width)

    total, sample, _ = sample_points(clouds, lambda _, rows: cut(rows), MOST_POINTS)
    if not sample.seen:
        raise InputError(
            f"{paths[0]}: none of {total.values} points lies within {0.5 * width:g} {crs.unit} of the line from "
            f"{start[0]:.10g} {start[1]:.10g} to {end[0]:.10g} {end[1]:.10g}"
        )
    places = sample.read()["place"]
    low, high = choose_frame(places[:, 1], length)
    near = (places[:, 1] >= low) & (places[:, 1] <= high)
    outside = int(np.count_nonzero(~near))
    if sample.seen > len(places):
        every = (cut(rows)[:, 1] for _, rows, _ in clouds.read())
        outside = sum(int(np.count_nonzero((height < low) | (height > high))) for height in every)
    along, height, value = places[near].T
    shown = tuple(np.percentile(value, (2, 98)).tolist())
    names = tuple(path.name for path in paths)
    return Section(clouds.facts, names, tuple(map(float, line)), width, along, height, value, total, sample.seen,
                   outside, shown, voxel, crs)  # fmt: skip


def _find_crs(clouds: Clouds | VoxelFile) -> CrsWords:
    return CrsWords(clouds.crs) if isinstance(clouds, VoxelFile) else check_crs(clouds.paths)


def _cut_rows(rows: np.ndarray, start: np.ndarray, along: np.ndarray, length: float, width: float) -> np.ndarray:
    """Distance along the line, height and value of the points beside it, f8 (k, 3); along: its unit vector."""
    offset = np.stack([rows["x"], rows["y"]], axis=1) - start
    far, aside = offset @ along, offset @ np.array([-along[1], along[0]])
    height = rows["values"][:, 1]
    keep = (far >= 0) & (far <= length) & (np.abs(aside) <= 0.5 * width) & np.isfinite(height)
    return np.stack([far, height, rows["values"][:, 0]], axis=1)[keep]


def choose_frame(height: np.ndarray, length: float) -> tuple[float, float]:
    """Least and largest height that a section shows, of heights (n,): not the few that lie far from all others.

    At each end the thousandth that is farthest, but at least one, is left out where it lies farther from the rest than
    MARGIN of its extent and than a tenth of the section's length. Fewer than LEAST heights have no outliers.
    """
    few = math.ceil(0.001 * len(height))
    if len(height) < LEAST:
        return -math.inf, math.inf
    rest = np.sort(height)[few:-few]
    reach = max(MARGIN * float(rest[-1] - rest[0]), 0.1 * length)
    return float(rest[0]) - reach, float(rest[-1]) + reach


def _choose_line(clouds: Clouds | VoxelFile) -> tuple[float, float, float, float]:
    """A line through the middle of the points, along their longer extent."""
    _, sample, _ = survey_places(clouds, option="--line")
    if not sample.seen:
        raise InputError(f"{clouds.paths[0]}: nothing to draw: no point has a position")
    places = sample.read()["place"]
    middle = places.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov((places - middle).T) if len(places) > 1 else np.eye(2))
    axis = vectors[:, 1] if values[1] > 0 else np.array([1.0, 0.0])
    axis = axis if axis[np.argmax(np.abs(axis))] > 0 else -axis
    ends = (places - middle) @ axis
    low, high = robust_limits(ends, float(ends.min()), float(ends.max()))
    margin = max(0.5 * (1.0 - (high - low)), 0.0)
    return (*(middle + (low - margin) * axis).tolist(), *(middle + (high + margin) * axis).tolist())


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """Numbers or sums per height, for one series per cloud."""

    facts: ColumnFacts
    statistic: str
    """`count`, `sum` or `mean`."""
    names: tuple[str, ...]
    edges: np.ndarray
    """Heights, f8 (b + 1,)."""
    values: np.ndarray
    """f8 (series, b); NaN for a mean without a point."""
    outside: int
    """Points below or above the edges."""
    total: Tally
    unit: str
    """Of heights."""
    upright: str = "height"
    """What z is."""
    noun: str = "values"
    """What is counted, in the title."""

    @property
    def label(self) -> str:
        """Label of the axis of values."""
        step = f"{self.edges[1] - self.edges[0]:.4g} {self.unit.split()[0]} of {self.upright}"
        if self.statistic == "count":
            kind = self.facts.name if self.facts.name in ("voxels", "segments") else "points"
            return f"{kind} per {step}"
        return f"{self.statistic} of {self.facts.label} {'in' if self.statistic == 'mean' else 'per'} {step}"


def measure_profile(
    paths: Sequence[Path], selection: Selection, statistic: str, *, size: float | None = None, each: bool = False
) -> Profile:
    """The number of points, or the sum or mean of the column, per height.

    size: height of a bin, by default about a sixtieth of all. each: one series per cloud instead of one for all. Far
    outliers in height are left out and counted. Raises InputError without any value.
    """
    clouds = open_heights(paths, selection)
    crs = _find_crs(clouds)
    check_statistic(selection.column, statistic, clouds.facts, paths[0])

    def pick(_: int, rows: np.ndarray) -> np.ndarray:
        height = rows["values"][:, 1:]
        return height[np.isfinite(height[:, 0])]

    total, sample, box = sample_points(clouds, pick)
    if not sample.seen:
        raise clouds.complain(total)
    voxel = clouds.size if isinstance(clouds, VoxelFile) else 0.0
    edges = place_heights(sample.read()["place"].ravel(), *box.ravel().tolist(), size, voxel)
    series = len(paths) if each else 1
    sums, numbers, outside = np.zeros((series, len(edges) - 1)), np.zeros((series, len(edges) - 1)), 0
    for cloud, rows, _ in clouds.read():
        at = np.searchsorted(edges, rows["values"][:, 1], side="right") - 1
        good = (at >= 0) & (at < len(edges) - 1)
        outside += int(np.count_nonzero(~good))
        row = cloud if each else 0
        numbers[row] += np.bincount(at[good], minlength=len(edges) - 1)
        sums[row] += np.bincount(at[good], rows["values"][:, 0][good], minlength=len(edges) - 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        values: Any = {"count": numbers, "sum": sums, "mean": np.where(numbers > 0, sums / numbers, np.nan)}[statistic]
    names = name_paths(paths)
    names = names if each or len(paths) == 1 else (f"{len(paths)} clouds",)
    return Profile(clouds.facts, statistic, names, edges, values, outside, total, crs.upright_unit,
                   crs.upright)  # fmt: skip


def place_heights(sample: np.ndarray, least: float, largest: float, size: float | None, voxel: float) -> np.ndarray:
    """Edges of bins: multiples of their size; for voxels the faces of these, or no voxel would lie on one side only."""
    low, high = robust_limits(sample, least, largest)
    if size is None:
        size = round_up(max(high - low, 1e-3) / _CHOSEN_BINS)
    if not (math.isfinite(size) and size > 0):
        raise ConfigError(f"--size {size:g}: must be above 0")
    base = 0.0
    if voxel:
        size = voxel * max(round(size / voxel), 1)
        base = float(sample.min()) - 0.5 * voxel
    first, last = math.floor((low - base) / size + 1e-6), math.floor((high - base) / size + 1e-6)
    if last - first >= MOST_BINS:
        raise ConfigError(f"--size {size:g}: gives more than {MOST_BINS} bins; give a larger one")
    return base + np.arange(first, last + 2) * size
