"""Robust planes through many sets of points at once, and the angle at which rays meet them.

Used by `normals` and by the calibration targets. A set is a run of rows with the same `group`. Sums run over the rows
of a set in their order and over nothing else, so that a plane does not depend on the other sets.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.core.units import MAD_TO_STD

OUTLYING = 4.0
"""Points further from the plane than this many robust standard deviations do not count."""

LEAST_SPREAD = 1e-3
"""Smallest median distance or standard deviation about a plane [m], because coordinates are rounded."""

FLAT = 0.04
"""Largest variance across a plane divided by the smaller variance within it; above, points are no surface."""

SMOOTH = 0.0025
"""Above this ratio a set may be more than one surface and is looked at more closely."""

TIGHT = 1.5
"""While a set is not smooth, points further off than this many medians are left out: two surfaces (a ridge), or a
surface with plants, pull a plane through all their points so far that none of these is an outlier.
"""

FOLDED = 1.515
"""Standard deviations of two tilts within which 68.3 % of the angles lie whose true value is 0."""

_TIGHT_ROUNDS = 3
"""Rounds in which sets that are not smooth use only the nearer points."""
_ROUNDS = 8
"""Largest number of rounds."""
_PRODUCTS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


class Planes(NamedTuple):
    """A plane per set of points."""

    axes: np.ndarray
    """Unit vectors as columns: normal, shorter and longer direction within the plane, float64 (n, 3, 3)."""
    spreads: np.ndarray
    """Variance of the points that count along these axes, ascending, float64 (n, 3), m2."""
    centre: np.ndarray
    """Mean of the points that count, float64 (n, 3), m."""
    kept: np.ndarray
    """Points that count, int64 (n,)."""
    limit: np.ndarray
    """Distance from the plane beyond which points do not count, float64 (n,), m."""

    @property
    def normal(self) -> np.ndarray:
        """Unit normals, pointing up or down, float64 (n, 3)."""
        return self.axes[:, :, 0]

    def offset(self) -> np.ndarray:
        """Distance between the plane and the origin of each set's coordinates, float64 (n,), m."""
        return np.abs(_dot(self.centre, self.normal))


def fit_planes(xyz: np.ndarray, group: np.ndarray, n: int) -> Planes:
    """Planes through n sets of points by least squares, without outliers.

    Points off by more than four robust standard deviations are left out, and the plane is fitted again, until nothing
    changes or eight times. In the first three rounds of sets that are not smooth only the nearer points count (see
    TIGHT).

    Parameters
    ----------
    xyz : float64 (k, 3), m
        Relative to a place in their set.
    group : int64 (k,)
        Number of the set, ascending.
    n : int
        Number of sets.

    Returns
    -------
    Planes
        A set without three points that are not in line has an arbitrary plane, as its spreads show.

    References
    ----------
    Rousseeuw and Van Driessen (1999): trimmed least squares with concentration steps.
    """
    count = np.bincount(group, minlength=n)
    x = np.ascontiguousarray(xyz.T)
    whole = _sum_moments(x, group, n)
    kept = np.ones(len(group), bool)
    centre, spreads, axes = _solve(whole)
    limit = np.full(n, np.inf)
    active = np.flatnonzero(count > 0)
    for number in range(_ROUNDS):
        if not len(active):
            break
        rows, local = _rows_of(active, count)
        at = group[rows]
        off = (x[0][rows] - centre[at, 0]) * axes[at, 0, 0]
        off += (x[1][rows] - centre[at, 1]) * axes[at, 1, 0]
        off += (x[2][rows] - centre[at, 2]) * axes[at, 2, 0]
        off = np.abs(off)
        tight = (number < _TIGHT_ROUNDS) & (spreads[active, 0] > SMOOTH * spreads[active, 1])
        factor = np.where(tight, TIGHT, OUTLYING * MAD_TO_STD * _spread_lost(count[active]))
        limit[active] = factor * np.maximum(_medians(off, local, count[active]), LEAST_SPREAD)
        near = off <= limit[at]
        changed = np.bincount(local, near != kept[rows], minlength=len(active)) > 0
        kept[rows] = near
        # Few points are left out: to subtract them costs less than to add up all the others.
        out = np.flatnonzero(changed[local] & ~near)
        left_out = _sum_moments(x[:, rows[out]], local[out], len(active))
        active, moved = active[changed | tight], active[changed]
        if len(moved):
            rest = [total[moved] - part[changed] for total, part in zip(whole, left_out, strict=True)]
            centre[moved], spreads[moved], axes[moved] = _solve(rest)
    left = np.bincount(group, kept, minlength=n).astype(np.int64)
    return Planes(axes, spreads, centre, left, limit)


