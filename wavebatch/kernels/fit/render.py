"""Waveforms from echoes: the sum of the fitted pulses at every sample.

Used by stages that need residuals and by the survey.
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.order import distinct
from wavebatch.kernels.elementary import exp, log1p
from wavebatch.kernels.fit.pulse_shape import NO_SKEW, PulseShape, evaluate_pulse

ROWS = 8192
"""Echoes rendered at a time, so that memory stays small."""

COLUMNS = 512
"""Samples rendered at a time, with the echoes near them only: a waveform of 65,536 samples may have 10,000 echoes.
Fixed, because sums over other echoes are rounded in another way."""

VANISHED = 15.0
"""Widths from the centre at which exp(-z^2/2) is 0 in float32; it is from 14.4 on."""


def render_echoes(
    shape: PulseShape, n: int, s: int, waveform: np.ndarray, time: np.ndarray, amplitude: np.ndarray, width: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """The sum of all pulses of each waveform.

    Parameters
    ----------
    shape : PulseShape
        Model of the pulse.
    n, s : int
        Number of waveforms, and of samples of each.
    waveform : int (m,)
        Row of each echo, ascending.
    time, amplitude, width : float (m,), samples, count, samples
        Parameters of each echo.

    Returns
    -------
    float32 (n, s), count
        Signal without baseline.
    """
    signal = np.zeros((n, s), np.float32)
    x = np.arange(s, dtype=np.float32)
    # Parts end with a waveform, so that the order in which its echoes are added does not depend on the others.
    borders = np.append(distinct(np.searchsorted(waveform, waveform[::ROWS])), len(waveform))
    for begin, end in zip(borders[:-1], borders[1:], strict=True):
        part = slice(begin, end)
        t, w, height = (values[part].astype(np.float32) for values in (time, width, amplitude))
        owner, reach = waveform[part], _reach(shape, w)
        for first in range(0, s, COLUMNS):
            columns = slice(first, first + COLUMNS)
            near: slice | np.ndarray = slice(None)
            if s > COLUMNS:
                near = np.flatnonzero((t > first - reach) & (t < first + COLUMNS + reach))
            row = owner[near]
            if len(row):
                starts = np.flatnonzero(np.r_[True, np.diff(row) != 0])
                pulse = evaluate_pulse(shape, x[columns], t[near][:, None], w[near][:, None])[0] * height[near][:, None]
                signal[:, columns][row[starts]] += np.add.reduceat(pulse, starts, axis=0)
    return signal


def _reach(shape: PulseShape, width: np.ndarray) -> np.ndarray:
    """Distance (m,) from which pulses are exactly 0 in float32; infinite for shapes other than sums of Gaussians."""
    if shape.table is not None or shape.power != 2.0 or abs(shape.kappa) >= NO_SKEW:
        return np.full(len(width), np.inf, np.float32)
    delay = max((abs(delay) for _, delay, _ in shape.components), default=0.0)
    extra = max((extra for *_, extra in shape.components), default=0.0)
    return (delay + VANISHED * np.sqrt(width * width + extra)).astype(np.float32)


SERIES = 1e-3
"""Below this |skew| the logarithm is a series: the closed form divides by the skew."""


def skewed_pulse(x: np.ndarray, t: np.ndarray, s: np.ndarray, skew: np.ndarray) -> np.ndarray:
    """Unit skewed pulses with a skew per echo.

    Parameters
    ----------
    x : float, samples
        Sample positions.
    t, s, skew : float
        Peak [samples], width [samples] and skew of echoes; all broadcast.

    Returns
    -------
    float64
        Of the broadcast shape.

    References
    ----------
    docs/algorithms.md 0.
    """
    z = (x - t) / s
    grown = skew * z
    inside = grown > -0.999999
    small = np.abs(skew) < SERIES
    near = z - 0.5 * skew * z * z + skew * skew * z * z * z / 3.0
    level = np.where(small, near, log1p(np.where(inside, grown, 0.0)) / np.where(small, 1.0, skew))
    return np.where(inside, exp(-0.5 * level * level), 0.0)


def render_skewed(
    n: int, s: int, waveform: np.ndarray, time: np.ndarray, amplitude: np.ndarray, width: np.ndarray, skew: np.ndarray
) -> np.ndarray:
    """The sum of skewed pulses of each waveform.

    Parameters
    ----------
    n, s : int
        Number of waveforms, and of samples of each.
    waveform : int (m,)
        Row of each echo.
    time, amplitude, width, skew : float (m,)
        Peak [samples], amplitude [DN], width [samples] and skew of each echo.

    Returns
    -------
    float32 (n, s), count
        Signal without baseline.
    """
    signal = np.zeros((n, s), np.float32)
    x = np.arange(s, dtype=np.float64)
    columns = [np.asarray(values, np.float64)[:, None] for values in (time, width, skew, amplitude)]
    for begin in range(0, len(waveform), 4096):
        t, w, kappa, height = (values[begin : begin + 4096] for values in columns)
        np.add.at(signal, waveform[begin : begin + 4096], (height * skewed_pulse(x, t, w, kappa)).astype("f4"))
    return signal
