"""Found echoes beside true ones: pairs of them, one to one, and errors in units of the Cramer-Rao bound.

Called by `bench`, `compare --truth` and predictions of errors.
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.order import join_ranges, robust_std

TOLERANCE_NS = 1.5
"""A found and a true echo further apart than this are not the same echo."""

ISOLATED = 6.0
"""An echo without a neighbour within this many sigma (of the wider one) is isolated: the closed bounds hold for it."""

QUANTITIES = ("time", "amplitude", "sigma")

class Match(NamedTuple):
    """Pairs of found and true echoes, one to one, sorted by the true ones."""

    found: np.ndarray
    """Rows of the found table, i8 (k,)."""
    truth: np.ndarray
    """Rows of the true table, i8 (k,)."""


def match_echoes(found: EchoTable, truth: EchoTable, tolerance_ns: float = TOLERANCE_NS) -> Match:
    """Match found and true echoes of the same waveform one to one, the closest pair first.

    Parameters
    ----------
    found, truth : EchoTable
        Echoes of the same waveforms.
    tolerance_ns : float
        Largest distance in time of a pair [ns].

    Returns
    -------
    Match
        Rows of both tables, sorted by the true ones.
    """
    left, right = list_pairs(found.waveform, found.time, truth.waveform, truth.time, tolerance_ns)
    distance = np.abs(found.time[left] - truth.time[right])
    kept = pair_nearest(left, right, distance, len(found), len(truth))
    order = np.argsort(right[kept], kind="stable")
    return Match(left[kept][order], right[kept][order])


def list_pairs(
    group_a: np.ndarray, value_a: np.ndarray, group_b: np.ndarray, value_b: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """List every pair (row of a, row of b) of one group whose values differ by at most `tolerance`.

    Parameters
    ----------
    group_a, group_b : int array, shape (m,) and (k,)
        Groups, in any order.
    value_a, value_b : float array, shape (m,) and (k,)
        Finite values.
    tolerance : float
        Largest difference.

    Returns
    -------
    left, right : int64 array
        Rows of a and rows of b.
    """
    none = np.empty(0, np.int64)
    if not len(group_a) or not len(group_b):
        return none, none
    low = min(value_a.min(), value_b.min())
    span = max(value_a.max(), value_b.max()) - low + 4 * tolerance + 1.0
    key_a = group_a * span + (value_a - low)
    key_b = group_b * span + (value_b - low)
    order = np.argsort(key_a, kind="stable")
    ordered = key_a[order]
    # Keys are rounded, so the search reaches a little further; the exact test follows.
    reach = tolerance + 1e-9 * max(abs(ordered[0]), abs(ordered[-1]), 1.0)
    start = np.searchsorted(ordered, key_b - reach, side="left")
    number = np.searchsorted(ordered, key_b + reach, side="right") - start
    right = np.repeat(np.arange(len(group_b)), number)
    left = order[join_ranges(start, number)]
    same = (group_a[left] == group_b[right]) & (np.abs(value_a[left] - value_b[right]) <= tolerance)
    return left[same], right[same]


def pair_nearest(left: np.ndarray, right: np.ndarray, distance: np.ndarray, n_left: int, n_right: int) -> np.ndarray:
    """Choose pairs greedily by distance, then right row, then left row, so that each row is used once.

    Parameters
    ----------
    left, right : int array, shape (k,)
        Rows of each pair.
    distance : float array, shape (k,)
        Distance of each pair.
    n_left, n_right : int
        Number of rows on each side.

    Returns
    -------
    int64 array
        Indices of the chosen pairs.

    Notes
    -----
    Each round keeps the pairs that are the best of both their rows and drops all other pairs of these rows. This
    gives the same result as a loop over all pairs in order.
    """
    order = np.lexsort((left, right, distance))
    kept = []
    while len(order):
        place = np.arange(len(order))
        best_left = np.full(n_left, len(order))
        best_right = np.full(n_right, len(order))
        # Reversed, so that the first pair of each row is written last and stays.
        best_left[left[order][::-1]] = place[::-1]
        best_right[right[order][::-1]] = place[::-1]
        chosen = (best_left[left[order]] == place) & (best_right[right[order]] == place)
        winners = order[chosen]
        kept.append(winners)
        done_left = np.zeros(n_left, bool)
        done_right = np.zeros(n_right, bool)
        done_left[left[winners]] = True
        done_right[right[winners]] = True
        order = order[~done_left[left[order]] & ~done_right[right[order]]]
    return np.concatenate(kept) if kept else np.empty(0, np.int64)


@frozen
class ErrorStats:
    """Errors of one quantity over matched echoes, in its unit; NaN without echoes."""

    number: int
    bias: float
    """Mean of found minus true."""
    rmse: float
    nmad: float
    """MAD_TO_STD times the median absolute deviation from the median: the spread without outliers."""
    rms_per_bound: float
    """Root mean square of error / Cramer-Rao bound of an isolated echo."""
    nmad_per_bound: float
    calibration: float
    """Root mean square of error / reported error: 1 when the reported errors are right."""
    calibration_nmad: float

    @classmethod
    def compute(cls, error: np.ndarray, bound: np.ndarray, reported: np.ndarray) -> ErrorStats:
        """Compute statistics of errors (k,) with their bounds and reported standard deviations (NaN: none)."""
        known = np.isfinite(reported) & (reported > 0)
        scaled = error[known] / reported[known]
        spreads: list[float] = []
        for values in (error, error / bound, scaled):
            spreads += [float(np.sqrt(np.mean(np.square(values)))), robust_std(values)] if len(values) else [np.nan] * 2
        return cls(len(error), float(error.mean()) if len(error) else np.nan, *spreads)


def find_isolated_echoes(truth: EchoTable) -> np.ndarray:
    """Find echoes to which the closed bounds apply: alone, inside the window, not clipped.

    Parameters
    ----------
    truth : EchoTable
        True echoes, m of them.

    Returns
    -------
    bool array, shape (m,)
        True for isolated echoes.
    """
    bad = truth.flags & np.uint16(EchoFlag.OVERLAPPED | EchoFlag.NEAR_EDGE | EchoFlag.SATURATED)
    return ~(has_neighbour(truth, ISOLATED) | (bad != 0))


def has_neighbour(truth: EchoTable, reach: float) -> np.ndarray:
    """Find true echoes, bool (m,), with another one of their waveform within so many sigma of the wider of both."""
    sigma = truth.sigma.astype(np.float64)
    close = np.diff(truth.time) < reach * np.maximum(sigma[1:], sigma[:-1])
    close &= np.diff(truth.waveform) == 0
    return np.append(close, False)[: len(truth)] | np.append(False, close)[: len(truth)]
