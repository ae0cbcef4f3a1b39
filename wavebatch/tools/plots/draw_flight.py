"""A picture of a calibrated flight: constants and drifts of the strips, and how well they agree where they overlap.

`wavebatch calibrate --plot` draws it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wavebatch.files.figure_file import open_picture, plain_text
from wavebatch.surveying.calibrating.calibrate_flight import FlightCalibration

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_ROWS = 60
"""Strips or pairs that are drawn; more would be too small to read."""

_ROW = 0.24
"""Height of a row [inch]."""


def draw_flight(found: FlightCalibration, target: Path, *, overwrite: bool = False) -> None:
    """Write a picture of the drift of each strip and of each overlap before and after the calibration.

    Raises as `figure_file.open_picture` does.
    """
    strips, pairs = found.calibration.strips[:MOST_ROWS], found.pairs[:MOST_ROWS]
    height = 1.6 + _ROW * (max(len(strips), 1) + max(len(pairs), 1))
    with open_picture(target, (8.0, height), overwrite=overwrite) as figure:
        upper, lower = figure.subplots(2, 1, height_ratios=[max(len(strips), 1), max(len(pairs), 1)])
        names = [f"{row.strip}: {row.digitizer}.{row.scanner}" for row in strips]
        _draw_rows(upper, names, [row.drift for row in strips], [row.drift_error for row in strips], "#1f5a99", "error")
        upper.set(title="Drift of each strip (strip: digitizer.scanner channel)",
                  xlabel="constant off the mean of its channel [%]")  # fmt: skip
        lower.plot([100 * (pair.ratio - 1) for pair in pairs], range(len(pairs)), "x", color="#b5492f", label="before")
        names = [f"{_shorten(pair.a)} / {_shorten(pair.b)} ({pair.cells})" for pair in pairs]
        after, spread = [pair.after - 1 for pair in pairs], [pair.spread for pair in pairs]
        _draw_rows(lower, names, after, spread, "#2f7d4f", "after; bars: spread of the cells")
        lower.set(title="Overlaps (number of cells)", xlabel="light of the first over that of the second [%]")
        lower.legend(loc="best")


def _draw_rows(
    axes: Axes, names: Sequence[str], values: Sequence[float], errors: Sequence[float], color: str, label: str
) -> None:
    """Shares with their errors as per cent, one below the other."""
    middle, bars = 100 * np.asarray(values), 100 * np.asarray(errors)
    axes.errorbar(middle, range(len(names)), xerr=bars, fmt="o", ms=4, color=color, capsize=2, label=label)
    axes.set_yticks(range(len(names)), list(map(plain_text, names)))
    axes.invert_yaxis()


def _shorten(name: str) -> str:
    """The name of a source as it is drawn: `c.las: 2.0` for digitizer 2, scanner channel 0."""
    return name.replace(" digitizer ", ": ").replace(" scanner channel ", ".")
