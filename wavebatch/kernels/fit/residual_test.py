"""Residual test: which fits leave more in the residual than noise explains (docs/algorithms.md 4.2).

Used by `next_echo` to decide which clusters grow, and by the attribute pulse_deviation. With noise alone the moments
are N(0, 1); the default limits let about 1 of 100 right fits through to the slower trials.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from wavebatch.kernels.fit.least_squares import Windows
from wavebatch.kernels.fit.pulse_shape import evaluate_unit
from wavebatch.kernels.signal.signal import SMOOTH_GAIN

HERMITE_REACH = 5.0
"""Half-widths over which the Gauss-Hermite moments run: beyond, the pulse is zero."""


def hermite_moments(windows: Windows, parameters: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Hermite moments h3 and h4 of the residual around each echo: independent N(0, 1) if the fit is right.

    Parameters
    ----------
    windows : Windows
        m problems of length L.
    parameters : float64 (m, 3, k)
        Of the fit.
    rows : float32 (m, 3 k + 1, L)
        `evaluate_model` at the parameters.

    Returns
    -------
    h3, h4 : float (m, k)

    Notes
    -----
    The next two directions after the three that a fit removes: (8 z^3 - 12 z) e and (16 z^4 - 48 z^2 + 12) e
    (docs/algorithms.md 4.2).
    """
    k = parameters.shape[2]
    _, time, width = parameters.astype(np.float32).transpose(1, 0, 2)[..., None]
    z = windows.x[:, None, :] - time
    z *= 1 / width
    np.clip(z, -HERMITE_REACH, HERMITE_REACH, out=z)
    p3, p4 = _hermite(z, rows[:, :k], rows[:, k : 2 * k], rows[:, 2 * k : 3 * k])
    residual, std = rows[:, -1], windows.std[:, None]
    return _project(p3, residual) / std, _project(p4, residual) / std


def _hermite(
    z: np.ndarray, pulse: np.ndarray, by_time: np.ndarray, by_width: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The two directions, from a pulse e, e z and e z^2."""
    p3 = by_width * z
    p4 = p3 * z
    p3 *= np.float32(8)
    p3 -= np.float32(12) * by_time
    p4 *= np.float32(16)
    p4 -= np.float32(48) * by_width
    p4 += np.float32(12) * pulse
    return p3, p4


def residual_moments(
    read: Callable[[slice | np.ndarray, np.ndarray], np.ndarray],
    s: int,
    time: np.ndarray,
    width: np.ndarray,
    std: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Hermite moments of the residual within five widths of each echo, for fits that keep no rows.

    Parameters
    ----------
    read : callable
        read(rows, samples) gives residuals, float32 (k, L), of echoes `rows` at samples int32 (k, L) in 0 .. s - 1.
    s : int
        Samples per waveform.
    time, width : float (m,), samples
        Of the echoes.
    std : float (m,), count
        Noise of one sample.

    Returns
    -------
    h3, h4 : float64 (m,)
    """
    h3, h4 = np.zeros(len(time)), np.zeros(len(time))
    reach = np.minimum(np.ceil(HERMITE_REACH * width), s).astype(np.int32)
    for size in np.unique(reach):
        rows = np.flatnonzero(reach == size)
        for begin in range(0, len(rows), 4096):
            part = rows[begin : begin + 4096]
            middle = np.rint(time[part])
            at = middle.astype(np.int32)[:, None] + np.arange(-size, size + 1, dtype=np.int32)
            inside = (at >= 0) & (at < s)
            cut = not inside.all()
            values = read(part, np.clip(at, 0, s - 1) if cut else at)
            # Centres are subtracted in double precision; float32 is then enough for the small rest.
            z = np.arange(-size, size + 1, dtype=np.float32) - (time[part] - middle).astype(np.float32)[:, None]
            z *= (1 / width[part]).astype(np.float32)[:, None]
            pulse, by_time, by_width = evaluate_unit(z)
            if cut:
                values = np.where(inside, values, np.float32(0))
                pulse, by_time, by_width = (column * inside for column in (pulse, by_time, by_width))
            p3, p4 = _hermite(z, pulse, by_time, by_width)
            h3[part] = _project(p3[:, None], values)[:, 0] / std[part]
            h4[part] = _project(p4[:, None], values)[:, 0] / std[part]
    return h3, h4


def _project(direction: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Component of the residual (m, L) along each direction (m, k, L), made unit length."""
    norm = np.einsum("mkl,mkl->mk", direction, direction)
    return np.einsum("mkl,ml->mk", direction, residual) / np.sqrt(np.maximum(norm, 1e-12))


def find_misfits(
    windows: Windows, parameters: np.ndarray, rows: np.ndarray, residual_limit: float, hermite_limit: float
) -> np.ndarray:
    """Fits whose residual is more than noise.

    Parameters
    ----------
    windows : Windows
        m problems of length L.
    parameters, rows
        As for `hermite_moments`.
    residual_limit : float
        Limit of the smoothed residual, in its noise standard deviations.
    hermite_limit : float
        Limit of h3^2 + h4^2 of any echo.

    Returns
    -------
    bool (m,)
    """
    residual = rows[:, -1]
    smoothed = residual[:, :-2] + residual[:, 2:]
    smoothed += residual[:, 1:-1]
    smoothed += residual[:, 1:-1]
    highest = 0.25 * smoothed.max(axis=1, initial=0)
    h3, h4 = hermite_moments(windows, parameters, rows)
    shape = (h3 * h3 + h4 * h4).max(axis=1)
    return (highest > residual_limit * SMOOTH_GAIN * windows.std) | (shape > hermite_limit)
