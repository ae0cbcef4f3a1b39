"""Rays of discrete returns: which points are one pulse, and where it came from."""

from __future__ import annotations

import numpy as np

from wavebatch.core.units import MAD_TO_STD

OWN = 0.5
"""Pulses whose first and last return lie at least this far apart [m] know their own direction."""
_SURE = 2.0
_ENOUGH = 20
_CLIP = 4.0


def group_pulses(time: np.ndarray, number: np.ndarray) -> np.ndarray:
    """First point of every pulse, i8 (k,): points (n,) of equal time in a row whose return numbers rise."""
    if not len(time):
        return np.empty(0, np.int64)
    new = (time[1:] != time[:-1]) | (number[1:] <= number[:-1])
    return np.concatenate([[0], np.flatnonzero(new) + 1])


def fit_rays(xyz: np.ndarray, starts: np.ndarray, angle: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Unit vectors (k, 3) away from the sensor of the pulses that begin at points `starts` (k,).

    xyz (n, 3) [m] in order of range within a pulse; angle (n,): scan angle [deg]; source (n,): flight line. From the
    first to the last return where they lie OWN apart; else horizontal parts per metre down that are linear in the
    tangent of the scan angle, fitted to the pulses of the same flight line that know better; straight down where fewer
    than 20 do.
    """
    last = np.append(starts[1:], len(xyz)) - 1
    span = xyz[last] - xyz[starts]
    length = np.linalg.norm(span, axis=1)
    rays = np.tile([0.0, 0.0, -1.0], (len(starts), 1))
    tangent = np.tan(np.radians(np.clip(angle[starts], -80, 80)))
    for line in np.unique(source[starts]).tolist():
        rows = np.flatnonzero(source[starts] == line)
        down = -span[rows, 2]
        sure = (length[rows] >= _SURE) & (down > 0.3 * length[rows])
        if np.count_nonzero(sure) >= _ENOUGH:
            slopes = span[rows[sure], :2] / down[sure, None]
            rays[rows, :2] = _fit_slopes(tangent[rows[sure]], slopes, tangent[rows])
    own = length >= OWN
    rays[own] = span[own]
    return rays / np.linalg.norm(rays, axis=1)[:, None]


def _fit_slopes(tangent: np.ndarray, slopes: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Linear fit of slopes (m, 2) by tangent (m,), outliers clipped twice, evaluated at `wanted`."""
    use = np.ones(len(tangent), bool)
    for _ in range(3):
        terms = np.stack([np.ones(len(tangent)), tangent], axis=1)
        factors = np.linalg.lstsq(terms[use], slopes[use], rcond=None)[0]
        off = np.linalg.norm(slopes - terms @ factors, axis=1)
        use = off <= _CLIP * max(MAD_TO_STD * float(np.median(off)), 1e-6)
    return factors[0] + wanted[:, None] * factors[1]
