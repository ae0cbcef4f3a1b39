"""Planes through many sets of points: `normals`, the ground, tie cells of a calibration and voxels call them.

A set is a run of rows with the same `group`. Sums run over the rows of a set in their order and over nothing else, so
that a plane does not depend on the other sets. `measure_angles` gives the angle at which rays meet a plane. Two checks
say whether a set is one plane:

`in_two_lines`: points on two lines only, as those of two sweeps of a scanner. A plane goes through any two parallel
lines: on both sides of a ridge it is level, and nothing is left that would show it. Three lines are the least that can
contradict a plane.

`compare_halves`: a ridge, a valley, a step. The plane through both sides of a shallow ridge leaves so little that none
of its points is an outlier, but its angle is that of neither side. So each neighbourhood is cut in two through its
middle, in six directions, and planes through the two halves are compared with the plane through both.

`fit_facet` gives the plane of one small surface as rays saw it, with the error of its angle, for calibration targets. A
plane through points in space takes its direction from the points alone: points of one scan line then give any plane
through the line, with a small error. There the distance along the rays is a function of the place across them: a
direction in which the rays do not differ has an unknown slope, and says so.
"""

from __future__ import annotations

import ctypes

import numpy as np

from wavebatch.core.frozen import NamedTuple
from wavebatch.core.units import MAD_TO_STD
from wavebatch.kernels.library import call

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
    start, xyz = _as_sets(xyz, group, n)
    planes = Planes(np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3)), np.empty(n, np.int64), np.empty(n))
    factors = map(ctypes.c_double, (SMOOTH, TIGHT, OUTLYING * MAD_TO_STD, LEAST_SPREAD))
    rounds = map(ctypes.c_int64, (_TIGHT_ROUNDS, _ROUNDS))
    call("trim_planes", ctypes.c_int64(n), start, xyz, *factors, *rounds, *planes)
    return planes


