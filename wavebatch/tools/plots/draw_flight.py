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
from wavebatch.surveying.calibrating.flight_overlaps import PairOverlap
from wavebatch.surveying.calibration import StripConstant

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
        sizes = [max(len(strips), 1), max(len(pairs), 1)]
        upper, lower = figure.subplots(2, 1, height_ratios=sizes)
        _draw_drifts(upper, strips)
        _draw_pairs(lower, pairs)


def _draw_drifts(axes: Axes, strips: Sequence[StripConstant]) -> None:
    rows = np.arange(len(strips))
    axes.errorbar(
        [100 * row.drift for row in strips], rows, xerr=[100 * row.drift_error for row in strips], fmt="o", ms=4,
        color="#1f5a99", capsize=2,
    )  # fmt: skip
    names = [f"{row.strip}: {row.digitizer}.{row.scanner}" for row in strips]
    axes.set_yticks(rows, [plain_text(name) for name in names])
    axes.invert_yaxis()
    axes.set_title("Drift of each strip (strip: digitizer.scanner channel)")
    axes.set_xlabel("constant off the mean of its channel [%]")


def _draw_pairs(axes: Axes, pairs: Sequence[PairOverlap]) -> None:
    rows = np.arange(len(pairs))
    axes.plot([100 * (pair.ratio - 1) for pair in pairs], rows, "x", color="#b5492f", label="before")
    axes.errorbar(
        [100 * (pair.after - 1) for pair in pairs], rows, xerr=[100 * pair.spread for pair in pairs], fmt="o", ms=4,
        color="#2f7d4f", capsize=2, label="after; bars: spread of the cells",
    )  # fmt: skip
    axes.set_yticks(rows, [plain_text(f"{_shorten(pair.a)} / {_shorten(pair.b)} ({pair.cells})") for pair in pairs])
    axes.invert_yaxis()
    axes.set_title("Overlaps (number of cells)")
    axes.set_xlabel("light of the first over that of the second [%]")
    axes.legend(loc="best")


def _shorten(name: str) -> str:
    """The name of a source as it is drawn: `c.las: 2.0` for digitizer 2, scanner channel 0."""
    return name.replace(" digitizer ", ": ").replace(" scanner channel ", ".")
