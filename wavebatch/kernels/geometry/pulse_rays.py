"""Rays of discrete returns: which points are one pulse, and where it came from.

Used by the simulator, which makes waveforms from returns of files without waveforms.
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.units import MAD_TO_STD

OWN = 0.5
"""Pulses whose first and last return are at least this far apart [m] have their own direction."""
_SURE = 2.0
"""Distance of first and last return [m] from which a direction is good enough to fit those of other pulses."""
_ENOUGH = 20
"""Smallest number of such pulses in a flight line."""
_CLIP = 4.0
"""Residuals above this many robust standard deviations are outliers."""


def group_pulses(time: np.ndarray, number: np.ndarray) -> np.ndarray:
    """First point of every pulse: a pulse is a row of points of equal time whose return numbers rise.

    Parameters
    ----------
    time, number : float (n,), int (n,)
        GPS time and return number, in the order of the file.

    Returns
    -------
    int64 (k,)
    """
    new = (time[1:] != time[:-1]) | (number[1:] <= number[:-1])
    return np.flatnonzero(np.append(True, new)[: len(time)])


def fit_rays(xyz: np.ndarray, starts: np.ndarray, angle: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Direction of each pulse, away from the sensor.

    From the first to the last return where these are OWN apart. For other pulses a direction that is linear in the
    tangent of the scan angle, fitted to the pulses of the same flight line with known directions; straight down where
    fewer than 20 are.

    Parameters
    ----------
    xyz : float64 (n, 3), m
        In order of range within a pulse.
    starts : int64 (k,)
        First point of each pulse.
    angle : float (n,), deg
        Scan angle.
    source : int (n,)
        Flight line.

    Returns
    -------
    float64 (k, 3)
        Unit vectors.
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
