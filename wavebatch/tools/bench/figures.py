"""Figures of a benchmark: a value and how much it moves when the benchmark is run again with another seed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from wavebatch.core.no_data import without_nan

NOTHING = float("nan")

SURVEY_SCATTER = 0.05
"""Relative scatter of an rms error between strips that differ in their survey alone, as measured on 16 strips with a
learned pulse: a few groups may happen not to show it."""

OUTLIER = 10.0
"""How much worse than the root mean square the worst echo of another run may be."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A value and its error: the standard error of the difference between two runs that differ in their seed.

    That is 1.41 times the standard error of the value itself, which is the larger of two estimates: from the scatter
    of single waveforms, and from the scatter of the groups that were simulated and surveyed apart.
    """

    value: float = NOTHING
    error: float = NOTHING

    def to_json(self) -> dict[str, Any]:
        """Value and error; None for what there was nothing to tell from."""
        return without_nan({"value": self.value, "error": self.error})

    def scale(self, factor: float) -> Figure:
        """The figure in another unit."""
        return Figure(self.value * factor, self.error * factor)


def share(part: np.ndarray, whole: np.ndarray, group: np.ndarray) -> Figure:
    """Sum of `part` over that of `whole`, counts per waveform (n,) in groups (n,), as a figure.

    Shares of nearly nothing or nearly all keep an error of what two more or fewer would be (Agresti and Coull).
    """
    total = float(whole.sum())
    if not total:
        return Figure()
    value = float(part.sum()) / total
    error = _standard_error((part - value * whole) / total, group)
    drawn = (total * value + 2) / (total + 4)
    return Figure(value, float(np.sqrt(2) * max(error, np.sqrt(drawn * (1 - drawn) / (total + 4)))))


def root_mean_square(values: np.ndarray, waveform: np.ndarray, group: np.ndarray) -> Figure:
    """Root mean square of values (m,) of echoes of the given waveforms (m,), unique over all groups, as a figure.

    The error allows for surveys that differ and for one more echo OUTLIER times as bad as the others.
    """
    if len(values) < 2:
        return Figure()
    squares = np.square(values.astype(np.float64))
    mean = float(squares.mean())
    if not mean:
        return Figure(0.0, 0.0)
    influence = (squares - mean) / (2 * np.sqrt(mean) * len(squares))
    _, place, where = np.unique(waveform, return_index=True, return_inverse=True)
    per_waveform = np.bincount(where, influence)
    error = _standard_error(per_waveform, group[place])
    rare = np.sqrt(mean) * (np.sqrt(1 + OUTLIER**2 / len(squares)) - 1)
    surveys = SURVEY_SCATTER * np.sqrt(mean / len(np.unique(group)))
    return Figure(float(np.sqrt(mean)), float(np.hypot(np.sqrt(2) * max(error, surveys), rare)))


def _standard_error(influence: np.ndarray, group: np.ndarray) -> float:
    """Standard error of an estimate from what each independent waveform (n,) contributed to it."""
    single = float(np.sqrt(np.square(influence).sum()))
    sums = np.bincount(group, influence)[np.unique(group)]
    g = len(sums)
    if g < 4:
        return single
    # The scatter of few groups is itself uncertain: the standard deviation of Student's t with g - 1 degrees.
    return max(single, float(np.sqrt(g / (g - 3) * np.square(sums).sum())))


def median_range(values: list[float]) -> dict[str, Any]:
    """Median, least, most and number of repeated measurements of time; None of none."""
    if not values:
        return {"median": None, "min": None, "max": None, "repeats": 0}
    return {
        "median": float(np.median(values)),
        "min": float(min(values)),
        "max": float(max(values)),
        "repeats": len(values),
    }
