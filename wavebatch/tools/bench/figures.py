"""Figures of a benchmark: values with an error, and the choice of chains by them.

`accuracy` makes the figures, `command` and `plot` compare them. The error of a figure is that of the difference of two
runs with other seeds, because that is what a reader compares.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from wavebatch.core.no_data import without_nan

NOTHING = float("nan")

SURVEY_SCATTER = 0.05
"""Relative scatter of an rms error between strips that differ only in their survey, measured on 16 strips with a
learned pulse. At least this much is assumed, because a few groups can miss it by chance."""

OUTLIER = 10.0
"""Error of the worst echo of another run, in units of the root mean square."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A value and its error: the standard error of the difference between two runs that differ in their seed.

    That is 1.41 times the standard error of the value, which is the larger of two estimates: from the scatter of single
    waveforms, and from the scatter of the groups, which are simulated and surveyed separately.
    """

    value: float = NOTHING
    error: float = NOTHING

    def to_json(self) -> dict[str, Any]:
        """Value and error; None where there were no data."""
        return without_nan(asdict(self))

    def scale(self, factor: float) -> Figure:
        """The figure in another unit."""
        return Figure(self.value * factor, self.error * factor)


def share_figure(part: np.ndarray, whole: np.ndarray, group: np.ndarray) -> Figure:
    """Sum of `part` over that of `whole`, counts per waveform (n,) in groups (n,), as a figure.

    Shares near 0 or 1 keep the error that two counts more or less would make (Agresti and Coull 1998).
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

    The error includes the scatter of surveys, and one more echo OUTLIER times as bad as the others.
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
    """Standard error of an estimate from the contribution of each independent waveform, (n,)."""
    single = float(np.sqrt(np.square(influence).sum()))
    sums = np.bincount(group, influence)[np.unique(group)]
    g = len(sums)
    if g < 4:
        return single
    # The scatter of few groups is itself uncertain: the standard deviation of Student's t with g - 1 degrees.
    return max(single, float(np.sqrt(g / (g - 3) * np.square(sums).sum())))


def median_range(values: list[float]) -> dict[str, Any]:
    """Median, least, most and number of repeated measurements; None without any."""
    found = [float(measure(values)) if values else None for measure in (np.median, min, max)]
    return {**dict(zip(("median", "min", "max"), found, strict=True)), "repeats": len(values)}


def find_front(costs: Sequence[Sequence[float | None]]) -> np.ndarray:
    """Pareto front: True for the rows of costs (n, k) that no other row beats.

    A row beats another if it is as good in all columns and better in one. Rows with an unknown cost (None or NaN) are
    never on the front.
    """
    values = np.array(costs, np.float64)
    known = np.isfinite(values).all(axis=1)
    no_worse = (values[:, None, :] <= values[None, :, :]).all(axis=2)
    better = (values[:, None, :] < values[None, :, :]).any(axis=2)
    return known & ~(no_worse & better & known[:, None]).any(axis=0)


def choose_cheapest(rows: Sequence[Mapping], tolerance_cm: float) -> Mapping | None:
    """The row of least time per waveform whose isolated echoes, their error added, meet the tolerance; None if none.

    rows: as in the document of the benchmark.
    """

    def is_good(row: Mapping) -> bool:
        error = row["figures"]["rmse_isolated_cm"]
        return error["value"] is not None and error["value"] + (error["error"] or 0) <= tolerance_cm

    good = [row for row in rows if row["kernels"]["median"] is not None and is_good(row)]
    return min(good, key=lambda row: (row["kernels"]["median"], row["name"]), default=None)
