"""The plane of one small surface as rays saw it, with the error of its angle; used for calibration targets.

A plane through points in space (`planes`) takes its direction from the points alone. Points of one scan line then give
any plane through the line, with a small error. Here the distance along the rays is a function of the place across
them: a direction in which the rays do not differ has an unknown slope, and says so.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.core.units import MAD_TO_STD

OUTLYING = 3.5
"""Points further from the plane than this many robust standard deviations do not count."""

LEAST_SCATTER = 1e-3
"""Smallest standard deviation about a plane [m], because coordinates are rounded."""

LINE_ERROR = 0.01
"""Error that the points of a scan line share [m]: two lines at a distance d know a slope to this over d, however many
points they have. One centimetre is the step between neighbouring scan lines of level ground in survey strips."""

_TRIALS, _TRIAL_POINTS = 200, 500
_ROUNDS = 10


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
    for _ in range(_ROUNDS):
        slope, rest, variance = _regress(across[kept], along[kept])
        off = np.abs(along - rest - across @ slope)
        limit = OUTLYING * max(MAD_TO_STD * float(np.median(off[kept])), LEAST_SCATTER)
        same, kept = kept, off <= limit
        if kept.sum() < 3 or np.array_equal(same, kept):
            kept = same
            break
    slope, rest, variance = _regress(across[kept], along[kept])
    scatter = float(np.sqrt(max(np.mean((along - rest - across @ slope)[kept] ** 2), LEAST_SCATTER**2)))
    normal = frame.T @ np.array([-slope[0], -slope[1], 1.0])
    normal /= np.sqrt(normal @ normal)
    return Facet(normal, kept, scatter, *_angle_errors(slope, variance))


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


def _angle_errors(slope: np.ndarray, variance: np.ndarray) -> tuple[float, float]:
    """Standard deviation of the angle [rad], and of its cosine, relative."""
    steep = float(slope @ slope)
    total = float(np.trace(variance))
    # Far from the normal only the slope towards the ray counts, at the normal both count alike.
    weight = np.outer(slope, slope) + 0.5 * min(total, 1.0) * np.eye(2)
    towards = float(np.sum(weight * variance) / np.trace(weight))
    error = np.sqrt(towards) / (1.0 + steep)
    if error > 1.0:
        return np.inf, np.inf
    return float(error), float(np.sqrt(steep) * error + 0.5 * total / (1.0 + steep) ** 2)
