"""Gauss-Hermite moments of residuals: how far an echo deviates from the pulse (docs/algorithms.md 4.2).

Used by the attribute pulse_deviation. The fit computes its own in kernels/c/next_echo.h.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from wavebatch.kernels.fit.pulse_shape import evaluate_unit

HERMITE_REACH = 5.0
"""Half-widths over which the Gauss-Hermite moments run: beyond, the pulse is zero."""


def _hermite(
    z: np.ndarray, pulse: np.ndarray, by_time: np.ndarray, by_width: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The two directions (8 z^3 - 12 z) e and (16 z^4 - 48 z^2 + 12) e, from a pulse e, e z and e z^2."""
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
    """Gauss-Hermite moments of the residual within five widths of each echo: independent N(0, 1) if the fit is right.

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
