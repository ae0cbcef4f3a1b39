"""One adjustment of a flight: the constants of all channels and strips that agree on targets and where they overlap.

`calibrate_flight` calls `adjust_constants`. Unknown are the logarithm of the constant of every source (a channel of a
strip) and the brightness of every tie cell; targets give the level. Outliers are weighted down, and errors come from
resampling blocks of the overlap, since neighbouring cells share roads, fields and wet ground.
"""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np
from scipy.sparse import csr_array, hstack
from scipy.sparse.csgraph import connected_components

from wavebatch.core.frozen import frozen
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


@frozen(eq=False)
class Adjustment:
    """The constants of n sources; NaN for sources that neither a target nor a chain of ties reaches."""

    value: np.ndarray
    """Logarithm of the constant, f8 (n,)."""
    error: np.ndarray
    """Standard deviation without that of the targets' reflectance, f8 (n,); with the terms, over its ties."""
    trials: np.ndarray
    """The values of the resamples, f8 (TRIALS, n): for errors of differences."""
    ties: np.ndarray
    """Tie cells of each source, i8 (n,)."""
    residual: np.ndarray
    """Brightness that each row of the ties has beyond the adjusted one, f8 (k,)."""
    scatter: float = 0.0
    """Robust standard deviation of the brightness of one row, beyond what the errors of the ties explain."""
    terms: np.ndarray = field(default_factory=lambda: np.empty(0))
    """Coefficients of the columns that were fitted too, f8 (m,)."""
    term_trials: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    """Those of the resamples, f8 (TRIALS, m)."""


@frozen(eq=False)
class Anchors:
    """What targets say of the n sources."""

    value: np.ndarray
    """Logarithm of the constant that they gave each source, f8 (n,); NaN where none did."""
    error: np.ndarray
    """Standard deviation of each, f8 (n,)."""
    columns: np.ndarray | None = None
    """The fitted columns at the targets, f8 (n, m)."""


def adjust_constants(
    ties: Ties, anchors: Anchors, columns: np.ndarray | None = None, trials: int = TRIALS
) -> Adjustment:
    """Adjust the constants of sources.

    Parameters
    ----------
    ties : Ties
    anchors : Anchors
    columns : float64 (k, m), optional
        Of each row of the ties, functions of how it was seen: their coefficients are fitted too.
    trials : int
        Resamples for the errors; 0 leaves them unknown.

    Returns
    -------
    Adjustment

    Notes
    -----
    value_ks = r_k - c_s - columns_ks . terms, by least squares with weights 1 / (error^2 + scatter^2), where the
    scatter between cells comes from the residuals; Huber's weights in eight rounds. docs/algorithms.md 5.3.
    """
    n = len(anchors.value)
    columns = np.empty((len(ties.cell), 0)) if columns is None else columns
    reached = _reach(ties, np.flatnonzero(np.isfinite(anchors.value)), n)
    use = reached[ties.source]
    cell, source, value, error = ties.cell[use], ties.source[use], ties.value[use], ties.error[use]
    one = csr_array((np.ones(len(cell)), (np.arange(len(cell)), source)), (len(cell), n))
    equations = _Equations(hstack([one, csr_array(columns[use])], format="csr"), cell, value, anchors, reached)
    weight = error**-2.0
    found = np.append(np.where(reached, anchors.value, np.nan), np.zeros(columns.shape[1]))
    rest = np.zeros(len(cell))
    for _ in range(_ROUNDS if len(cell) else 0):
        found = equations.solve(weight)
        rest = equations.residuals(weight, found)
        scatter = max(MAD_TO_STD * float(np.median(np.abs(rest))), _LEAST_SCATTER)
        # Errors of fits are in the residuals already: the larger of the two is what a row is known to.
        spread = np.maximum(error, scatter)
        weight = spread**-2.0 * np.minimum(1.0, HUBER * scatter / np.maximum(np.abs(rest), 1e-12))
    again = equations.resample(weight, ties.centre[use], trials)
    residual = np.full(len(ties.cell), np.nan)
    residual[use] = rest
    errors = _errors(equations.design, source, again, n) if trials else np.full(n, np.nan)
    number = np.bincount(source, minlength=n)
    return Adjustment(
        found[:n], errors, again[:, :n], number, residual, _excess(rest, cell, error), found[n:], again[:, n:]
    )


def _errors(design: csr_array, source: np.ndarray, trials: np.ndarray, n: int) -> np.ndarray:
    """Standard deviations f8 (n,) of the constants; of sources with ties, of constants and terms over their ties."""
    error = np.std(trials[:, :n], axis=0, ddof=1)
    if trials.shape[1] > n and design.shape[0]:
        square = np.var(design @ np.nan_to_num(trials).T, axis=1, ddof=1)
        count = np.bincount(source, minlength=n)
        error = np.where(count > 0, np.sqrt(np.bincount(source, square, n) / np.maximum(count, 1)), error)
    return error