def _as_sets(xyz: np.ndarray, group: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """First point of each set, and the end of the last one, int64 (n + 1,); points as the library reads them."""
    xyz, group = np.ascontiguousarray(xyz, np.float64), np.asarray(group)
    if len(group) != len(xyz) or (len(group) and not (0 <= group[0] <= group[-1] < n and (np.diff(group) >= 0).all())):
        raise ValueError("points lie in no set, or not in the order of their sets")
    start = np.zeros(n + 1, np.int64)
    np.cumsum(np.bincount(group, minlength=n), out=start[1:])
    return start, xyz


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


DIRECTIONS = 24
"""Directions in which the lines are looked for: they are at most 3.75 degrees off one of them."""

LEAST_VARIETY = 0.1
"""Two lines have a variety of 0, three equal ones 0.5, points without any order 0.8. Ten points at random lie below
this in one case of 300, eight in one of 50."""

LEAST_BREADTH = 0.01
"""Variance across a set over that along it, below which it is one line: a tenth as broad as long. Three lines within
1.5 m that are 10 cm apart are as broad. Through one line, noise makes a plane of any slope."""

_ACROSS = np.array([(np.cos(angle), np.sin(angle)) for angle in np.pi * np.arange(DIRECTIONS) / DIRECTIONS])


def in_two_lines(u: np.ndarray, v: np.ndarray, group: np.ndarray, n: int) -> np.ndarray:
    """Find the sets whose points lie on one line, or on two parallel lines.

    Parameters
    ----------
    u, v : float64 (k,), m
        Places of the points in the plane of their set, near its middle.
    group : int64 (k,)
        Set of each point.
    n : int
        Number of sets.

    Returns
    -------
    bool (n,)

    Notes
    -----
    Of the coordinates across any direction, kurtosis >= skewness^2 + 1, and equal only if they have two values (Pearson
    1916). The difference, their variety, is computed in DIRECTIONS; sums of products give it for all of them.
    """
    u, v, group = map(np.ascontiguousarray, (u, v, group), (np.float64, np.float64, np.int64))
    if not len(u) == len(v) == len(group) or (len(group) and not 0 <= group.min() <= group.max() < n):
        raise ValueError("points lie in no set")
    found, (sets, points, directions) = np.empty(n, np.bool_), map(ctypes.c_int64, (n, len(u), DIRECTIONS))
    limits = ctypes.c_double(LEAST_VARIETY), ctypes.c_double(LEAST_BREADTH)
    call("find_two_lines", sets, points, u, v, group, directions, _ACROSS, *limits, found)
    return found


CUTS = 6
"""Directions in which a neighbourhood is cut: a ridge is at most 15 degrees off one of them."""

LEAST_IN_HALF = 4
"""Smallest number of points of a half: three are always in a plane."""

SURE, DOUBTFUL = 0.05, 0.2
"""Chances below which a neighbourhood counts as two planes, and above which as one. With lower ones, ridges of a dozen
points keep errors that are too small; with higher ones, the errors of single planes grow."""

_CUT_ALONG = _ACROSS[:: DIRECTIONS // CUTS]
_SINGULAR = 1e-6
"""Points of a half whose variances differ by more than this are in line: they have no plane."""


class Halves(NamedTuple):
    """The cut of each neighbourhood whose two planes fit best."""

    chance: np.ndarray
    """Chance that one plane with noise shows two planes that fit so much better, float64 (n,); 1 without a cut."""
    tilts: np.ndarray
    """Slopes of the plane of each half against the plane of all, along its longer and its shorter axis, float64
    (n, 2, 2); 0 without a cut."""


def compare_halves(offset: np.ndarray, point: np.ndarray, planes: Planes) -> Halves:
    """Fit planes to both halves of neighbourhoods, and judge whether they fit better than one.

    Parameters
    ----------
    offset : float64 (k, 3), m
        From the middle of a neighbourhood to its points.
    point : int64 (k,)
        Number of the neighbourhood, ascending.
    planes : Planes
        n planes through the neighbourhoods; points beyond their limits do not count.

    Returns
    -------
    Halves

    Notes
    -----
    An F test of the sums of squares, three parameters against six; the chance is that of the best of six cuts
    (docs/algorithms.md 1.4). A half without a plane (fewer than four points, or in line) makes its cut impossible.
    """
    start, xyz = _as_sets(offset, point, len(planes.kept))
    n, found, tilts = len(planes.kept), np.empty((len(planes.kept), 4)), np.empty((len(planes.kept), 2, 2))
    given = (np.ascontiguousarray(part, np.float64) for part in (planes.axes, planes.centre, planes.limit, _CUT_ALONG))
    limits = ctypes.c_int64(LEAST_IN_HALF), ctypes.c_double(_SINGULAR)
    call("compare_halves", ctypes.c_int64(n), start, xyz, *given, *limits, found, tilts)
    count, squares, whole, both = found.T
    known = np.isfinite(both) & np.isfinite(whole) & (count > 6)
    both, whole = np.where(known, both, 0.0), np.where(known, whole, 0.0)
    left = np.maximum(squares - both, 0.0) + count * LEAST_SPREAD**2
    freedom = np.maximum(count - 6.0, 1.0)
    ratio = np.maximum(both - whole, 0.0) / 3.0 * freedom / np.maximum(left, LEAST_SPREAD**2)
    chance = np.where(known, np.minimum(CUTS * chance_of_ratio(ratio, freedom), 1.0), 1.0)
    return Halves(chance, np.where(known[:, None, None], tilts, 0.0))


def chance_of_ratio(ratio: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Chance that F with 3 and whole `freedom` degrees of freedom exceeds a ratio, float64 (n,).

    By the finite sums of Student's t (Abramowitz and Stegun 26.7.3 and 26.7.4) and what a third degree adds. To import
    scipy.special takes longer than all planes of a survey.
    """
    odd, square, sine = freedom % 2, freedom / (freedom + 3 * ratio), np.sqrt(3 * ratio / (freedom + 3 * ratio))
    term, total = np.where(odd, np.sqrt(square), 1.0), np.zeros(len(ratio))
    for step in range(1, int(freedom.max(initial=0)), 2):
        on = step < freedom
        total[on] += term[on]
        term = np.where(on, term * square * (step + odd) / (step + 1 + odd), term)
    within = sine * (total - freedom * term)
    return np.maximum(1 - np.where(odd, (np.arcsin(sine) + within) * 2 / np.pi, within), 0.0)


def misfit_of_angles(halves: Halves, planes: Planes, ray: np.ndarray) -> np.ndarray:
    """How far angles between rays and planes may be off because the points are two planes.

    Parameters
    ----------
    halves : Halves
    planes : Planes
        n planes.
    ray : float64 (n, 3)
        Unit vectors.

    Returns
    -------
    float64 (n,), rad
        The larger difference to the angles of the two halves; less of it where their chance lies between SURE and
        DOUBTFUL, nothing above.
    """
    facing, short, long = (np.einsum("ni,ni->n", ray, planes.axes[:, :, axis]) for axis in range(3))
    angle = np.arccos(np.minimum(np.abs(facing), 1.0))
    off = np.zeros(len(ray))
    for b, c in (halves.tilts[:, side].T for side in range(2)):
        cosine = (facing - b * long - c * short) / np.sqrt(1.0 + b * b + c * c)
        off = np.maximum(off, np.abs(np.arccos(np.minimum(np.abs(cosine), 1.0)) - angle))
    with np.errstate(divide="ignore"):
        share = (np.log(DOUBTFUL) - np.log(halves.chance)) / np.log(DOUBTFUL / SURE)
    return off * np.sqrt(np.clip(share, 0.0, 1.0))


FACET_OUTLYING = 3.5
"""Points further from the plane than this many robust standard deviations do not count."""

LEAST_SCATTER = 1e-3
"""Smallest standard deviation about a plane [m], because coordinates are rounded."""

LINE_ERROR = 0.01
"""Error that the points of a scan line share [m]: two lines at a distance d know a slope to this over d, however many
points they have. One centimetre is the step between neighbouring scan lines of level ground in survey strips."""

_TRIALS, _TRIAL_POINTS = 200, 500
_FACET_ROUNDS = 10


class Facet(NamedTuple):
    """A plane that rays meet."""

    normal: np.ndarray
    """Unit vector, away from the sensor, float64 (3,)."""
    kept: np.ndarray
    """Points that lie on it, bool (k,)."""
    scatter: float
    """Standard deviation of these along the rays [m]."""
    angle_error: float
    """Standard deviation of the angle between the middle ray and the normal [rad]; infinite where unknown."""
    facing_error: float
    """Relative standard deviation of the cosine of that angle; infinite where unknown."""

    def angles(self, unit: np.ndarray) -> np.ndarray:
        """Angles between rays, unit vectors (m, 3), and the normal, float64 (m,) [rad]."""
        return np.arccos(np.clip(np.abs(unit @ self.normal), 0.0, 1.0))


def fit_facet(xyz: np.ndarray, unit: np.ndarray) -> Facet:
    """Fit the plane that most points lie on, by distance along the rays.

    Parameters
    ----------
    xyz : float64 (k, 3), m
        Where the rays ended; three at least.
    unit : float64 (k, 3)
        Directions of the rays, unit vectors.

    Returns
    -------
    Facet
        With infinite errors where the rays lie in one line.

    Notes
    -----
    Least median of squares over 200 triples of points, then least squares without outliers. The slope along each
    principal direction across the rays, with spread l of k points that scatter by s about the plane, has the variance
    s^2 / (k l^2) + LINE_ERROR^2 / (2 l)^2. The relative error of the cosine is tan(alpha) e + e^2 / 2.

    References
    ----------
    Rousseeuw and Leroy (1987); docs/algorithms.md 5.
    """
    middle = unit.mean(axis=0)
    middle /= np.sqrt(middle @ middle)
    side = np.cross(middle, np.eye(3)[int(np.argmin(np.abs(middle)))])
    side /= np.sqrt(side @ side)
    frame = np.stack([side, np.cross(middle, side), middle])
    across, along = np.split((xyz - np.median(xyz, axis=0)) @ frame.T, [2], axis=1)
    along = along[:, 0]
    kept = _start(across, along)
    for _ in range(_FACET_ROUNDS):
        slope, rest, variance = _regress(across[kept], along[kept])
        off = np.abs(along - rest - across @ slope)
        limit = FACET_OUTLYING * max(MAD_TO_STD * float(np.median(off[kept])), LEAST_SCATTER)
        same, kept = kept, off <= limit
        if kept.sum() < 3 or np.array_equal(same, kept):
            kept = same
            break
    slope, rest, variance = _regress(across[kept], along[kept])
    scatter = float(np.sqrt(max(np.mean((along - rest - across @ slope)[kept] ** 2), LEAST_SCATTER**2)))
    normal = frame.T @ np.array([-slope[0], -slope[1], 1.0])
    normal /= np.sqrt(normal @ normal)
    # Standard deviation of the angle [rad], and of its cosine, relative. Far from the normal only the slope towards the
    # ray counts, at the normal both count alike.
    steep, total = float(slope @ slope), float(np.trace(variance))
    weight = np.outer(slope, slope) + 0.5 * min(total, 1.0) * np.eye(2)
    towards = float(np.sum(weight * variance) / np.trace(weight))
    error = float(np.sqrt(towards) / (1.0 + steep))
    if error > 1.0:
        return Facet(normal, kept, scatter, np.inf, np.inf)
    return Facet(normal, kept, scatter, error, float(np.sqrt(steep) * error + 0.5 * total / (1.0 + steep) ** 2))


def _start(across: np.ndarray, along: np.ndarray) -> np.ndarray:
    """The half of the points that lies nearest to the best plane through three of them, bool (k,)."""
    rng = np.random.default_rng(len(along))
    some = np.arange(len(along)) if len(along) <= _TRIAL_POINTS else rng.choice(len(along), _TRIAL_POINTS, False)
    table = np.column_stack([np.ones(len(along)), across])
    best, kept = np.inf, np.ones(len(along), bool)
    for _ in range(_TRIALS):
        three = rng.choice(some, 3, replace=False)
        plane, *_ = np.linalg.lstsq(table[three], along[three], rcond=1e-3)
        off = np.abs(along[some] - table[some] @ plane)
        middle = float(np.median(off))
        if middle < best:
            best = middle
            kept = np.abs(along - table @ plane) <= max(2.5 * MAD_TO_STD * middle, LEAST_SCATTER)
    return kept


def _regress(across: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Slope (2,), value at the origin, and covariance of the slope (2, 2) of along = rest + across @ slope."""
    centre, mean = across.mean(axis=0), float(along.mean())
    off, height = across - centre, along - mean
    spread, axes = np.linalg.eigh(off.T @ off / len(off))
    spread = np.maximum(spread, 1e-12)
    local = (off @ axes).T @ height / len(off) / spread
    left = height - off @ axes @ local
    noise = max(float(left @ left) / max(len(off) - 3, 1), LEAST_SCATTER**2)
    variance = noise / (len(off) * spread) + LINE_ERROR**2 / (4.0 * spread)
    slope = axes @ local
    return slope, mean - float(centre @ slope), axes @ np.diag(variance) @ axes.T
