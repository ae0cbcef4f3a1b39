"""Pictures of the segments of many scan lines, and of slices of a data cube.

`wavebatch slice --overview` and `wavebatch plot cube` draw with it; a single slice is drawn in `output`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from wavebatch.files.figure_file import open_picture, plain_text
from wavebatch.tools.plots.labels import set_head
from wavebatch.tools.slices.cube import CubeSlice
from wavebatch.tools.slices.output import NO_SAMPLE
from wavebatch.tools.slices.segments import Segment

_LEAST_HEIGHT = 0.15
"""Least height of the box in 3D, as a share of its longest side: flat ground would else be a line."""


def draw_segments(
    segments: Sequence[Segment], target: Path, *, strip: str, lines: int, crs: str = "", overwrite: bool = False
) -> None:
    """Writes all segments in plan and in 3D, coloured by height; raises as figure_file.open_picture does."""
    from matplotlib.collections import LineCollection
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    ends = np.array([(segment.start, segment.end) for segment in segments])
    height = ends[:, :, 2].mean(axis=1)
    low, high = ends.reshape(-1, 3).min(axis=0), ends.reshape(-1, 3).max(axis=0)
    extent = np.maximum(high - low, 1e-3)
    with open_picture(target, (12.0, 6.0), overwrite=overwrite) as figure:
        numbers = [f"{number:,} {name}{'s' * (number != 1)}" for number, name in
                   ((len(segments), "segment"), (lines, "scan line"))]  # fmt: skip
        parts = (plain_text(strip), " in ".join(numbers), f"CRS: {plain_text(crs, 90) or 'not given'}")
        set_head(figure, parts, size=10.5)
        plan = figure.add_subplot(1, 2, 1)
        # Coordinates from a corner: seven digits per tick would cover each other in 3D.
        base = np.floor(low / 10.0) * 10.0
        shown = plan.add_collection(LineCollection(ends[:, :, :2] - base[:2], cmap="viridis", linewidths=1.0))
        shown.set_array(height)
        margin = 0.04 * extent[:2].max()
        plan.set_xlim(low[0] - base[0] - margin, high[0] - base[0] + margin)
        plan.set_ylim(low[1] - base[1] - margin, high[1] - base[1] + margin)
        plan.set_aspect("equal")
        names = [f"{name} {'-' if value >= 0 else '+'} {abs(value):.10g} [m]" if value else f"{name} [m]"
                 for name, value in zip("xyz", base, strict=True)]  # fmt: skip
        plan.set_xlabel(names[0])
        plan.set_ylabel(names[1])
        figure.colorbar(shown, ax=plan, label="height [m]", orientation="horizontal", aspect=40)
        space = figure.add_subplot(1, 2, 2, projection="3d")
        tubes = space.add_collection3d(Line3DCollection(ends - base, cmap="viridis", linewidths=0.9))
        tubes.set_array(height)
        for axis, first, last in zip("xyz", low - base, high - base, strict=True):
            getattr(space, f"set_{axis}lim")(first, max(last, first + 1e-3))
            getattr(space, f"set_{axis}label")(axis, fontsize=8, labelpad=8)
            space.tick_params(axis=axis, labelsize=7)
        tall = max(extent[2], _LEAST_HEIGHT * extent.max())
        sides = np.append(np.maximum(extent[:2], 0.05 * extent.max()), tall)
        # A long box is seen along its diagonal, and leaves more room around it than a cube.
        space.set_box_aspect(sides, zoom=0.85 + 0.35 * (1.0 - np.sort(sides)[1] / sides.max()))
        for axis, side in zip("xyz", sides / sides.max(), strict=True):
            _place_ticks(getattr(space, f"{axis}axis"), 5.0 * side)
        for flat, side in zip((plan.xaxis, plan.yaxis), extent[:2] / extent.max(), strict=True):
            _place_ticks(flat, 7.0 * side)
        factor = tall / extent[2]
        scales = "equal scales" if factor < 1.01 else f"heights {factor:.2g} times exaggerated"
        space.set_title(f"{scales}; z above {base[2]:.10g} m", fontsize=9)


def _place_ticks(axis, number: float) -> None:
    """Sets about so many ticks, or only one in the middle of a short axis: more would cover each other."""
    if number < 1.5:
        low, high = axis.get_view_interval()
        step = 10.0 ** np.floor(np.log10(0.5 * (high - low)))
        axis.set_ticks([step * np.round(0.5 * (low + high) / step)])
        axis.set_major_formatter("{x:.6g}")
    else:
        axis.get_major_locator().set_params(nbins=max(int(number), 2))


def draw_cube(slices: Sequence[CubeSlice], target: Path, *, name: str, overwrite: bool = False) -> None:
    """Writes slices of a cube side by side, with one scale of grey; raises as figure_file.open_picture does."""
    known = np.concatenate([one.image[np.isfinite(one.image)] for one in slices])
    high = float(np.percentile(known, 99.8)) if len(known) else 1.0
    with open_picture(target, (max(4.6 * len(slices), 6.0), 4.8), overwrite=overwrite) as figure:
        set_head(figure, (plain_text(name), "blue: no sample"), size=10.5)
        panels = figure.subplots(1, len(slices), squeeze=False)[0]
        for axes, one in zip(panels, slices, strict=True):
            axes.grid(visible=False)
            axes.set_facecolor(NO_SAMPLE)
            shown = axes.imshow(one.image, extent=one.extent, origin="lower", aspect="auto", cmap="Greys", vmin=0.0,
                                vmax=max(high, 1e-6), interpolation="nearest")  # fmt: skip
            if one.down:
                axes.invert_yaxis()
            axes.set_xlabel(one.across)
            axes.set_ylabel(one.up)
            axes.set_title(one.title)
        figure.colorbar(shown, ax=panels.tolist(), label="above the level without signal [DN]", extend="max")
