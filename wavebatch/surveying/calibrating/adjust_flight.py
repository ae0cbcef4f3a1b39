"""One adjustment of a flight: the constants of all channels and strips that agree on targets and where they overlap.

Tie cells are small flat places that several strips or channels saw with single echoes: `calibrate_flight` collects the
echoes of every strip, and `measure_ties` compares them cell by cell. A source is one channel of one strip.

`adjust_constants`: unknown are the logarithm of the constant of every source and the brightness of every tie cell;
targets give the level. Outliers are weighted down, and errors come from resampling blocks of the overlap, since
neighbouring cells share roads, fields and wet ground. `compare_pairs` and `find_doubts` say what the strips of a
calibrated flight have in common, and what a person should look at.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import field, replace

import numpy as np
from scipy.sparse import csr_array, hstack
from scipy.sparse.csgraph import connected_components

from wavebatch.core.frozen import frozen
from wavebatch.core.order import group_medians, robust_std
from wavebatch.core.units import MAD_TO_STD, MEDIAN_ERROR
from wavebatch.core.waveforms import angle_across
from wavebatch.kernels.geometry.planes import fit_planes
from wavebatch.surveying.calibration import StripConstant

TIE = np.dtype([
    ("xyz", "<f4", 3), ("ray", "<f4", 3), ("light", "<f4"), ("source", "<i4"), ("distance", "<f4"), ("time", "<f8"),
])  # fmt: skip
"""A single echo: position from a common origin [m], unit direction of its ray, R^2 A sigma / eta, number of source,
range [m], GPS time [s]."""

VIEW = np.dtype([("angle", "<f8"), ("incidence", "<f8"), ("distance", "<f8"), ("time", "<f8")])
"""How a source saw a cell: angle of the ray across the flight and to the normal [rad], range [m], GPS time [s]."""

LEAST_ECHOES = 5
"""Echoes that a source needs in a cell."""

MOST_SCATTER = 0.1
"""Largest standard deviation about the plane of a flat cell [m]: grass and gravel, no crops and no bushes."""

LEAST_KEPT = 0.8
"""Share of the echoes that must lie on the plane."""

STEEPEST = np.radians(50.0)
"""Largest angle of incidence: beyond, a degree changes the cosine by 2 %."""

SMALLEST, LARGEST = 1.0, 10.0
"""Limits of the size of cells [m]."""


@frozen(eq=False)
class Ties:
    """What sources saw in cells that at least two of them saw; arrays (k,), one row per source and cell."""

    cell: np.ndarray
    """Number of the cell, from 0."""
    source: np.ndarray
    value: np.ndarray
    """Logarithm of the median of light / (4 cos(alpha))."""
    error: np.ndarray
    """Standard deviation of the value by the scatter of the echoes."""
    height: np.ndarray
    """Median height of the source's echoes over one plane of the cell [m]: it compares within a cell only."""
    slope: np.ndarray
    """Slope of the cell [rad]."""
    centre: np.ndarray
    """Centre of the cell, f8 (k, 2) [m]."""
    size: float
    """Edge of a cell [m]."""
    view: np.ndarray = field(default_factory=lambda: np.empty(0, VIEW))
    """Array of VIEW (k,): by the middle echo in time of each row."""


def choose_size(rows: np.ndarray) -> float:
    """Return the size of cells [m] that hold twice LEAST_ECHOES of the sparsest source; rows: array of TIE."""
    sizes = []
    for source in np.unique(rows["source"]):
        xy = rows["xyz"][rows["source"] == source, :2]
        area = len(np.unique(np.floor(xy / LARGEST), axis=0)) * LARGEST**2
        sizes.append(np.sqrt(2 * LEAST_ECHOES * area / len(xy)))
    return float(np.clip(max(sizes, default=SMALLEST), SMALLEST, LARGEST))


def hash_squares(xyz: np.ndarray) -> np.ndarray:
    """Return a number from 0 to 1 for the square of 10 m that each position f8 (n, 3) lies in, the same in every strip.

    Echoes below a share come from that share of the squares: a sample with whole cells.
    """
    x, y = (np.floor(xyz[:, axis] / LARGEST).astype(np.int64).astype(np.uint64) for axis in (0, 1))
    mixed = (x * np.uint64(0x9E3779B97F4A7C15)) ^ (y * np.uint64(0xC2B2AE3D27D4EB4F))
    mixed ^= mixed >> np.uint64(29)
    mixed *= np.uint64(0xBF58476D1CE4E5B9)
    return (mixed >> np.uint64(11)).astype(np.float64) / 2.0**53


