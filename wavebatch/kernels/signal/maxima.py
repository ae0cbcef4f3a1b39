"""Quiet levels and maxima of whole waveforms by the compiled library (kernels/c/signal.h).

Used by the stages noise.pooled and detect.maximum.
"""

from __future__ import annotations

import ctypes

import numpy as np

from wavebatch.kernels import library
from wavebatch.kernels.library import Samples, call, place


def quiet_levels(samples: Samples, limit: float, reach: int, recovery: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the samples of each waveform that are far from any signal.

    Parameters
    ----------
    samples : Samples
        Waveforms, with one level each.
    limit : float, count
        A smoothed sample beyond +-limit around the level is signal.
    reach : int, samples
        Samples this near to signal are not quiet.
    recovery : int, samples
        Nor are samples within this after a signal of three times the limit.

    Returns
    -------
    mean : float32 (n,), count
        Above the level; 0 where no sample is quiet.
    number : int32 (n,)
        Quiet samples.

    References
    ----------
    docs/algorithms.md H10.
    """
    samples, n = samples.checked(), len(samples.counts)
    mean, number = np.empty(n, np.float32), np.empty(n, np.int32)
    sizes = ctypes.c_int64(n), ctypes.c_double(limit), ctypes.c_int64(reach), ctypes.c_int64(recovery)
    call("quiet_levels", samples.as_block(), *sizes, mean, number)
    return mean, number


def find_maxima(
    samples: Samples, threshold: float, width: float, broad: float = 0.0, taps: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Local maxima of smoothed waveforms, with starts for a fit.

    Parameters
    ----------
    samples : Samples
        Waveforms with their levels; missing samples count as 0.
    threshold : float
        Least height in the smoothed waveform [noise of one sample].
    width : float, samples
        Width of the system pulse.
    broad : float, samples
        Width of the Gaussian that smooths; 0 for [1 2 1]/4 twice.
    taps : float (k,), optional
        Half of that Gaussian, the centre first.

    Returns
    -------
    waveform : int64 (m,)
    time, amplitude, width : float64 (m,), samples, count, samples
        From a log-parabola through five samples; constant waveforms have no maximum.

    References
    ----------
    Wagner et al. (2007), max-detection; docs/algorithms.md 1.1, 4.1.
    """
    samples, n = samples.checked(), len(samples.counts)
    half = np.ascontiguousarray(np.zeros(1) if taps is None else taps, np.float32)
    detector = library.Detector(threshold, width, broad, place(half, np.float32), len(half) - 1)
    room, done, parts = 2 * n + samples.counts.shape[1], 0, []
    while done < n:
        columns = np.empty(room, np.int64), np.empty(room), np.empty(room), np.empty(room)
        out, found = library.CCandidates(room, *(column.ctypes.data for column in columns)), ctypes.c_int64()
        sizes = ctypes.c_int64(n), detector, ctypes.c_int64(done)
        done = call("find_maxima", samples.as_block(), *sizes, out, ctypes.byref(found))
        parts.append([column[: found.value] for column in columns])
        room *= 2
    waveform, amplitude, time, wide = map(np.concatenate, zip(*parts, strict=True)) if parts else np.empty((4, 0))
    return waveform.astype(np.int64, copy=False), time, amplitude, wide
