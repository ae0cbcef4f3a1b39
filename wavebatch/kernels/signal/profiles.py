"""Profiles along rays: what of a deconvolved waveform is signal, and where it lies against known returns."""

from __future__ import annotations

import numpy as np

from wavebatch.kernels.signal.deconvolve import convolve_pulse
from wavebatch.kernels.signal.signal import sum_samples

ROUND = 8
"""Windows are as long as a multiple of this, so that many waveforms share a length."""


def window_signal(support: np.ndarray, margin: int) -> tuple[np.ndarray, np.ndarray]:
    """First sample and length (n,) of the part of each waveform that holds support (s, n), `margin` on both sides.

    Lengths are multiples of ROUND, or s; 0 where a waveform has no support.
    """
    s = len(support)
    any_ = support.any(axis=0)
    low = np.maximum(support.argmax(axis=0) - margin, 0)
    high = np.minimum(s - support[::-1].argmax(axis=0) + margin, s)
    length = np.minimum(-(-(high - low) // ROUND) * ROUND, s)
    return np.minimum(low, s - length), np.where(any_, length, 0)


def fit_height(profile: np.ndarray, signal: np.ndarray, taps: np.ndarray, support: np.ndarray) -> np.ndarray:
    """Profiles (n, s) times the number that gives their sum of pulses the energy of the signal (s, n) on its support.

    What the deconvolution and the choice of its samples add to or take from the energy is made good.
    """
    model = convolve_pulse(np.ascontiguousarray(profile.T, np.float32), taps)
    mask = np.ascontiguousarray(support.T)
    made, there = (sum_samples(np.where(mask, values, np.float32(0))) for values in (model, signal))
    height = np.where(made > 0, np.maximum(there, 0) / np.where(made > 0, made, np.float32(1)), 0)
    return profile * height[:, None].astype(np.float64)


def keep_signal(
    profile: np.ndarray, support: np.ndarray, least: np.ndarray, floor: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The part of deconvolved waveforms (n, s) that is signal, float64, never negative; and which have any, bool (n,).

    support (n, s): samples of the waveform above its noise. least (n,): a run of supported samples whose sum is smaller
    is noise. floor (n,): smaller samples of a run count as zero, and the others are scaled so that the run's sum, with
    its negative samples, stays what it was.
    """
    n, s = profile.shape
    place = np.flatnonzero(support)
    row = place // s
    value = profile.reshape(-1)[place].astype(np.float64)
    starts = np.append(True, (np.diff(place) > 1) | (np.diff(row) > 0))[: len(place)]
    run = np.cumsum(starts) - 1
    number, owner = int(starts.sum()), row[starts]
    high = np.where(value > floor[row], value, 0.0)
    # Sums sample after sample: the same whatever else is in the block.
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
    """How far profiles (n, s) lie behind their known returns [samples], and where that is known, bool (n,).

    row, sample: waveform and place of every return (m,), sorted by row. Per waveform the mean, weighted by the signal,
    of the centres of gravity within `reach` samples of each return; looked for again where the first look found them.
    """
    n, s = profile.shape
    offset, known = np.zeros(n), np.zeros(n, bool)
    lag = np.arange(-reach, reach + 1)
    for _ in range(2):
        middle = np.rint(sample + offset[row])
        at = np.clip(middle, -reach, s + reach).astype(np.int64)[:, None] + lag
        near = np.where((at >= 0) & (at < s), profile[row[:, None], np.clip(at, 0, s - 1)], 0.0)
        weight, first = np.zeros(len(row)), np.zeros(len(row))
        for column in range(len(lag)):
            weight += near[:, column]
            first += near[:, column] * (at[:, column] - sample)
        total = np.bincount(row, weight, minlength=n)
        known = total > 0
        offset = np.where(known, np.bincount(row, first, minlength=n) / np.where(known, total, 1.0), 0.0)
    return offset, known
