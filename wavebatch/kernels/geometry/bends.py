"""Where a row of points that was fitted by one line is two lines: the ridge of a shallow roof, a break of slope.

Used by `hough`. A bend must show in the residuals far beyond their noise, and a smooth curve must fit them worse:
a hill stays one line.
"""

from __future__ import annotations

import numpy as np
import scipy  # parts of it load when they are first asked for

LEAST_POINTS, LEAST_BEYOND = 8, 2
"""Smallest number of points, and of those beyond a bend on each side."""

LEAST_BEND = np.radians(2.0)
"""Smallest change of direction [rad]: both sides of a road whose middle is 2 % higher differ by 2.3 degrees."""

LARGEST_CHANCE = 1e-4
"""Largest chance that noise about one line looks like the bend. Roughness of neighbouring points is alike, so that the
test is less strict than it looks.
"""

LEAST_SHARE = 0.5
"""Smallest share of the squared residuals that a bend must explain: a wavy surface is not cut at each wave."""


def find_bend(place: np.ndarray, off: np.ndarray) -> float | None:
    """Where points near a line bend.

    Parameters
    ----------
    place : float (n,)
        Positions along the line.
    off : float (n,)
        Distances across it, in the same unit.

    Returns
    -------
    float or None
        The place of the bend; None where one line, or a smooth curve, does as well.

    Notes
    -----
    Least squares of a + b x + c max(x - t, 0) for every t at a point, against a + b x by an F test, and against
    a + b x + c x^2 (docs/algorithms.md 1.3).
    """
    n = len(place)
    if n < LEAST_POINTS:
        return None
    order = np.argsort(place, kind="stable")
    middle = 0.5 * float(place[order[0]] + place[order[-1]])
    half = 0.5 * float(place[order[-1]] - place[order[0]])
    if half <= 0:
        return None
    x, y = (place[order] - middle) / half, off[order] / half
    centre = x.mean()
    x, y = x - centre, y - y.mean()
    square = float(x @ x)
    y = y - x * (x @ y / square)
    gains, changes = _try_bends(x, y, square)
    at = LEAST_BEYOND + int(np.argmax(gains[LEAST_BEYOND : n - LEAST_BEYOND]))
    whole, gain = float(y @ y), float(gains[at])
    left = max(whole - gain, 1e-12 * n)
    chance = scipy.special.fdtrc(2.0, n - 4.0, gain / 2.0 * (n - 4.0) / left)
    bent = chance < LARGEST_CHANCE and gain >= LEAST_SHARE * whole
    bent &= abs(np.arctan(changes[at])) >= LEAST_BEND and gain > _gain(x * x, x, y, square)
    return middle + half * float(x[at] + centre) if bent else None


def _try_bends(x: np.ndarray, y: np.ndarray, square: float) -> tuple[np.ndarray, np.ndarray]:
    """What a bend at each x takes off the sum of squares of y, and its change of slope; y has no slope and no mean."""
    number, sum_x, sum_xx, sum_y, sum_xy = (
        np.cumsum(values[::-1])[::-1] for values in (np.ones(len(x)), x, x * x, y, x * y)
    )
    total = sum_x - x * number
    along = sum_xx - x * sum_x
    size = sum_xx - 2 * x * sum_x + x * x * number - total**2 / len(x) - along**2 / square
    size = np.maximum(size, 1e-12)
    with_y = sum_xy - x * sum_y
    return with_y**2 / size, with_y / size


def _gain(curve: np.ndarray, x: np.ndarray, y: np.ndarray, square: float) -> float:
    """What a curve takes off the sum of squares of y, which has no slope and no mean."""
    curve = curve - curve.mean()
    curve = curve - x * (x @ curve / square)
    return float((curve @ y) ** 2 / max(curve @ curve, 1e-12))