def is_flat(spreads: np.ndarray) -> np.ndarray:
    """Whether points with variances `spreads` along their axes (n, 3) lie in a plane, bool (n,)."""
    return spreads[:, 0] <= FLAT * spreads[:, 1]


def measure_angles(planes: Planes, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angle between rays and the normals of planes.

    Parameters
    ----------
    planes : Planes
        n planes.
    ray : float64 (n, 3)
        Unit vectors.

    Returns
    -------
    angle : float64 (n,), rad
        0 to pi/2.
    error : float64 (n,), rad
        Standard deviation; infinite where the points are in line.

    Notes
    -----
    Points scatter about a plane by s, so that a tilt along an axis with spread l has the error s / sqrt(k l). Three
    points have no scatter to judge by; LEAST_SPREAD is assumed. An angle is never negative: a true 0 is found as 1.25
    standard deviations of a tilt, so that errors of angles near 0 reach down to 0.
    """
    facing, short, long = (_dot(ray, planes.axes[:, :, axis]) for axis in range(3))
    sine = np.hypot(short, long)
    angle = np.arctan2(sine, np.abs(facing))
    kept = planes.kept.astype(np.float64)
    flat, low, high = (np.ascontiguousarray(planes.spreads[:, axis]) for axis in range(3))
    scatter = np.maximum(flat, 0.0) * kept / np.maximum(kept - 3.0, 1.0) + LEAST_SPREAD**2
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        tilts = [scatter / (kept * np.maximum(spread, 0.0)) for spread in (low, high)]
        # Both tilts matter for a ray along the normal; for a ray far off it only the tilt towards the ray does.
        blur = np.minimum(0.5 * (tilts[0] + tilts[1]), 1.0)
        weights = [part * part + blur for part in (short, long)]
        variance = (weights[0] * tilts[0] + weights[1] * tilts[1]) / (weights[0] + weights[1])
        error = np.sqrt(np.where(np.isnan(variance), np.inf, variance))
        return angle, np.where(angle < FOLDED * error, np.maximum(angle, error), error)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _sum_moments(x: np.ndarray, group: np.ndarray, n: int) -> list[np.ndarray]:
    """Number, sums (three) and sums of products (six) of each set, float64 (n,) each."""
    sums: list[np.ndarray] = [np.bincount(group, minlength=n).astype(np.float64)]
    sums += [np.bincount(group, x[axis], minlength=n) for axis in range(3)]
    return sums + [np.bincount(group, x[a] * x[b], minlength=n) for a, b in _PRODUCTS]


def _solve(moments: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre, spreads and axes of sets from their moments."""
    number = np.maximum(moments[0], 1.0)
    centre = np.stack([total / number for total in moments[1:4]], axis=1)
    covariance = np.empty((len(number), 3, 3))
    for (a, b), total in zip(_PRODUCTS, moments[4:], strict=True):
        covariance[:, a, b] = covariance[:, b, a] = total / number - centre[:, a] * centre[:, b]
    spreads, axes = np.linalg.eigh(covariance)
    return centre, spreads, axes


def _spread_lost(count: np.ndarray) -> np.ndarray:
    """By how much the median distance from a plane fitted to few points is too small (Rousseeuw and Leroy 1987)."""
    return 1.0 + 5.0 / np.maximum(count - 3, 1)


def _rows_of(sets: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the points of some sets (ascending), and to which of these sets each belongs."""
    start = np.cumsum(count) - count
    number = count[sets]
    local = np.repeat(np.arange(len(sets)), number)
    begin = np.cumsum(number) - number
    return np.arange(len(local)) + (start[sets] - begin)[local], local


def _medians(values: np.ndarray, group: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Upper median of each set; every set has a value.

    Rows of a table, filled up with as many values below all others as above: the middle is in one place for all.
    """
    width = int(count.max())
    start = np.cumsum(count) - count
    below = width // 2 - count // 2
    table = np.full((len(count), width), np.inf)
    table[np.arange(width) < below[:, None]] = -np.inf
    table[group, np.arange(len(values)) - start[group] + below[group]] = values
    return np.partition(table, width // 2, axis=1)[:, width // 2]
