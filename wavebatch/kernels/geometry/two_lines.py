"""Whether points lie on two lines only, as those of two sweeps of a scanner do.

Used by `normals` and by the choice of its radius. A plane goes through any two parallel lines: on both sides of a ridge
it is level, and nothing is left that would show it. Three lines are the least that can contradict a plane.
"""

from __future__ import annotations

import numpy as np

DIRECTIONS = 24
"""Directions in which the lines are looked for: they are at most 3.75 degrees off one of them."""

LEAST_VARIETY = 0.1
"""Two lines have a variety of 0, three equal ones 0.5, points without any order 0.8. Ten points at random lie below
this in one case of 300, eight in one of 50."""

_POWERS = [(p, q) for order in (1, 2, 3, 4) for p in range(order, -1, -1) for q in [order - p]]


def in_two_lines(u: np.ndarray, v: np.ndarray, group: np.ndarray, n: int) -> np.ndarray:
    """Find the sets whose points lie on two parallel lines.

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
    number = np.maximum(np.bincount(group, minlength=n), 1).astype(np.float64)
    u = u - (np.bincount(group, u, minlength=n) / number)[group]
    v = v - (np.bincount(group, v, minlength=n) / number)[group]
    powers = {1: (u, v), 2: (u * u, v * v)}
    powers[3], powers[4] = (u * powers[2][0], v * powers[2][1]), (powers[2][0] ** 2, powers[2][1] ** 2)
    moments = {}
    for p, q in _POWERS[2:]:
        product = powers[p][0] if p else powers[q][1]
        if p and q:
            product = product * powers[q][1]
        moments[p, q] = np.bincount(group, product, minlength=n) / number
    least = np.full(n, np.inf)
    for angle in np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
        a, b = np.cos(angle), np.sin(angle)
        second = a * a * moments[2, 0] + 2 * a * b * moments[1, 1] + b * b * moments[0, 2]
        third = a**3 * moments[3, 0] + b**3 * moments[0, 3]
        third += 3 * a * b * (a * moments[2, 1] + b * moments[1, 2])
        fourth = a**4 * moments[4, 0] + b**4 * moments[0, 4] + 6 * a * a * b * b * moments[2, 2]
        fourth += 4 * a * b * (a * a * moments[3, 1] + b * b * moments[1, 3])
        with np.errstate(divide="ignore", invalid="ignore"):
            variety = fourth / second**2 - third**2 / second**3 - 1.0
        least = np.fmin(least, variety)
    return least < LEAST_VARIETY
