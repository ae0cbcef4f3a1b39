"""Deconvolution of many waveforms with one pulse: Wiener, Richardson-Lucy, Gold (ALGORITHMS 2.5).

Arrays are (samples, n). A pulse is given by its taps (k,), k odd, of any height, and works around its middle tap. The
result o is such that the waveform is the sum of o[i] times the pulse put at i: the sum of o around an echo is its
amplitude in units of the pulse's height. Columns are independent of each other, bit for bit.
"""

from __future__ import annotations

import numpy as np

from wavebatch.kernels.signal.filters import filter_symmetric
from wavebatch.kernels.signal.signal import sum_samples

FLOOR = np.float32(1e-6)
"""Least value of a model that data are divided by, in units of its background."""


def convolve_pulse(signal: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Signal (s, n) with every sample replaced by the pulse of its height; zero outside."""
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
    """The Wiener filter of a pulse as taps (2 reach + 1,) for `convolve_pulse`.

    noise_to_signal: power of the noise over that of the wanted signal, per sample; reach: beyond which it is cut off.
    """
    length = 8 * (reach + len(taps))
    pulse = np.zeros(length)
    pulse[: len(taps)] = taps
    spectrum = np.fft.rfft(np.roll(pulse, -(len(taps) // 2)))
    inverse = np.fft.irfft(np.conj(spectrum) / (np.abs(spectrum) ** 2 + noise_to_signal), length)
    return np.roll(inverse, reach)[: 2 * reach + 1]


def deconvolve_wiener(signal: np.ndarray, taps: np.ndarray, noise_to_signal: float) -> np.ndarray:
    """Signal (s, n) deconvolved by the linear filter of least mean square error; may be negative."""
    reach = 4 * len(taps)
    inverse = wiener_taps(taps, noise_to_signal, reach)
    if np.array_equal(taps, taps[::-1]):
        inverse = 0.5 * (inverse + inverse[::-1])
    return convolve_pulse(signal, inverse)


def deconvolve_richardson_lucy(
    signal: np.ndarray, taps: np.ndarray, background: np.ndarray, iterations: int, *, accelerate: bool = True
) -> np.ndarray:
    """Signal (s, n) deconvolved by the expectation maximisation of Poisson counts, never negative.

    background: added to signal and model (n,), so that noise about 0 is not taken for signal; positive. accelerate:
    extrapolate each step from the two before it (Biggs and Andrews 1997), worth about five times the iterations.
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
    """How far each column goes on in the direction of its last step, 0 to 1 (n,)."""
    along, length = sum_samples(change * before), sum_samples(before * before)
    return np.clip(along / np.where(length > 0, length, 1), 0, 1)


def deconvolve_gold(
    signal: np.ndarray, taps: np.ndarray, iterations: int, *, rounds: int = 1, boost: float = 1.0
) -> np.ndarray:
    """Signal (s, n) deconvolved by Gold's ratios, never negative; negative samples count as 0.

    rounds: how often the iterations are run; between them the result is raised to the power `boost`.
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
