"""Waveforms from echoes: the sum of the fitted pulses at every sample.

Used by stages that need residuals and by the survey.
"""

from __future__ import annotations

import numpy as np

from wavebatch.kernels.fit.pulse_shape import PulseShape, evaluate_pulse

ROWS = 8192
"""Echoes rendered at a time, so that memory stays small."""


def render_echoes(
    shape: PulseShape, n: int, s: int, waveform: np.ndarray, time: np.ndarray, amplitude: np.ndarray, width: np.ndarray
) -> np.ndarray:
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
    borders = np.append(np.unique(np.searchsorted(waveform, waveform[::ROWS])), len(waveform))
    for begin, end in zip(borders[:-1], borders[1:], strict=True):
        part = slice(begin, end)
        t, w = (values[part].astype(np.float32)[:, None] for values in (time, width))
        pulse = evaluate_pulse(shape, x, t, w)[0] * amplitude[part].astype(np.float32)[:, None]
        owner = waveform[part]
        starts = np.flatnonzero(np.r_[True, np.diff(owner) != 0]) if len(owner) else owner
        signal[owner[starts]] += np.add.reduceat(pulse, starts, axis=0)
    return signal