def measure_ties(rows: np.ndarray, size: float, slope: float | None = None, rights: np.ndarray | None = None) -> Ties:
    """Measure what each source saw in each flat cell.

    Parameters
    ----------
    rows : array of TIE (n,)
        Clean single echoes of all sources.
    size : float
        Edge of a cell [m].
    slope : float, optional
        Largest slope of a cell [rad]; by default any that rays do not strike too steeply.
    rights : float64 (sources, 2), optional
        Unit vectors to the right of the flight of each source, for the angles of the views.

    Returns
    -------
    Ties
        Only cells that at least two sources saw, that are flat and that no ray struck too steeply.
    """
    index = np.floor(rows["xyz"][:, :2] / size).astype(np.int64)
    _, cell = np.unique(index, axis=0, return_inverse=True)
    rows, cell, pair = _keep_shared(rows, cell.ravel())
    if not len(rows):
        empty = np.empty(0)
        return Ties(
            empty.astype(int), empty.astype(int), empty, empty, empty, empty, np.empty((0, 2)), size, np.empty(0, VIEW)
        )
    _, cell = np.unique(cell, return_inverse=True)
    # The plane goes through the echoes of every source less their mean: strips that lie over each other by a step
    # have the same slope, and the step shows in the heights.
    of = np.unique(pair, return_inverse=True)[1]
    xyz = rows["xyz"].astype(np.float64)
    local, n = xyz - _means(xyz, of)[of], int(cell[-1]) + 1
    planes = fit_planes(local, cell, n)
    normal = planes.normal * np.where(planes.normal[:, 2:] < 0, -1.0, 1.0)
    along = np.einsum("ij,ij->i", local - planes.centre[cell], normal[cell])
    facing = np.abs(np.einsum("ij,ij->i", rows["ray"].astype(np.float64), normal[cell]))
    flat = (planes.spreads[:, 0] < MOST_SCATTER**2) & (planes.kept >= LEAST_KEPT * np.bincount(cell, minlength=n))
    # The plane must be known in two directions: scan lines of one strip may cross a cell in one line.
    flat &= planes.spreads[:, 1] > np.maximum(25.0 * planes.spreads[:, 0], 1e-4)
    tilt = np.arccos(np.clip(normal[:, 2], 0.0, 1.0))
    if slope is not None:
        flat &= tilt <= slope
    on = np.abs(along) <= planes.limit[cell]
    off = np.einsum("ij,ij->i", xyz - _means(xyz, cell)[cell], normal[cell]) / np.maximum(normal[cell, 2], 0.1)
    tilt = tilt[cell]
    flat = flat[cell] & on & (facing > np.cos(STEEPEST))
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.log(rows["light"].astype(np.float64) / (4.0 * facing))
    good = flat & np.isfinite(value)
    rows, kept_cell, pair, value, off, tilt, facing = _keep_shared(
        rows[good], cell[good], value[good], off[good], tilt[good], facing[good]
    )
    if not len(rows):
        return measure_ties(rows, size, None, rights)
    _, at, group, number = np.unique(pair, return_index=True, return_inverse=True, return_counts=True)
    middle, spread = group_medians(value, group)
    _, cells = np.unique(kept_cell[at], return_inverse=True)
    centre = (np.floor(rows["xyz"][at, :2] / size) + 0.5) * size
    height, _ = group_medians(off, group)
    error = MEDIAN_ERROR * np.maximum(spread, 1e-3) / np.sqrt(number)
    middles = at + number // 2
    view = np.empty(len(middles), VIEW)
    view["angle"] = np.nan if rights is None else angle_across(rows["ray"][middles], rights[rows["source"][middles]])
    view["incidence"] = np.arccos(np.clip(facing[middles], 0.0, 1.0))
    view["distance"], view["time"] = rows["distance"][middles], rows["time"][middles]
    return Ties(cells, rows["source"][at], middle, error, height, tilt[at], centre.astype(np.float64), size, view)


