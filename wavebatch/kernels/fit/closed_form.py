"""Closed-form Gaussians: a weighted parabola through the logarithms of the samples around a peak (Guo 2011)."""

from __future__ import annotations

import numpy as np

from wavebatch.kernels.fit.cluster import fit_parabola


def fit_closed_form(y: np.ndarray, fraction: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Amplitude, time after the middle sample, width and whether the closed form holds, each (m,).

    y: signal (m, 2 r + 1) with the peak in the middle, 0 where there is no sample; used are the contiguous samples
    from the peak outwards that are at least `fraction` of it. ln y = c0 + c1 x + c2 x^2 with weights y^2;
    s = sqrt(-1 / (2 c2)), t = -c1 / (2 c2), A = exp(c0 - c1^2 / (4 c2)) (ALGORITHMS 4.1). It does not hold where
    c2 >= 0 or the peak lies two samples or more away.
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
