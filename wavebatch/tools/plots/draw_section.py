"""Pictures of sections and height profiles, drawn with matplotlib.

`wavebatch plot section` and `plot profile` call these with the results of `section_data`. Style and files are those of
`files.figure_file`; the same data give the same bytes.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from wavebatch.files.figure_file import open_picture, plain_text
from wavebatch.tools.plots.draw_cloud import SERIES, add_colorbar, name_clouds
from wavebatch.tools.plots.labels import fit_text, set_head, space_ticks
from wavebatch.tools.plots.section_data import Profile, Section
from wavebatch.tools.rasters.cells import compute_cells

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
            figure.set_layout_engine("compressed")
        axes, place = (figure.subplots(), None) if flat else figure.subplots(1, 2, width_ratios=(1, 0.05))
        axes.set_anchor("C" if flat else "E")
        shown, values = _draw_voxels(axes, found) if found.voxel else _draw_points(axes, found)
        axes.set_xlim(0.0, length)
        axes.set_ylim(low, high)
        axes.set_aspect(aspect)
        axes.set_xlabel(f"along the line [{found.crs.unit}]")
        axes.set_ylabel(f"{found.crs.upright} [{found.crs.upright_unit}]")
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


def _draw_points(axes, found: Section):
    size = float(np.clip(40_000 / len(found.value), 0.5, 12.0))
    # Far points first would hide near ones by chance; in order of their values, large values are on top.
    order = np.argsort(found.value, kind="stable")
    shown = axes.scatter(
        found.along[order], found.height[order], c=found.value[order], s=size, cmap="viridis", linewidths=0
    )
    return shown, found.value


def _draw_voxels(axes, found: Section):
    """The mean of the voxels that lie behind each other across the line."""
    base = float(found.height.min()) - 0.5 * found.voxel
    longest = max(float(found.along.max()), float(found.height.max()) - base) / found.voxel
    edge = found.voxel * max(math.ceil(longest / _MOST_CELLS), 1)
    column = np.floor(found.along / edge).astype(np.int64)
    row = np.floor((found.height - base) / edge + 1e-6).astype(np.int64)
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    cell = row * shape[1] + column
    image = compute_cells("mean", cell, found.value, shape[0] * shape[1], 1.0).reshape(shape)
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
            color = SERIES[number % len(SERIES)]
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
        axes.set_xlabel(fit_text(figure, plain_text(found.label, 300), 5.0, size=9.5))
        axes.set_ylabel(f"{found.upright} [{found.unit}]")
        parts = [name_clouds(found.names), f"{found.total.values:,} {found.noun}"]
        parts[1:1] = [found.facts.name] if found.facts.name != found.noun else []
        set_head(figure, [*parts, *found.total.list_rest(found.outside)])
        if len(found.names) > 1:
            axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.12), borderaxespad=0.0)
