"""Deconvolution of many waveforms with one pulse: Wiener, Richardson-Lucy, Gold (docs/algorithms.md 2.5).

Used by detect/transformed.py and by the voxel tool. Arrays are (s, n); a pulse is given by its taps (k,), k
odd, of any height, centred on its middle tap. The sum of the result around an echo is its amplitude in units of the
pulse's height. Columns do not influence each other, bit for bit. For voxels: which part of the result is signal, and
how it lies against known returns.
"""

from __future__ import annotations

import numpy as np

from wavebatch.kernels.signal.filters import filter_symmetric
from wavebatch.kernels.signal.signal import sum_samples

FLOOR = np.float32(1e-6)
"""Smallest value of a model that data are divided by, in units of its background."""


def convolve_pulse(signal: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Each sample replaced by the pulse of its height, summed; zero outside.

    Parameters
    ----------
    signal : float32 or float64 (s, n), count
        Waveforms.
    taps : float (k,)
        Pulse, k odd.

    Returns
    -------
    float (s, n)
        Of the dtype of the signal.
    """
    half = len(taps) // 2
    if signal.dtype == np.float32 and np.array_equal(taps, taps[::-1]):
        return filter_symmetric(signal, taps[half:])
    s = len(signal)
    total = signal.dtype.type(taps[half]) * signal
    for i, tap in enumerate(taps.tolist()):
        lag = i - half
        if tap and lag > 0 and lag < s:
            total[lag:] += signal.dtype.type(tap) * signal[:-lag]
        elif tap and lag < 0 and -lag < s:
            total[:lag] += signal.dtype.type(tap) * signal[-lag:]
    return total


def correlate_pulse(signal: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """The transpose of `convolve_pulse`."""
    return convolve_pulse(signal, taps[::-1])


def wiener_taps(taps: np.ndarray, noise_to_signal: float, reach: int) -> np.ndarray:
    """The Wiener filter of a pulse, as taps for `convolve_pulse`.

    Parameters
    ----------
    taps : float (k,)
        Pulse.
    noise_to_signal : float
        Power of the noise over that of the wanted signal, per sample.
    reach : int, samples
        Where the filter is cut off on both sides.

    Returns
    -------
    float64 (2 reach + 1,)
    """
    length = 8 * (reach + len(taps))
    pulse = np.zeros(length)
    pulse[: len(taps)] = taps
    spectrum = np.fft.rfft(np.roll(pulse, -(len(taps) // 2)))
    inverse = np.fft.irfft(np.conj(spectrum) / (np.abs(spectrum) ** 2 + noise_to_signal), length)
    return np.roll(inverse, reach)[: 2 * reach + 1]


def deconvolve_wiener(signal: np.ndarray, taps: np.ndarray, noise_to_signal: float) -> np.ndarray:
    """Signal deconvolved by the linear filter of least mean square error; it may be negative.

    Parameters
    ----------
    signal : float (s, n), count
        Waveforms without baseline.
    taps : float (k,)
        Pulse.
    noise_to_signal : float
        Power of the noise over that of the wanted signal, per sample.

    Returns
    -------
    float (s, n)
    """
    reach = 4 * len(taps)
    inverse = wiener_taps(taps, noise_to_signal, reach)
    if signal.dtype == np.float32 and np.array_equal(taps, taps[::-1]):
        inverse = 0.5 * (inverse + inverse[::-1])
    return convolve_pulse(signal, inverse)


def deconvolve_richardson_lucy(
    signal: np.ndarray, taps: np.ndarray, background: np.ndarray, iterations: int
) -> np.ndarray:
    """Signal deconvolved by expectation maximisation for Poisson counts; never negative.

    Each step is extrapolated from the two before it, which is worth about five times the iterations.

    Parameters
    ----------
    signal : float (s, n), count
        Waveforms without baseline.
    taps : float (k,)
        Pulse.
    background : float (n,), count
        Added to signal and model, so that noise about 0 is not taken for signal; positive.
    iterations : int
        Number of steps.

    Returns
    -------
    float (s, n)

    References
    ----------
    Biggs and Andrews (1997), Applied Optics 36(8), for the acceleration.
    """
    data = np.maximum(signal + background, 0)
    weight = 1 / correlate_pulse(np.ones((len(signal), 1), signal.dtype), taps)
    previous = estimate = np.repeat(np.maximum(sum_samples(data) / len(data), FLOOR)[None], len(data), axis=0) * weight
    before = change = np.zeros_like(estimate)
    for iteration in range(iterations):
        start = estimate
        if iteration > 1:
            start = np.maximum(estimate + _share(change, before) * (estimate - previous), 0)
        model = convolve_pulse(start, taps)
        model += background
        np.maximum(model, FLOOR * background, out=model)
        ratio = correlate_pulse(np.divide(data, model, out=model), taps)
        ratio *= weight
        previous, estimate = estimate, start * ratio
        before, change = change, estimate - start
    return estimate


def _share(change: np.ndarray, before: np.ndarray) -> np.ndarray:
    """How far each column continues in the direction of its last step, 0 to 1 (n,)."""
    along, length = sum_samples(change * before), sum_samples(before * before)
    return np.clip(along / np.where(length > 0, length, 1), 0, 1)


def deconvolve_gold(signal: np.ndarray, taps: np.ndarray, iterations: int) -> np.ndarray:
    """Signal deconvolved by Gold's ratios; never negative. Negative samples count as 0.

    Parameters
    ----------
    signal : float (s, n), count
        Waveforms without baseline.
    taps : float (k,)
        Pulse.
    iterations : int
        Number of steps.

    Returns
    -------
    float (s, n)
    """
    data = np.maximum(signal, 0)
    target = np.maximum(correlate_pulse(data, taps), 0)
    estimate = data.copy()
    for _ in range(iterations):
        model = correlate_pulse(convolve_pulse(estimate, taps), taps)
        estimate = np.divide(estimate * target, model, out=np.zeros_like(model), where=model > 0)
    return estimate


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
