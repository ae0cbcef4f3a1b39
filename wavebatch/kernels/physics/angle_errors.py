"""Angles from the variance that a surface adds to the pulse, with errors that hold for any true angle.

Used by the stage attribute.incidence_angle and by `angle_limits`. The square root makes it hard: near 0 half of the
variances are negative, and where only large ones are seen, these are too large (docs/algorithms.md 1.4).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from wavebatch.kernels.physics.incidence import STEEPEST, angle_of_spread

RADIUS = np.array([
    (-3.0, 0.543), (-2.0, 0.463), (-1.5, 0.446), (-1.0, 0.620), (-0.5, 0.872), (-1e-3, 1.136), (0.0, 0.853),
    (0.1, 0.818), (0.2, 0.795), (0.3, 0.793), (0.4, 0.866), (0.5, 0.932), (0.6, 0.870), (0.7, 0.581), (0.8, 0.368),
    (0.9, 0.432), (1.0, 0.440), (1.1, 0.421), (1.2, 0.389), (1.3, 0.365), (1.4, 0.345), (1.5, 0.315), (1.6, 0.309),
    (1.7, 0.289), (1.8, 0.276), (1.9, 0.261), (2.0, 0.248), (2.3, 0.214), (2.7, 0.185),
]).T  # fmt: skip
"""Radius around sqrt(max(u, 0)) that holds sqrt(mu) for 68.3 % of the draws u of a normal law around mu, any mu >= 0.

First row: u where it is negative, else sqrt(u); second row: the radius. Solved numerically for equal coverage. It must
fall near 0.7: a true 0 lies within the radius for the lower 68.3 % of u and outside for all others.
"""


def angles_of_variance(
    variance: np.ndarray, variance_err: np.ndarray, distance: np.ndarray, divergence: float
) -> tuple[np.ndarray, np.ndarray]:
    """Angles from the variance that a surface adds to the pulse.

    Parameters
    ----------
    variance, variance_err : float (m,), ns2
        Added variance and its standard deviation.
    distance : float (m,), m
        Sensor to echo.
    divergence : float, rad
        Full angle between the 1/e^2 points.

    Returns
    -------
    angle, error : float64 (m,), rad
        0 where the variance is not positive; NaN above 80 degrees and where an input is not known.

    Notes
    -----
    For steep planes the error is sigma_s s c^2 / (w^2 tan sec^2), by propagation through the square root. Near 0 the
    root is not linear and half of the variances are negative: there the error is a radius from RADIUS, such that 68.3 %
    of the angles lie within it for any true angle. Source: docs/algorithms.md 1.4.
    """
    known = np.isfinite(variance) & np.isfinite(variance_err) & (variance_err > 0) & (np.asarray(distance) > 0)
    variance, variance_err = np.where(known, variance, np.nan), np.where(known, variance_err, np.nan)
    spread = np.sqrt(np.maximum(variance, 0.0))
    radius = _radius(variance, variance_err, spread)
    high, middle, low = (angle_of_spread(spread + step, distance, divergence) for step in (radius, 0.0, -radius))
    error = 0.5 * (high - low)
    steep = middle > STEEPEST
    return np.where(steep, np.nan, middle), np.where(steep, np.nan, error)


def angles_above(
    variance: np.ndarray, variance_err: np.ndarray, distance: np.ndarray, divergence: float, threshold: float
) -> tuple[np.ndarray, np.ndarray]:
    """Angles of echoes that are given only because their variance exceeds so many errors.

    Parameters
    ----------
    variance, variance_err, distance, divergence
        As for `angles_of_variance`; all variances exceed the threshold.
    threshold : float
        In errors of the variance.

    Returns
    -------
    angle, error : float64 (m,), rad
        Of the true variance for which half of all echoes above the threshold lie above this one, and half the distance
        of those for which 16 and 84 % do.

    Notes
    -----
    Near the threshold, only echoes that noise has widened are seen, so their plain angles are too large: by 1.75 errors
    if a tenth of the echoes is seen. The angles and errors given here are right for the echoes that are seen.
    """
    bounds = []
    with np.errstate(invalid="ignore", divide="ignore"):
        over = variance / variance_err - threshold
        for true in _conditional_table().T[1:]:
            place = np.interp(over, _conditional_table()[:, 0], true)
            beyond = over > _FARTHEST
            true_variance = variance_err * (threshold + np.where(beyond, over + true[-1] - _FARTHEST, place))
            bounds.append(angle_of_spread(np.sqrt(np.maximum(true_variance, 0.0)), distance, divergence))
    low, middle, high = bounds
    # Just above the threshold all three may be 0: then nothing is known but that the surface may face the sensor.
    facing = angle_of_spread(_radius(np.zeros(1), variance_err, np.zeros(1)), distance, divergence)
    error = np.where(middle > 0, 0.5 * (high - low), np.maximum(high, facing))
    steep = middle > STEEPEST
    return np.where(steep, np.nan, middle), np.where(steep, np.nan, error)


_FARTHEST = 8.0
"""Errors above a threshold beyond which it no longer matters."""


@lru_cache(maxsize=1)
def _conditional_table() -> np.ndarray:
    """Rows: a measurement above a threshold at 0, then the means of the normal law (of width 1) for which 16, 50 and
    84 % of the measurements that are above the threshold lie above it."""
    import scipy.special  # here, because most runs need none of it

    over = np.r_[np.geomspace(1e-3, 0.1, 60), np.linspace(0.1, _FARTHEST, 400)[1:]]
    columns = [over]
    for share in (0.1587, 0.5, 0.8413):
        low, high = np.full(len(over), -4000.0), np.full(len(over), _FARTHEST + 8.0)
        for _ in range(60):
            middle = 0.5 * (low + high)
            above = np.exp(scipy.special.log_ndtr(middle - over) - scipy.special.log_ndtr(middle))
            low, high = np.where(above < share, middle, low), np.where(above < share, high, middle)
        columns.append(0.5 * (low + high))
    return np.stack(columns, axis=1)


def _radius(variance: np.ndarray, variance_err: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Error of the spread [ns] from the variance [ns2], its error, and its root."""
    with np.errstate(divide="ignore", invalid="ignore"):
        below = variance / variance_err
        place = np.where(variance < 0, below, np.sqrt(np.maximum(below, 0.0)))
        near = np.interp(place, *RADIUS) * np.sqrt(variance_err)
        return np.where(place > RADIUS[0][-1], variance_err / (2.0 * spread), near)
