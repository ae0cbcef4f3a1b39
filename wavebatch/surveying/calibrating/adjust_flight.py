"""One adjustment of a flight: the constants of all channels and strips that agree on targets and where they overlap.

`calibrate_flight` calls `adjust_constants`. Unknown are the logarithm of the constant of every source (a channel of a
strip) and the brightness of every tie cell; targets give the level. Outliers are weighted down, and errors come from
resampling blocks of the overlap, since neighbouring cells share roads, fields and wet ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from wavebatch.core.units import MAD_TO_STD
from wavebatch.surveying.calibrating.tie_cells import Ties

HUBER = 2.0
"""Residuals beyond so many standard deviations are weighted down."""

LEAST_TIES = 10
"""Two sources are tied by at least so many cells."""

BLOCK = 50.0
"""Edge of the blocks that are resampled [m]."""

TRIALS = 60
"""Resamples: the error is known to 10 %."""

_ROUNDS = 8
_LEAST_SCATTER = 0.003


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """The constants of n sources; NaN for sources that neither a target nor a chain of ties reaches."""

    value: np.ndarray
    """Logarithm of the constant, f8 (n,)."""
    error: np.ndarray
    """Standard deviation without that of the targets' reflectance, f8 (n,)."""
    trials: np.ndarray
    """The values of the resamples, f8 (TRIALS, n): for errors of differences."""
    ties: np.ndarray
    """Tie cells of each source, i8 (n,)."""
    residual: np.ndarray
    """Brightness that each row of the ties has beyond the adjusted one, f8 (k,)."""


def adjust_constants(ties: Ties, given: np.ndarray, given_error: np.ndarray) -> Adjustment:
    """Adjust the constants of sources.

    Parameters
    ----------
    ties : Ties
    given : float64 (n,)
        Logarithm of the constant that targets gave each source; NaN where none did.
    given_error : float64 (n,)
        Standard deviation of each.

    Returns
    -------
    Adjustment

    Notes
    -----
    value_ks = r_k - c_s, by least squares with weights 1 / (error^2 + scatter^2), where the scatter between cells
    comes from the residuals; Huber's weights in eight rounds. docs/algorithms.md 5.3.
    """
    n = len(given)
    known = np.flatnonzero(np.isfinite(given))
    reached = _reach(ties, known, n)
    use = reached[ties.source]
    cell, source, value = ties.cell[use], ties.source[use], ties.value[use]
    weight = ties.error[use] ** -2.0
    found = np.full(n, np.nan)
    rest = np.zeros(len(cell))
    for _ in range(_ROUNDS if len(cell) else 0):
        found = _solve(cell, source, value, weight, given, given_error, reached)
        rest = _residuals(cell, source, value, weight, found)
        scatter = max(MAD_TO_STD * float(np.median(np.abs(rest))), _LEAST_SCATTER)
        # Errors of fits are in the residuals already: the larger of the two is what a row is known to.
        spread = np.maximum(ties.error[use], scatter)
        weight = spread**-2.0 * np.minimum(1.0, HUBER * scatter / np.maximum(np.abs(rest), 1e-12))
    if not len(cell):
        found = np.where(reached, given, np.nan)
    trials = _resample(ties.centre[use], cell, source, value, weight, given, given_error, reached)
    residual = np.full(len(ties.cell), np.nan)
    residual[use] = rest
    number = np.bincount(source, minlength=n) if len(cell) else np.zeros(n, np.int64)
    return Adjustment(found, np.std(trials, axis=0, ddof=1), trials, number, residual)


def _reach(ties: Ties, known: np.ndarray, n: int) -> np.ndarray:
    """Sources that are tied, over any number of others, to one with a target; bool (n,)."""
    shared = csr_array((np.ones(len(ties.cell)), (ties.cell, ties.source)), (int(ties.cell.max(initial=-1)) + 1, n))
    common = (shared.T @ shared).tocsr()
    common.data = (common.data >= LEAST_TIES).astype(float)
    common.eliminate_zeros()
    _, group = connected_components(common, directed=False)
    return np.isin(group, group[known])


def _solve(cell, source, value, weight, given, given_error, reached) -> np.ndarray:
    """Constants f8 (n,) for these weights; NaN for sources that are not reached."""
    n, known = len(given), np.isfinite(given)
    normal, right = np.zeros((n, n)), np.zeros(n)
    if len(cell):
        cells = int(cell.max()) + 1
        table = csr_array((weight, (cell, source)), (cells, n))
        whole = np.maximum(np.bincount(cell, weight, cells), 1e-300)
        mean = np.bincount(cell, weight * value, cells) / whole
        shared = csr_array((weight / whole[cell], (cell, source)), (cells, n))
        normal = np.diag(np.bincount(source, weight, n)) - (shared.T @ table).toarray()
        right = -np.bincount(source, weight * (value - mean[cell]), n)
    fixed = np.zeros(n)
    fixed[known] = given_error[known] ** -2.0
    right = right + np.where(known, fixed * np.where(known, given, 0.0), 0.0)
    normal = normal + np.diag(fixed)
    found = np.full(n, np.nan)
    some = np.flatnonzero(reached)
    found[some] = np.linalg.lstsq(normal[np.ix_(some, some)], right[some], rcond=1e-12)[0]
    return found


def _residuals(cell, source, value, weight, found) -> np.ndarray:
    bright = value + found[source]
    cells = int(cell.max(initial=-1)) + 1
    mean = np.bincount(cell, weight * bright, cells) / np.maximum(np.bincount(cell, weight, cells), 1e-300)
    return bright - mean[cell]


def _resample(centre, cell, source, value, weight, given, given_error, reached) -> np.ndarray:
    """Constants with blocks of cells drawn again, and targets changed by their errors; f8 (TRIALS, n)."""
    rng = np.random.default_rng(0)
    _, block = np.unique(np.floor(centre / BLOCK), axis=0, return_inverse=True)
    blocks = int(block.max(initial=-1)) + 1
    trials = []
    for _ in range(TRIALS):
        drawn = np.bincount(rng.integers(0, max(blocks, 1), blocks), minlength=blocks).astype(float)
        # A little of every block stays: without it a source that few blocks tie could be lost.
        part = weight * np.maximum(drawn[block.ravel()], 1e-3) if blocks else weight
        moved = given + given_error * rng.standard_normal(len(given))
        trials.append(_solve(cell, source, value, part, moved, given_error, reached))
    return np.array(trials)
