"""Sections and height profiles of clouds and of voxels: as arrays, and drawn with matplotlib.

`wavebatch plot section` calls `cut_section` and `draw_section`, `plot profile` calls `measure_profile` and
`draw_profile`. Clouds of any size: a section keeps an even sample of its points, a profile only sums. Style and files
are those of `files.figure_file`; the same data give the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import frozen
from wavebatch.files.cloud.point_filter import EVERY, PointFilter
from wavebatch.files.figure_file import fit_text, open_picture, plain_text, set_head, set_layout, space_ticks
from wavebatch.files.las.crs import CrsWords
from wavebatch.tools import cells
from wavebatch.tools.plots.draw_cloud import SERIES_COLORS, add_colorbar, name_clouds
from wavebatch.tools.slice_output import STRIP_UNIT, SegmentFiles, is_segments
from wavebatch.tools.voxels.grid import VoxelFile

MOST_POINTS = 200_000
"""Most points of a section that are drawn: more would only cover each other."""

MOST_BINS = 5000
"""Most bins of a profile."""

FEWEST_JUDGED = 20
"""Least number of heights among which one can be an outlier."""

_CHOSEN_BINS = 60
"""Bins of a profile, about, if their size is not given."""


_PIECE = 100_000
"""Shares of segments in bins that are computed at a time."""


def open_heights(
    paths: Sequence[Path], column: str | None, selection: PointFilter
) -> tuple[cells.Clouds | VoxelFile | SegmentFiles, CrsWords]:
    """Clouds or one file of voxels, whose rows have the height as second value; segments have those of both ends."""
    if is_segments(paths[0]):
        return SegmentFiles(paths, column), CrsWords()
    voxels = [path for path in paths if path.suffix.lower() == ".npz"]
    if voxels and len(paths) > 1:
        raise ConfigError(f"{voxels[0]}: a file of voxels is drawn alone")
    if voxels:
        voxel = VoxelFile(paths[0], column, selection)
        return voxel, CrsWords(voxel.crs)
    clouds = cells.Clouds(paths, (column, "z"), selection)
    return clouds, cells.check_crs(clouds.paths)


@frozen(eq=False)
class Section(cells.CloudData):
    """The points of a vertical section along a line."""

    line: tuple[float, float, float, float]
    """x and y of both ends."""
    width: float
    """Of the strip of ground whose points are shown: half of it on each side of the line."""
    along: np.ndarray
    """Distance from the first end, f8 (n,)."""
    height: np.ndarray
    value: np.ndarray
    inside: int
    """Points with a value in the section; at most MOST_POINTS of them are here."""
    outside: int
    """Of these, far outliers in height, which are not here: they would press all others into a line."""
    shown: tuple[float, float]
    """Limits of the colours."""
    voxel: float
    """Edge of a voxel; 0 for points."""
    crs: CrsWords


def cut_section(
    paths: Sequence[Path],
    column: str | None,
    selection: PointFilter = EVERY,
    *,
    line: tuple[float, float, float, float] | None = None,
    width: float | None = None,
    most: int = MOST_POINTS,
) -> Section:
    """The points within half of `width` from a line, as distance along it and height.

    line: x0, y0, x1, y1; by default along the longer extent of the points, through their middle. width: by default a
    fiftieth of the line, for voxels at least one voxel. most: an even sample of so many points at the most. Raises
    InputError if no point lies there.
    """
    clouds, crs = open_heights(paths, column, selection)
    voxel = clouds.size if isinstance(clouds, VoxelFile) else 0.0
    if crs.unit == "deg":
        raise ConfigError(f"{paths[0]}: coordinates are degrees, heights are not: project the cloud to draw a section")
    if line is None:  # through the middle of the points, along their longer extent
        _, sample, _ = cells.survey_places(clouds, option="--line")
        if not sample.seen:
            raise InputError(f"{clouds.paths[0]}: nothing to draw: no point has a position")
        places = sample.read()["place"]
        middle = places.mean(axis=0)
        values, vectors = np.linalg.eigh(np.cov((places - middle).T) if len(places) > 1 else np.eye(2))
        axis = vectors[:, 1] if values[1] > 0 else np.array([1.0, 0.0])
        axis = axis if axis[np.argmax(np.abs(axis))] > 0 else -axis
        ends = (places - middle) @ axis
        low, high = cells.robust_limits(ends, float(ends.min()), float(ends.max()))
        margin = max(0.5 * (1.0 - (high - low)), 0.0)
        line = (*(middle + (low - margin) * axis).tolist(), *(middle + (high + margin) * axis).tolist())
    start, end = np.array(line[:2]), np.array(line[2:])
    length = float(np.hypot(*(end - start)))
    if not (math.isfinite(length) and length > 0):
        raise ConfigError("--line: the ends must be two different points: x0,y0,x1,y1")
    width = max(length / 50, voxel) if width is None else width
    if not (math.isfinite(width) and width > 0):
        raise ConfigError(f"--width {width:g}: must be above 0")

    along = (end - start) / length

    def cut(rows: np.ndarray) -> np.ndarray:
        """Distance along the line, height and value of the points beside it, f8 (k, 3)."""
        offset = np.stack([rows["x"], rows["y"]], axis=1) - start
        far, aside = offset @ along, offset @ np.array([-along[1], along[0]])
        height = rows["values"][:, 1]
        keep = (far >= 0) & (far <= length) & (np.abs(aside) <= 0.5 * width) & np.isfinite(height)
        return np.stack([far, height, rows["values"][:, 0]], axis=1)[keep]

    total, sample, _ = cells.sample_points(clouds, lambda _, rows: cut(rows), most)
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
    far, height, value = places[near].T
    shown = tuple(np.percentile(value, (2, 98)).tolist())
    names = tuple(path.name for path in paths)
    return Section(clouds.facts, names, total, tuple(map(float, line)), width, far, height, value, sample.seen, outside,
                   shown, voxel, crs)  # fmt: skip


def choose_frame(height: np.ndarray, length: float) -> tuple[float, float]:
    """Least and largest height that a section shows, of heights (n,): not the few that lie far from all others.

    At each end the thousandth that is farthest, but at least one, is left out where it lies farther from the rest than
    EXTRA_EXTENT of its extent and than a tenth of the section's length. Fewer than FEWEST_JUDGED heights have none.
    """
    few = math.ceil(0.001 * len(height))
    if len(height) < FEWEST_JUDGED:
        return -math.inf, math.inf
    rest = np.sort(height)[few:-few]
    reach = max(cells.EXTRA_EXTENT * float(rest[-1] - rest[0]), 0.1 * length)
    return float(rest[0]) - reach, float(rest[-1]) + reach


@frozen(eq=False)
class Profile(cells.CloudData):
    """Numbers or sums per height, for one series per cloud."""

    statistic: str
    """`count`, `sum` or `mean`."""
    edges: np.ndarray
    """Heights, f8 (b + 1,)."""
    values: np.ndarray
    """f8 (series, b); NaN for a mean without a point."""
    outside: int
    """Points below or above the edges."""
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
    paths: Sequence[Path],
    column: str | None,
    statistic: str,
    selection: PointFilter = EVERY,
    *,
    size: float | None = None,
    each: bool = False,
) -> Profile:
    """The number of points or segments, or the sum or mean of the column, per height.

    A segment is not a point: it counts in every bin that it crosses, by the share of its height that lies there.

    size: height of a bin, by default about a sixtieth of all. each: one series per cloud instead of one for all. Far
    outliers in height are left out and counted. Raises InputError without any value.
    """
    clouds, crs = open_heights(paths, column, selection)
    cells.check_statistic(column, statistic, clouds.facts, paths[0])

    def pick(_: int, rows: np.ndarray) -> np.ndarray:
        height = rows["values"][:, 1:].reshape(-1, 1)
        return height[np.isfinite(height[:, 0])]

    total, sample, box = cells.sample_points(clouds, pick)
    if not sample.seen:
        raise clouds.complain(total)
    voxel = clouds.size if isinstance(clouds, VoxelFile) else 0.0
    # Edges of bins: multiples of their size; for voxels the faces of these, or no voxel would lie on one side only.
    heights = sample.read()["place"].ravel()
    low, high = cells.robust_limits(heights, *box.ravel().tolist())
    if size is None:
        size = cells.round_up(max(high - low, 1e-3) / _CHOSEN_BINS)
    if not (math.isfinite(size) and size > 0):
        raise ConfigError(f"--size {size:g}: must be above 0")
    base = 0.0
    if voxel:
        size = voxel * max(round(size / voxel), 1)
        base = float(heights.min()) - 0.5 * voxel
    first, last = math.floor((low - base) / size + 1e-6), math.floor((high - base) / size + 1e-6)
    if last - first >= MOST_BINS:
        raise ConfigError(f"--size {size:g}: gives more than {MOST_BINS} bins; give a larger one")
    edges = base + np.arange(first, last + 2) * size
    series = len(paths) if each else 1
    sums, numbers, outside = np.zeros((series, len(edges) - 1)), np.zeros((series, len(edges) - 1)), 0
    for cloud, rows, _ in clouds.read():
        value, row = rows["values"][:, 0], cloud if each else 0
        low, high = rows["values"][:, 1:].min(axis=1), rows["values"][:, 1:].max(axis=1)
        at = np.searchsorted(edges, low, side="right") - 1
        good = (at < len(edges) - 1) & ~(high < edges[0])  # not a number is outside
        outside += int(np.count_nonzero(~good))
        if rows["values"].shape[1] == 2:
            numbers[row] += np.bincount(at[good], minlength=len(edges) - 1)
            sums[row] += np.bincount(at[good], value[good], minlength=len(edges) - 1)
            continue
        step = _PIECE // len(edges) + 1
        for part in (slice(start, start + step) for start in range(0, len(rows), step)):
            # Share of the height of each segment in each bin. Bins hold their lower edge; a level segment lies in one.
            ends = rows["values"][part, 1:]
            low, high = ends.min(axis=1), ends.max(axis=1)
            span = high - low
            level = span < 1e-9 * max(float(np.abs(edges).max()), 1.0)
            with np.errstate(divide="ignore", invalid="ignore"):
                below = np.clip((edges - low[:, None]) / span[:, None], 0.0, 1.0)
            below[level] = low[level, None] < edges
            share = np.diff(below, axis=1)
            numbers[row] += share.sum(axis=0)
            sums[row] += value[part] @ share
    with np.errstate(invalid="ignore", divide="ignore"):
        values: Any = {"count": numbers, "sum": sums, "mean": np.where(numbers > 0, sums / numbers, np.nan)}[statistic]
    names = cells.name_paths(paths)
    kind, unit = "clouds", crs.upright_unit
    more = {"upright": crs.upright}
    if isinstance(clouds, SegmentFiles):
        kind, unit, more = "files", STRIP_UNIT, {"noun": "segments"}
    names = names if each or len(paths) == 1 else (f"{len(paths)} {kind}",)
    return Profile(clouds.facts, names, total, statistic, edges, values, outside, unit, **more)


LIGHT, FAINT = ("energy", "cross_section"), 0.02
"""Columns of voxels; less than this share of the scale is not drawn: deconvolution leaves tails of a few per
mille below the ground, which would look as solid as the ground does."""

_NARROW = 3.0
"""Sections less wide have the scale of colours beside them [inches]: below, its numbers would not fit."""

_LONG, _LEAST, _MOST = 10.0, 0.6, 8.0
"""Longer side, least and largest height of the axes of a section [inches]."""

_MOST_CELLS = 2000
"""Most cells of a picture along one side: more than it has pixels. A cell is one voxel where fewer do."""


def draw_section(found: Section, target: Path, *, aspect: float = 1.0, overwrite: bool = False) -> None:
    """Writes a side view; aspect: how many times heights are exaggerated. Raises as figure_file.open_picture does."""
    length = float(np.hypot(found.line[2] - found.line[0], found.line[3] - found.line[1]))
    low, high = float(found.height.min()), float(found.height.max())
    margin = max(0.03 * (high - low), 0.5 * found.voxel, 0.005 * length, 1e-3)
    low, high = low - margin, high + margin
    tall = aspect * (high - low) / length
    width = min(_LONG, _MOST / tall)
    with open_picture(target, (max(width + 1.0, 6.0), max(width * tall, _LEAST) + 2.3), overwrite=overwrite) as figure:
        flat = width > _NARROW
        if flat:
            # As tall as the axes with equal scales are: constrained layout would leave them alone in the middle.
            set_layout(figure, compress=True)
        axes, place = (figure.subplots(), None) if flat else figure.subplots(1, 2, width_ratios=(1, 0.05))
        axes.set_anchor("C" if flat else "E")
        if found.voxel:
            shown, values = _draw_voxels(axes, found)
        else:
            # Far points first would hide near ones by chance; in order of their values, large values are on top.
            order, dot = np.argsort(found.value, kind="stable"), float(np.clip(40_000 / len(found.value), 0.5, 12.0))
            places, values = (found.along[order], found.height[order]), found.value
            shown = axes.scatter(*places, c=values[order], s=dot, cmap="viridis", linewidths=0)
        axes.set(xlim=(0.0, length), ylim=(low, high), aspect=aspect, xlabel=f"along the line [{found.crs.unit}]",
                 ylabel=f"{found.crs.upright} [{found.crs.upright_unit}]")  # fmt: skip
        axes.ticklabel_format(useOffset=False)
        space_ticks(axes.yaxis, width * tall, 0.3)
        label = ("mean of " if found.voxel else "") + found.facts.label
        length = width if flat else width * tall
        add_colorbar(axes, shown, values, found.shown, label, length=length, flat=flat, place=place)
        if not flat:
            space_ticks(axes.xaxis, width, 0.4)
        set_head(figure, _parts(found, aspect))


def _parts(found: Section, aspect: float) -> list[str]:
    x0, y0, x1, y1 = (f"{value:.10g}" for value in found.line)
    kind = "voxels" if found.voxel else "points"
    drawn = "" if len(found.value) == found.inside - found.outside else f", {len(found.value):,} are drawn"
    parts = [
        name_clouds(found.names), found.facts.name, f"{found.inside:,} of {found.total.values:,} {kind}{drawn}",
        f"from {x0} {y0} to {x1} {y1}", f"{found.width:.4g} {found.crs.unit} wide",
    ]  # fmt: skip
    parts += found.total.list_rest(found.outside)
    parts += [f"below {100 * FAINT:g} % of the scale: empty"] * (found.voxel > 0 and found.facts.name in LIGHT)
    parts.append("equal scales" if aspect == 1.0 else f"heights {aspect:g} times exaggerated")
    return [*parts, f"CRS: {plain_text(found.crs.name, 90) or 'not given'}"]


def _draw_voxels(axes, found: Section):
    """The mean of the voxels that lie behind each other across the line."""
    base = float(found.height.min()) - 0.5 * found.voxel
    longest = max(float(found.along.max()), float(found.height.max()) - base) / found.voxel
    edge = found.voxel * max(math.ceil(longest / _MOST_CELLS), 1)
    column = np.floor(found.along / edge).astype(np.int64)
    row = np.floor((found.height - base) / edge + 1e-6).astype(np.int64)
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    cell = row * shape[1] + column
    image = cells.compute_cells("mean", cell, found.value, shape[0] * shape[1], 1.0).reshape(shape)
    if found.facts.name in LIGHT:
        image[image < FAINT * found.shown[1]] = np.nan
    extent = (0.0, shape[1] * edge, base, base + shape[0] * edge)
    axes.grid(visible=False)
    shown = axes.imshow(image, extent=extent, origin="lower", cmap="viridis", interpolation="nearest", aspect="auto")
    return shown, image


def draw_profile(found: Profile, target: Path, *, log: bool = False, overwrite: bool = False) -> None:
    """Writes a height profile; log: logarithmic axis of values. Raises as figure_file.open_picture does."""
    with open_picture(target, (6.0, 6.0 + 0.2 * len(found.names)), overwrite=overwrite) as figure:
        axes = figure.subplots()
        for number, values in enumerate(found.values):
            color = SERIES_COLORS[number % len(SERIES_COLORS)]
            label = fit_text(figure, plain_text(found.names[number], 200), 4.5, size=8.5)
            alone = len(found.values) == 1 and found.statistic != "mean"
            if alone:
                axes.stairs(np.nan_to_num(values), found.edges, orientation="horizontal", fill=True, color=color,
                            alpha=0.35)  # fmt: skip
            # A mean is no amount: from 0 on, differences of a few per cent would not be seen.
            base = None if found.statistic == "mean" else 0.0
            axes.stairs(values, found.edges, orientation="horizontal", color=color, linewidth=1.2, label=label,
                        baseline=base)  # fmt: skip
        if log:
            axes.set_xscale("log")
            axes.xaxis.set_minor_formatter("")
        else:
            axes.xaxis.get_major_locator().set_params(nbins=6)
            if np.nanmin(found.values) >= 0 and found.statistic != "mean":
                axes.set_xlim(left=0)
        # Labels as powers of ten need math text, which file names forbid: a $ in one would break the picture.
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.10g}")
        axes.set_ylim(found.edges[0], found.edges[-1])
        axes.ticklabel_format(axis="y", useOffset=False, style="plain")
        across = fit_text(figure, plain_text(found.label, 300), 5.0, size=9.5)
        axes.set(xlabel=across, ylabel=f"{found.upright} [{found.unit}]")
        parts = [name_clouds(found.names), f"{found.total.values:,} {found.noun}"]
        parts[1:1] = [found.facts.name] if found.facts.name != found.noun else []
        set_head(figure, [*parts, *found.total.list_rest(found.outside)])
        if len(found.names) > 1:
            axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.12), borderaxespad=0.0)
