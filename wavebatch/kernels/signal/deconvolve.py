"""Deconvolution of many waveforms with one pulse: Wiener, Richardson-Lucy, Gold (docs/algorithms.md 2.5).

Used by the stages of detect/wavelet.py and by the voxel tool. Arrays are (s, n); a pulse is given by its taps (k,),
k odd, of any height, centred on its middle tap. The sum of the result around an echo is its amplitude in units of the
pulse's height. Columns do not influence each other, bit for bit.
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
    if np.array_equal(taps, taps[::-1]):
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
    if np.array_equal(taps, taps[::-1]):
        inverse = 0.5 * (inverse + inverse[::-1])
    return convolve_pulse(signal, inverse)


def deconvolve_richardson_lucy(
    signal: np.ndarray, taps: np.ndarray, background: np.ndarray, iterations: int, *, accelerate: bool = True
) -> np.ndarray:
    """Signal deconvolved by expectation maximisation for Poisson counts; never negative.

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
    accelerate : bool
        Extrapolate each step from the two before it; worth about five times the iterations.

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
        if accelerate and iteration > 1:
            start = np.maximum(estimate + _share(change, before) * (estimate - previous), 0)
        model = convolve_pulse(start, taps)
        model += background
        np.maximum(model, FLOOR * background, out=model)
        ratio = correlate_pulse(np.divide(data, model, out=model), taps)
        ratio *= weight
        previous, estimate = estimate, start * ratio
        if accelerate:
            before, change = change, estimate - start
    return estimate


def _share(change: np.ndarray, before: np.ndarray) -> np.ndarray:
    """How far each column continues in the direction of its last step, 0 to 1 (n,)."""
    along, length = sum_samples(change * before), sum_samples(before * before)
    return np.clip(along / np.where(length > 0, length, 1), 0, 1)


def deconvolve_gold(
    signal: np.ndarray, taps: np.ndarray, iterations: int, *, rounds: int = 1, boost: float = 1.0
) -> np.ndarray:
    """Signal deconvolved by Gold's ratios; never negative. Negative samples count as 0.

    Parameters
    ----------
    signal : float (s, n), count
        Waveforms without baseline.
    taps : float (k,)
        Pulse.
    iterations : int
        Number of steps of a round.
    rounds : int
        Number of rounds.
    boost : float
        Power to which the result is raised between rounds.

    Returns
    -------
    float (s, n)
    """
    data = np.maximum(signal, 0)
    target = np.maximum(correlate_pulse(data, taps), 0)
    estimate = data.copy()
    for number in range(rounds):
        if number:
            top = np.maximum(estimate.max(axis=0), FLOOR)
            estimate = top * (estimate / top) ** signal.dtype.type(boost)
        for _ in range(iterations):
            model = correlate_pulse(convolve_pulse(estimate, taps), taps)
            estimate = np.divide(estimate * target, model, out=np.zeros_like(model), where=model > 0)
    return estimate
