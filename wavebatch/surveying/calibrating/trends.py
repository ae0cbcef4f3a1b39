"""Whether brightness depends on how a place was seen: by scan angle, incidence, range and time, in the overlaps.

`calibrate_flight` calls `fit_swath` for `calibrate --scan-angle`, and `find_trend` for scatter that no constant
explains.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.system import swath_columns
from wavebatch.surveying.calibrating.adjust_flight import Adjustment, Anchors, adjust_constants
from wavebatch.surveying.calibrating.tie_cells import Ties

LEAST_SPREAD = 0.01
"""Smaller changes of the brightness are not named."""

EXPLAINED = 0.8
"""A trend leaves at most this share of the scatter."""

MOST_EDGE_ERROR = 0.05
"""The term over the scan angle is refused where it is less certain than this at the edge of the swath, relative."""

LEAST_LEFT = 0.05
"""What constants and even terms must leave of u (root mean square) for a term that falls from side to side."""

_EDGES = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, -1.0]])
"""The columns of `swath_columns` at both edges of the swath."""

_REMEDY = {
    "scan angle": "fit it with --scan-angle",
    "incidence": "surfaces are not matt, or a term over the scan angle is missing (--scan-angle)",
    "range": "check --attenuation and the heights of the trajectory",
    "time": "the laser drifts along the strips: calibrate shorter ones",
}


class Trend(NamedTuple):
    """What the brightness of the tie cells depends on most."""

    doubt: str
    """A sentence with what to do."""
    spread: float
    """Root mean square of what it changes against the places of the targets, relative."""


def fit_swath(
    ties: Ties, anchors: Anchors, seen: np.ndarray
) -> tuple[Adjustment, tuple[float, ...], float | None]:
    """Adjust the constants with a term over the scan angle.

    Parameters
    ----------
    ties : Ties
    anchors : Anchors
    seen : array of VIEW (n,)
        How each source saw the targets.

    Returns
    -------
    adjusted : Adjustment
        With the constants straight below the sensor.
    swath : (float, float, float, float)
        As `Radiometry.swath`.
    open_error : float or None
        Error of the constants, relative, where the strips leave open whether light falls from side to side: as if that
        made their constants differ, or stood for what falls to both edges. None where they tell it.

    Raises
    ------
    InputError
        If the overlaps do not determine the term.
    """
    most = float(np.abs(ties.view["angle"]).max(initial=0.0))
    columns, edge = swath_columns(ties.view["angle"], most or 1.0), np.inf
    at_targets = np.nan_to_num(swath_columns(seen["angle"], most or 1.0))
    odd = _tells_sides(ties, anchors, columns)
    used = 3 if odd else 2
    adjusted = adjust_constants(ties, replace(anchors, columns=at_targets[:, :used]), columns[:, :used])
    if len(ties.cell):
        edge = max(float(np.std(adjusted.term_trials @ side[:used], ddof=1)) for side in _EDGES)
    if not 0 < edge <= MOST_EDGE_ERROR:
        raise InputError(
            f"--scan-angle: the overlaps do not show the light at the edge of the swath to {100 * MOST_EDGE_ERROR:.0f} "
            "%; give strips that overlap by a third or more, or leave --scan-angle out"
        )
    if odd:
        return adjusted, (most, *map(float, adjusted.terms)), None
    other = adjust_constants(ties, replace(anchors, columns=at_targets[:, 2:]), columns[:, 2:], 0)
    return adjusted, (most, *map(float, adjusted.terms), 0.0), _leave_open(ties, adjusted, other, columns[:, 2])


def _tells_sides(ties: Ties, anchors: Anchors, columns: np.ndarray) -> bool:
    """Whether constants and a term that is alike on both sides cannot stand for one that falls from side to side: they
    can where headings are alike, and where two strips of opposite headings overlap."""
    side = replace(ties, value=columns[:, 2], error=np.full(len(columns), 1e-3))
    free = Anchors(0.0 * anchors.value, 1e3 * np.ones(len(anchors.value)), np.zeros((len(anchors.value), 2)))
    rest = adjust_constants(side, free, columns[:, :2], 0).residual
    return bool(len(rest) and np.nanstd(rest) > LEAST_LEFT)


def _leave_open(ties: Ties, adjusted: Adjustment, other: Adjustment, side: np.ndarray) -> float:
    """Error of the constants if they differ because each strip was seen from another side, or if the light falls from
    side to side and not to both edges, where that explains the overlaps nearly as well."""
    n, grid = len(adjusted.value), np.linspace(-1.0, 1.0, 21)
    place = np.bincount(ties.source, side, n) / np.maximum(adjusted.ties, 1)
    known = np.isfinite(adjusted.value) & (adjusted.ties > 0)
    off, value = place[known] - place[known].mean(), adjusted.value[known] - adjusted.value[known].mean()
    drift = float(abs(off @ value) / max(off @ off, 1e-3) * np.sqrt(np.mean(side**2)))
    apart = float(np.mean(adjusted.value[known] - other.value[known]))
    apart = apart + swath_columns(grid, 1.0) @ [*adjusted.terms, -other.terms[0]]
    alike = other.scatter < max(LEAST_SPREAD, adjusted.scatter / EXPLAINED)
    return max(drift, float(np.sqrt(np.mean(apart**2))) if alike else 0.0)


def find_trend(ties: Ties, anchors: Anchors, seen: np.ndarray, adjusted: Adjustment) -> Trend | None:
    """Find what explains most of the scatter that constants leave in the overlaps; None where nothing explains a part.

    Parameters
    ----------
    ties : Ties
    anchors : Anchors
    seen : array of VIEW (n,)
        How each source saw the targets.
    adjusted : Adjustment
    """
    best, least = None, EXPLAINED * adjusted.scatter
    if adjusted.scatter < LEAST_SPREAD:
        return None
    for name, columns, at_targets in _list_columns(ties, seen):
        known = np.isfinite(at_targets).all(axis=1)
        fit = adjust_constants(ties, replace(anchors, columns=np.where(known[:, None], at_targets, 0.0)), columns, 0)
        if fit.scatter >= least:
            continue
        used = np.isfinite(fit.residual)
        effect = columns[used] @ fit.terms - float(np.mean(at_targets[known] @ fit.terms))
        low, high = np.quantile(effect, [0.02, 0.98])
        share = f"{100 * np.expm1(high - low):.0f} %"
        doubt = f"brightness changes with the {name} by {share} in the overlaps: {_REMEDY[name]}"
        best, least = Trend(doubt, float(np.sqrt(np.mean(effect**2)))), fit.scatter
    return best


def _list_columns(ties: Ties, seen: np.ndarray) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Name, columns (k, m) at the ties and (n, m) at the targets, of each quantity."""
    view = ties.view
    most = float(np.abs(view["angle"]).max())
    yield "scan angle", swath_columns(view["angle"], most or 1.0), swath_columns(seen["angle"], most or 1.0)
    yield "incidence", 1.0 - np.cos(view["incidence"])[:, None], 1.0 - np.cos(seen["incidence"])[:, None]
    middle = float(np.median(view["distance"])) or 1.0
    yield "range", view["distance"][:, None] / middle - 1.0, seen["distance"][:, None] / middle - 1.0
    n = len(seen)
    start, stop = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(start, ties.source, view["time"])
    np.maximum.at(stop, ties.source, view["time"])
    with np.errstate(invalid="ignore", divide="ignore"):
        along, at_targets = ((time - start[of]) / (stop - start)[of] - 0.5 for time, of in (
            (view["time"], ties.source), (seen["time"], np.arange(n))))  # fmt: skip
    if np.isfinite(along).all():
        yield "time", along[:, None] * (ties.source[:, None] == np.arange(n)), np.diag(at_targets)