def _excess(rest: np.ndarray, cell: np.ndarray, error: np.ndarray) -> float:
    """Robust standard deviation of the brightness of a row beyond its error; a cell's mean takes a part of it away."""
    count = np.bincount(cell)[cell]
    shared = count > 1
    if not shared.any():
        return 0.0
    free = np.sqrt(count[shared] / (count[shared] - 1))
    scatter = MAD_TO_STD * float(np.median(np.abs(rest[shared]) * free))
    return float(np.sqrt(max(scatter**2 - float(np.median(error)) ** 2, 0.0)))


def _reach(ties: Ties, known: np.ndarray, n: int) -> np.ndarray:
    """Sources that are tied, over any number of others, to one with a target; bool (n,)."""
    shared = csr_array((np.ones(len(ties.cell)), (ties.cell, ties.source)), (int(ties.cell.max(initial=-1)) + 1, n))
    common = (shared.T @ shared).tocsr()
    common.data = (common.data >= LEAST_TIES).astype(float)
    common.eliminate_zeros()
    _, group = connected_components(common, directed=False)
    return np.isin(group, group[known])


@frozen(eq=False)
class _Equations:
    """Those of k rows of ties for the constants of n sources and the coefficients of m columns."""

    design: csr_array
    """(k, n + m)."""
    cell: np.ndarray
    value: np.ndarray
    anchors: Anchors
    reached: np.ndarray
    """Sources that are tied to a target, bool (n,)."""

    def solve(self, weight: np.ndarray) -> np.ndarray:
        """Constants and coefficients f8 (n + m,) for weights (k,); NaN for sources that are not reached."""
        design, cell, anchors = self.design, self.cell, self.anchors
        n, known = len(self.reached), np.flatnonzero(np.isfinite(anchors.value))
        more = np.zeros((n, design.shape[1] - n)) if anchors.columns is None else anchors.columns
        fixed = np.concatenate([np.eye(n)[known], more[known]], axis=1)
        firm = anchors.error[known] ** -2.0
        normal, right = fixed.T @ (firm[:, None] * fixed), fixed.T @ (firm * anchors.value[known])
        if len(cell):
            # The brightness of each cell is eliminated: only what differs within cells counts.
            cells = int(cell.max()) + 1
            whole = np.maximum(np.bincount(cell, weight, cells), 1e-300)
            gather = csr_array((weight, (cell, np.arange(len(cell)))), (cells, len(cell)))
            table = gather @ design
            normal += (design.T @ (design.multiply(weight[:, None]))).toarray()
            normal -= (table.T @ (table.multiply(1.0 / whole[:, None]))).toarray()
            right -= design.T @ (weight * self.value) - table.T @ (gather @ self.value / whole)
        found = np.full(design.shape[1], np.nan)
        some = np.flatnonzero(np.append(self.reached, np.ones(design.shape[1] - n, bool)))
        found[some] = np.linalg.lstsq(normal[np.ix_(some, some)], right[some], rcond=1e-12)[0]
        return found

    def residuals(self, weight: np.ndarray, found: np.ndarray) -> np.ndarray:
        """Brightness of each row beyond the mean of its cell, f8 (k,)."""
        bright = self.value + self.design @ np.nan_to_num(found)
        mean = np.bincount(self.cell, weight * bright) / np.maximum(np.bincount(self.cell, weight), 1e-300)
        return bright - mean[self.cell]

    def resample(self, weight: np.ndarray, centre: np.ndarray, trials: int) -> np.ndarray:
        """Solutions with blocks of cells drawn again, and targets changed by their errors; f8 (trials, n + m)."""
        rng = np.random.default_rng(0)
        _, block = np.unique(np.floor(centre / BLOCK), axis=0, return_inverse=True)
        blocks = int(block.max(initial=-1)) + 1
        found = np.empty((trials, self.design.shape[1]))
        value, error = self.anchors.value, self.anchors.error
        for row in found:
            drawn = np.bincount(rng.integers(0, max(blocks, 1), blocks), minlength=blocks).astype(float)
            # A little of every block stays: without it a source that few blocks tie could be lost.
            part = weight * np.maximum(drawn[block.ravel()], 1e-3) if blocks else weight
            moved = replace(self.anchors, value=value + error * rng.standard_normal(len(value)))
            row[:] = replace(self, anchors=moved).solve(part)
        return found
