"""Profiles along rays: which part of a deconvolved waveform is signal, and how it lies against known returns.

Used by the voxel tool.
"""

from __future__ import annotations

import numpy as np

from wavebatch.kernels.signal.deconvolve import convolve_pulse
from wavebatch.kernels.signal.signal import sum_samples

ROUND = 8
"""Lengths of windows are multiples of this, so that many waveforms share one length."""


def window_signal(support: np.ndarray, margin: int) -> tuple[np.ndarray, np.ndarray]:
    """The part of each waveform that holds its signal.

    Parameters
    ----------
    support : bool (s, n)
        Samples with signal.
    margin : int, samples
        Added on both sides.

    Returns
    -------
    first, length : int64 (n,)
        Lengths are multiples of ROUND, or s; 0 where a waveform has no signal.
    """
    s = len(support)
    any_ = support.any(axis=0)
    low = np.maximum(support.argmax(axis=0) - margin, 0)
    high = np.minimum(s - support[::-1].argmax(axis=0) + margin, s)
    length = np.minimum(-(-(high - low) // ROUND) * ROUND, s)
    return np.minimum(low, s - length), np.where(any_, length, 0)


def fit_height(profile: np.ndarray, signal: np.ndarray, taps: np.ndarray, support: np.ndarray) -> np.ndarray:
    """Profiles scaled so that their sum of pulses has the energy of the signal.

    It corrects the energy that deconvolution, and the choice of its samples, add or remove.

    Parameters
    ----------
    profile : float64 (n, s)
        Deconvolved waveforms.
    signal : float32 (s, n), count
        Waveforms without baseline.
    taps : float (k,)
        Pulse.
    support : bool (n, s)
        Samples over which energies are compared.

    Returns
    -------
    float64 (n, s)
    """
    model = convolve_pulse(np.ascontiguousarray(profile.T, np.float32), taps)
    mask = np.ascontiguousarray(support.T)
    made, there = (sum_samples(np.where(mask, values, np.float32(0))) for values in (model, signal))
    height = np.where(made > 0, np.maximum(there, 0) / np.where(made > 0, made, np.float32(1)), 0)
    return profile * height[:, None].astype(np.float64)


def keep_signal(
    profile: np.ndarray, support: np.ndarray, least: np.ndarray, floor: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The part of deconvolved waveforms that is signal.

    Parameters
    ----------
    profile : float (n, s)
        Deconvolved waveforms.
    support : bool (n, s)
        Samples of the waveform above its noise.
    least : float (n,)
        A run of supported samples with a smaller sum is noise.
    floor : float (n,)
        Smaller samples of a run become zero, and the others are scaled so that the sum of the run, with its negative
        samples, does not change.

    Returns
    -------
    signal : float64 (n, s)
        Never negative.
    seen : bool (n,)
        Which waveforms have signal.
    """
    n, s = profile.shape
    place = np.flatnonzero(support)
    row = place // s
    value = profile.reshape(-1)[place].astype(np.float64)
    starts = np.append(True, (np.diff(place) > 1) | (np.diff(row) > 0))[: len(place)]
    run = np.cumsum(starts) - 1
    number, owner = int(starts.sum()), row[starts]
    high = np.where(value > floor[row], value, 0.0)
    # bincount adds sample after sample, so that sums do not depend on the rest of the block.
    whole, kept = (np.bincount(run, part, minlength=number) for part in (value, high))
    good = (whole >= least[owner]) & (kept > 0)
    scale = np.where(good, whole / np.where(kept > 0, kept, 1.0), 0.0)
    signal = np.zeros(n * s)
    signal[place] = high * scale[run]
    seen = np.zeros(n, bool)
    seen[owner[good]] = True
    return signal.reshape(n, s), seen


def measure_offsets(
    profile: np.ndarray, row: np.ndarray, sample: np.ndarray, reach: int
) -> tuple[np.ndarray, np.ndarray]:
    """How far profiles lie after their known returns.

    Per waveform the mean, weighted by the signal, of the centres of gravity near each return; searched again around the
    places found first.

    Parameters
    ----------
    profile : float64 (n, s)
        Signal.
    row : int (m,)
        Waveform of each return, ascending.
    sample : float (m,), samples
        Place of each return.
    reach : int, samples
        How far around a return to look.

    Returns
    -------
    offset : float64 (n,), samples
    known : bool (n,)
        False where there is no signal near the returns; the offset is 0 there.
    """
    n, s = profile.shape
    offset, known = np.zeros(n), np.zeros(n, bool)
    lag = np.arange(-reach, reach + 1)
    for _ in range(2):
        middle = np.rint(sample + offset[row])
        at = np.clip(middle, -reach - 1, s + reach).astype(np.int64)[:, None] + lag
        near = np.where((at >= 0) & (at < s), profile[row[:, None], np.clip(at, 0, s - 1)], 0.0)
        weight, first = np.zeros(len(row)), np.zeros(len(row))
        for column in range(len(lag)):
            weight += near[:, column]
            first += near[:, column] * (at[:, column] - sample)
        total = np.bincount(row, weight, minlength=n)
        known = total > 0
        offset = np.where(known, np.bincount(row, first, minlength=n) / np.where(known, total, 1.0), 0.0)
    return offset, known
