"""A contact sheet: many small pictures of waveforms with fit, residual and echoes, to look over by eye."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.files.figure_file import open_picture, plain_text
from wavebatch.tools.plots.draw_waveform import ECHO, FIT, GREY, draw_samples, find_echo_heights, fit_signal_panel
from wavebatch.tools.plots.labels import fit_parts, fit_text
from wavebatch.tools.plots.waveform import WaveformView

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CELL = (2.3, 1.9)
"""Width and height of a small picture [inch]."""

HEAD, FOOT = 0.45, 0.25
"""Room for the title above and the legend below [inch]."""

SHARE = 0.28
"""Of a small picture's height for the residual."""

RESIDUAL = 4.0
"""Half the height of every residual panel [noise std]; larger residuals are drawn at its edge in red."""

LEGEND = (
    "dots: samples (triangles: saturated); dark line: fit; light: single echoes; diamonds: echoes; dashed: "
    f"returns of the file; below: residual, -{RESIDUAL:g} to {RESIDUAL:g} noise std; time in ns"
)

QUIET_FLAGS = EchoFlag.OVERLAPPED | EchoFlag.WEAK
"""Flags that are too common to be named."""


def draw_waveform_sheet(
    views: Sequence[WaveformView],
    target: Path,
    *,
    strip: str,
    chain: str,
    times: tuple[float, float] | None = None,
    overwrite: bool = False,
) -> None:
    """Writes a contact sheet, row by row in the order of `views`.

    Each picture is scaled to its samples; its title gives packet, strongest amplitude and flags. times: part to show
    in all [ns]; None: each is cut to its echoes and returns. Raises as figure_file.open_picture does.
    """
    columns = math.ceil(math.sqrt(len(views)))
    size = sheet_size(len(views), columns)
    with open_picture(target, size, overwrite=overwrite) as figure:
        # A layout for 200 axes takes a minute; a grid needs none.
        figure.set_layout_engine("none")
        draw_small_waveforms(figure, views, columns, times)
        parts = (plain_text(strip), plain_text(chain, 200), f"{len(views)} waveforms")
        title = fit_text(figure, "   ".join(parts), size[0] - 0.2, size=10, weight="bold")
        figure.text(0.1 / size[0], 1 - 0.1 / size[1], title, va="top", fontsize=10, weight="bold")
        legend = fit_parts(figure, LEGEND.split("; "), size[0] - 0.2, size=7)
        figure.text(0.1 / size[0], 0.06 / size[1], legend, va="bottom", fontsize=7, color=GREY)


def sheet_size(number: int, columns: int) -> tuple[float, float]:
    """Size of a sheet of so many pictures [inch]."""
    return CELL[0] * columns, CELL[1] * -(-number // columns) + HEAD + FOOT


def draw_small_waveforms(
    figure: Figure, views: Sequence[WaveformView], columns: int, times: tuple[float, float] | None = None,
    notes: Sequence[str] = (), head: float = HEAD,
) -> None:  # fmt: skip
    """Draws the pictures row by row, below a head [inch]; notes: a word for each title."""
    size = figure.get_size_inches()
    for number, view in enumerate(views):
        row, column = divmod(number, columns)
        left = (column * CELL[0] + 0.3) / size[0]
        bottom = (size[1] - head - (row + 1) * CELL[1] + 0.25) / size[1]
        place = (left, bottom, (CELL[0] - 0.4) / size[0], (CELL[1] - 0.5) / size[1])
        _draw_cell(figure, view, times, place, notes[number] if notes else "")


def _draw_cell(
    figure: Figure, view: WaveformView, times: tuple[float, float] | None, place: tuple[float, float, float, float],
    note: str,
) -> None:  # fmt: skip
    left, bottom, width, height = place
    upper = figure.add_axes((left, bottom + SHARE * height, width, (1 - SHARE) * height))
    lower = figure.add_axes((left, bottom, width, (SHARE - 0.03) * height), sharex=upper)
    times = times or view.span
    draw_samples(upper, view, times, dot=1.2, thin=0.55)
    upper.plot(view.echoes.time, find_echo_heights(view), "D", color=ECHO, markersize=3, markerfacecolor="none",
               markeredgewidth=0.7)  # fmt: skip
    fit_signal_panel(upper, view, times)
    _draw_residual(lower, view)
    upper.set_xlim(times)
    for axes in (upper, lower):
        axes.tick_params(labelsize=5.5, length=2, pad=1)
        axes.grid(False)
    upper.locator_params(nbins=4)
    upper.tick_params(labelbottom=False)
    lower.set_yticks([])
    title = fit_text(figure, _title(view, note), CELL[0] - 0.45, size=6.5)
    upper.set_title(title, fontsize=6.5, pad=2)


def _draw_residual(axes: Axes, view: WaveformView) -> None:
    axes.axhspan(-1, 1, color="#e6e6e6", zorder=0)
    axes.set_ylim(-RESIDUAL, RESIDUAL)
    if view.residual is None:
        return
    residual = np.clip(view.residual, -RESIDUAL, RESIDUAL)
    large = np.abs(view.residual) > RESIDUAL
    for rows, color in ((~large, FIT), (large, ECHO)):
        # One broken line: hundreds of lines would be most of a page.
        ends = np.stack([np.zeros(rows.sum()), residual[rows], np.full(rows.sum(), np.nan)], axis=1)
        axes.plot(np.repeat(view.time[rows], 3), ends.ravel(), color=color, linewidth=0.7)


def _title(view: WaveformView, note: str) -> str:
    name = f"packet {view.packet}" if view.packet >= 0 else f"point {view.point}"
    strongest = f"{view.echoes.amplitude.max():.0f} DN" if len(view.echoes) else "no echo"
    flags = EchoFlag(int(np.bitwise_or.reduce(view.echoes.flags, initial=0))) & ~QUIET_FLAGS
    names = ", ".join(flag.name for flag in flags)
    return "   ".join(filter(None, (name, strongest, note))) + (f"\n{names}" if names else "")