def _keep_shared(rows: np.ndarray, cell: np.ndarray, *more: np.ndarray) -> tuple[np.ndarray, ...]:
    """Rows of cells in which at least two sources have LEAST_ECHOES, with cells, numbers of (cell, source), and more.

    Rows come sorted by cell, then source.
    """
    many = int(rows["source"].max(initial=0)) + 1
    pair = cell * many + rows["source"]
    pairs, of, number = np.unique(pair, return_inverse=True, return_counts=True)
    enough = number >= LEAST_ECHOES
    sources = np.bincount(pairs[enough] // many, minlength=int(cell.max(initial=0)) + 1)
    keep = enough[of] & (sources[cell] >= 2)
    order = np.flatnonzero(keep)[np.argsort(pair[keep], kind="stable")]
    return rows[order], cell[order], pair[order], *(values[order] for values in more)


def _means(xyz: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Mean of the rows of each group, f8 (groups, 3)."""
    count = np.bincount(group)
    return np.stack([np.bincount(group, xyz[:, axis]) / count for axis in range(3)], axis=1)


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
    # Sources that are tied, over any number of others, to one with a target.
    shared = csr_array((np.ones(len(ties.cell)), (ties.cell, ties.source)), (int(ties.cell.max(initial=-1)) + 1, n))
    common = (shared.T @ shared).tocsr()
    common.data = (common.data >= LEAST_TIES).astype(float)
    common.eliminate_zeros()
    _, group = connected_components(common, directed=False)
    reached = np.isin(group, group[np.flatnonzero(np.isfinite(anchors.value))])
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
    # Errors: blocks of cells are drawn again, and targets change by their errors.
    rng = np.random.default_rng(0)
    _, block = np.unique(np.floor(ties.centre[use] / BLOCK), axis=0, return_inverse=True)
    blocks = int(block.max(initial=-1)) + 1
    again = np.empty((trials, equations.design.shape[1]))
    given, stated = equations.anchors.value, equations.anchors.error
    for row in again:
        drawn = np.bincount(rng.integers(0, max(blocks, 1), blocks), minlength=blocks).astype(float)
        # A little of every block stays: without it a source that few blocks tie could be lost.
        part = weight * np.maximum(drawn[block.ravel()], 1e-3) if blocks else weight
        moved = replace(equations.anchors, value=given + stated * rng.standard_normal(len(given)))
        row[:] = replace(equations, anchors=moved).solve(part)
    residual = np.full(len(ties.cell), np.nan)
    residual[use] = rest
    # Brightness of a row beyond its error; a cell's mean takes a part of it away.
    count, excess = np.bincount(cell)[cell], 0.0
    several = count > 1
    if several.any():
        free = np.sqrt(count[several] / (count[several] - 1))
        scatter = MAD_TO_STD * float(np.median(np.abs(rest[several]) * free))
        excess = float(np.sqrt(max(scatter**2 - float(np.median(error)) ** 2, 0.0)))
    number = np.bincount(source, minlength=n)
    errors = np.std(again[:, :n], axis=0, ddof=1) if trials else np.full(n, np.nan)
    if trials and columns.shape[1] and len(cell):
        # Of sources with ties: of the constants and the terms over these.
        square = np.var(equations.design @ np.nan_to_num(again).T, axis=1, ddof=1)
        errors = np.where(number > 0, np.sqrt(np.bincount(source, square, n) / np.maximum(number, 1)), errors)
    return Adjustment(found[:n], errors, again[:, :n], number, residual, excess, found[n:], again[:, n:])


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


HEIGHT_DOUBT, LEAST_HEIGHT = 5.0, 0.05
"""Height differences of two strips are named from so many standard errors, and this [m]."""

LEAST_DRIFT = 4.0
"""Drifts of this many standard deviations are named."""


@frozen
class PairOverlap:
    """What two sources have in common."""

    a: str
    b: str
    cells: int
    ratio: float
    """Light of a over that of b in the same cells, median: what differs before the calibration."""
    after: float
    """The same with their constants: 1 where the adjustment brings them together."""
    spread: float
    """Robust standard deviation of the ratio between cells, relative."""
    height: float
    """Median height of a over b [m]."""
    height_spread: float


def compare_pairs(ties: Ties, adjusted: Adjustment, names: Sequence[str]) -> Iterator[PairOverlap]:
    """Compare each two sources that share enough cells.

    Parameters
    ----------
    ties : Ties
    adjusted : Adjustment
    names : sequence of str
        Of the sources.

    Yields
    ------
    PairOverlap
    """
    order = np.argsort(ties.source, kind="stable")
    rows = {k: order[ties.source[order] == k] for k in range(len(names))}
    for a in range(len(names)):
        for b in range(a):
            _, left, right = np.intersect1d(ties.cell[rows[a]], ties.cell[rows[b]], return_indices=True)
            if len(left) < LEAST_TIES:
                continue
            i, j = rows[a][left], rows[b][right]
            value, height = ties.value[i] - ties.value[j], ties.height[i] - ties.height[j]
            middle = float(np.median(value))
            yield PairOverlap(
                names[a],
                names[b],
                len(i),
                math.exp(middle),
                math.exp(middle + adjusted.value[a] - adjusted.value[b]),
                robust_std(value),
                float(np.median(height)),
                robust_std(height),
            )


def find_doubts(lost: Sequence[str], strips: Sequence[StripConstant], pairs: Sequence[PairOverlap]) -> Iterator[str]:
    """Name sources without a constant, strips that drift, and heights that do not fit.

    Parameters
    ----------
    lost : sequence of str
        Names of the sources without a constant.
    strips : sequence of StripConstant
    pairs : sequence of PairOverlap

    Yields
    ------
    str
        One line each.
    """
    for name in lost:
        yield (
            f"{name}: has no constant: no target lies on it, and fewer than {LEAST_TIES} flat cells tie it to a "
            "strip or channel that has one"
        )
    for row in strips:
        if row.drift_error > 0 and abs(row.drift) > max(LEAST_DRIFT * row.drift_error, 0.01):
            yield (
                f"{row.strip}: its constant is {100 * row.drift:+.2f} +- {100 * row.drift_error:.2f} % off the mean of "
                f"digitizer {row.digitizer}, scanner channel {row.scanner}"
            )
    for pair in pairs:
        error = pair.height_spread / math.sqrt(pair.cells)
        if abs(pair.height) > max(HEIGHT_DOUBT * error, LEAST_HEIGHT):
            yield f"{pair.a} lies {pair.height:+.2f} m over {pair.b}: check boresight, trajectory and heights"
