"""Closed-form Gaussians: a weighted parabola through the logarithms of the samples around a peak (Guo 2011).

Used by the fast stages as the fit, or as the start of one. Cheap, but wrong for echoes that overlap.
"""

from __future__ import annotations

import numpy as np

from wavebatch.kernels.fit.cluster import fit_parabola


def fit_closed_form(y: np.ndarray, fraction: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gaussians through the samples around peaks, without iterations.

    Parameters
    ----------
    y : float (m, 2 r + 1), count
        Signal with the peak in the middle; 0 where there is no sample.
    fraction : float
        Used are the contiguous samples around the peak that are at least this share of it.

    Returns
    -------
    amplitude : float64 (m,), count
    time : float64 (m,), samples
        After the middle sample.
    width : float64 (m,), samples
    holds : bool (m,)
        False where the parabola opens upwards or its peak lies two samples or more away; the values are void there.

    Notes
    -----
    ln y = c0 + c1 x + c2 x^2 with weights y^2; s = sqrt(-1 / (2 c2)), t = -c1 / (2 c2), A = exp(c0 - c1^2 / (4 c2)).

    References
    ----------
    Guo (2011), IEEE Signal Processing Magazine 28(5); docs/algorithms.md 4.1.
    """
    middle = y.shape[1] // 2
    y = y.astype(np.float64)
    high = y >= np.maximum(fraction * y[:, middle : middle + 1], 1e-9)
    used = np.empty_like(high)
    np.logical_and.accumulate(high[:, middle:], axis=1, out=used[:, middle:])
    used[:, : middle + 1] = np.logical_and.accumulate(high[:, middle::-1], axis=1)[:, ::-1]
    safe = np.where(used, y, 1.0)
    weight = np.where(used, y * y, 0.0)
    x = np.arange(-middle, y.shape[1] - middle, dtype=np.float64)
    c0, c1, c2 = fit_parabola(weight, x, np.log(safe), axis=1)
    holds = c2 < 0
    c2 = np.where(holds, c2, -1.0)
    time = -c1 / (2 * c2)
    holds &= np.abs(time) < 2
    amplitude = np.exp(np.clip(c0 - c1 * c1 / (4 * c2), -50, 50))
    return amplitude, time, np.sqrt(-1 / (2 * c2)), holds
