"""Tie cells: small flat places that several strips or channels saw with single echoes, and what each saw there.

`calibrate_flight` collects the echoes of every strip, and `measure_ties` compares them cell by cell. `wavebatch compare
--overlap` does the same with clouds. A source is one channel of one strip, or one cloud.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np

from wavebatch.core.frozen import frozen
from wavebatch.core.order import group_medians
from wavebatch.core.system import angle_across
from wavebatch.core.units import MEDIAN_ERROR
from wavebatch.kernels.geometry.planes import fit_planes

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


def measure_ties(
    rows: np.ndarray, size: float, slope: float | None = None, rights: np.ndarray | None = None
) -> Ties:
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
    _, first, cell = np.unique(index, axis=0, return_index=True, return_inverse=True)
    cell = cell.ravel()
    rows, cell, pair = _keep_shared(rows, cell)
    if not len(rows):
        empty = np.empty(0)
        return Ties(
            empty.astype(int), empty.astype(int), empty, empty, empty, empty, np.empty((0, 2)), size, np.empty(0, VIEW)
        )
    _, cell = np.unique(cell, return_inverse=True)
    off, facing, tilt, flat = _fit_cells(rows, cell, np.unique(pair, return_inverse=True)[1], slope)
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
    view = _describe_view(rows, facing, at + number // 2, rights)
    return Ties(cells, rows["source"][at], middle, error, height, tilt[at], centre.astype(np.float64), size, view)


def _describe_view(rows: np.ndarray, facing: np.ndarray, at: np.ndarray, rights: np.ndarray | None) -> np.ndarray:
    """How the rows `at` were seen, array of VIEW."""
    view = np.empty(len(at), VIEW)
    view["angle"] = np.nan if rights is None else angle_across(rows["ray"][at], rights[rows["source"][at]])
    view["incidence"] = np.arccos(np.clip(facing[at], 0.0, 1.0))
    view["distance"], view["time"] = rows["distance"][at], rows["time"][at]
    return view


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


def _fit_cells(
    rows: np.ndarray, cell: np.ndarray, pair: np.ndarray, slope: float | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Height over the plane of its cell [m], cosine of the incidence, slope [rad], and whether to use it, of each row.

    The plane goes through the echoes of every source less their mean: strips that lie over each other by a step have
    the same slope, and the step shows in the heights.
    """
    xyz = rows["xyz"].astype(np.float64)
    local, n = xyz - _means(xyz, pair)[pair], int(cell[-1]) + 1
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
    height = np.einsum("ij,ij->i", xyz - _means(xyz, cell)[cell], normal[cell]) / np.maximum(normal[cell, 2], 0.1)
    return height, facing, tilt[cell], flat[cell] & on & (facing > np.cos(STEEPEST))


def _means(xyz: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Mean of the rows of each group, f8 (groups, 3)."""
    count = np.bincount(group)
    return np.stack([np.bincount(group, xyz[:, axis]) / count for axis in range(3)], axis=1)
