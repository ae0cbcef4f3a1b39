"""The standard detectors: local maxima of a filtered waveform. Times in ns; widths are first guesses for the fit."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.closed_form import estimate_starts
from wavebatch.kernels.signal import filters
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, find_peaks, smooth_121
from wavebatch.stages.chain import Range, stage
from wavebatch.stages.detect.candidates import Searched, make_table, samples_of, signal_above

TWICE_SMOOTHED_GAIN = float(np.sqrt(70.0) / 16.0)
"""Standard deviation of white noise after two passes of the [1 2 1]/4 filter."""

LEAST_BLUR = 0.7
"""Least width of the smoothing before a derivative [samples]."""

BROAD = 4.0
"""Width of the system pulse [samples] from which the smoothing grows with it."""


def _smooth(block: WaveformBlock, noise: Noise, system: SystemPulse, *, threshold: float) -> Searched:
    """What `maximum` searches: its kernel smooths one waveform after the other."""
    _, taps, gain = choose_smoothing(system.sigma_ref / block.spacing)
    signal = signal_above(block, noise)
    smoothed = smooth_121(smooth_121(signal)) if taps is None else filters.filter_symmetric(signal, taps)
    least = threshold * gain * noise.std
    return Searched("smoothed [DN]", f"maxima above {threshold:g} std", smoothed, least, signal)


@stage("detect", searches=("", _smooth))
def maximum(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *, threshold: Annotated[float, Range(0.0, 1e6)] = 4.0
) -> EchoTable:
    """Echoes at the local maxima of the [1 4 6 4 1]/16-smoothed waveform.

    System pulses wider than 4 samples have several noise maxima on their tops. They are smoothed by a Gaussian instead,
    which grows by half of the additional width. Time, amplitude and width come from a log-parabola through five samples
    around the maximum. A broad echo is never split.

    Parameters
    ----------
    threshold : float
        Least height above the baseline [standard deviations of the smoothed noise].

    References
    ----------
    Wagner et al. (2007), max-detection; smoothing as in docs/algorithms.md 1.1.
    """
    ref = system.sigma_ref / block.spacing
    broad, taps, gain = choose_smoothing(ref)
    waveform, time, amplitude, width = filters.find_maxima(samples_of(block, noise), threshold * gain, ref, broad, taps)
    return make_table(block, waveform, time, amplitude, width)


class Smoothing(NamedTuple):
    """How waveforms are smoothed before their maxima are searched."""

    broad: float
    """Width of the Gaussian [samples]; 0 for two passes of the [1 2 1]/4 filter."""
    taps: np.ndarray | None
    """Half of the Gaussian, of unit sum; None without one."""
    gain: float
    """Standard deviation of unit white noise after it."""


def choose_smoothing(ref: float) -> Smoothing:
    """Return the smoothing that a system pulse asks for.

    Parameters
    ----------
    ref : float
        Width of the system pulse [samples].

    Returns
    -------
    Smoothing
        A Gaussian for pulses broader than BROAD.
    """
    if ref <= BROAD:
        return Smoothing(0.0, None, TWICE_SMOOTHED_GAIN)
    broad = 0.5 * (ref - BROAD) + 1.0
    taps = filters.gaussian_taps(broad)
    taps = taps / (taps[0] + 2 * taps[1:].sum())
    return Smoothing(broad, taps, float(np.sqrt(filters.filter_energy(taps))))


def _correlate(block: WaveformBlock, noise: Noise, system: SystemPulse, *, threshold: float) -> Searched:
    taps, signal = filters.gaussian_taps(system.sigma_ref / block.spacing), signal_above(block, noise)
    energy = filters.filter_energy(taps)
    least = np.float32(threshold * np.sqrt(energy)) * noise.std
    rule = f"maxima above {threshold:g} std"
    return Searched("correlation [DN]", rule, filters.filter_symmetric(signal, taps), least, signal, energy)


@stage("detect", searches=("correlation", _correlate))
def matched_filter(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *, threshold: Annotated[float, Range(0.0, 1e6)] = 4.27
) -> EchoTable:
    """Echoes at the maxima of the correlation with the system pulse: the most sensitive detector of weak echoes.

    Times come from a parabola through the logarithms of three correlations. For an isolated echo of the system's width
    their error is 1.00 to 1.04 of the Cramer-Rao bound.

    Parameters
    ----------
    threshold : float
        Least correlation [standard deviations of the filtered noise]; noise exceeds 4.27 in 0.1 % of waveforms of 200
        samples.

    References
    ----------
    docs/algorithms.md 1.1 (4), 1.3, 4.1.
    """
    ref = system.sigma_ref / block.spacing
    found = _correlate(block, noise, system, threshold=threshold)
    waveform, sample = find_peaks(found.values, found.least)
    time, height = filters.refine_peaks(found.values, waveform, sample)
    _, _, width = estimate_starts(smooth_121(found.signal), waveform, sample, ref)
    return make_table(block, waveform, time, height / found.unit, np.clip(width, 0.8 * ref, 2.0 * ref))


def _curve(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *, threshold: float, scale: float, level: float
) -> Searched:
    taps = filters.curvature_taps(max(scale * system.sigma_ref / block.spacing, LEAST_BLUR))
    signal = signal_above(block, noise)
    least = np.float32(threshold * np.sqrt(filters.filter_energy(taps))) * noise.std
    rule = f"maxima above {threshold:g} std where the smoothed signal is above {level:g} std"
    return Searched("- second derivative [DN/sample2]", rule, filters.filter_symmetric(signal, taps), least, signal)


@stage("detect", searches=("derivative", _curve))
def second_derivative(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *,
    threshold: Annotated[float, Range(0.0, 1e6)] = 2.0,
    scale: Annotated[float, Range(0.0, 100.0)] = 0.85,
    level: Annotated[float, Range(0.1, 1e6)] = 4.0,
) -> EchoTable:  # fmt: skip
    """Echoes at the maxima of the negative second derivative: separates echoes that share one maximum.

    The derivative is taken of the waveform smoothed by a Gaussian of width a. Equal echoes of width s are separated
    from a distance of 1.48 sqrt(s^2 + a^2) on.

    Parameters
    ----------
    threshold : float
        Least curvature [standard deviations of the filtered noise].
    scale : float
        Width of the smoothing [widths of the system pulse].
    level : float
        Least height of the smoothed signal above the baseline [standard deviations of its noise].

    References
    ----------
    Hofton et al. (2000), inflection points; docs/algorithms.md 1.2, 2.2.
    """
    ref = system.sigma_ref / block.spacing
    found = _curve(block, noise, system, threshold=threshold, scale=scale, level=level)
    smoothed = smooth_121(found.signal)
    waveform, sample = find_peaks(found.values, found.least)
    high = smoothed[sample, waveform] > (level * SMOOTH_GAIN) * noise.std[waveform]
    waveform, sample = waveform[high], sample[high]
    time, _ = filters.refine_peaks(found.values, waveform, sample)
    amplitude, _, width = estimate_starts(smoothed, waveform, sample, ref)
    return make_table(block, waveform, time, amplitude, np.clip(width, 0.8 * ref, 2.0 * ref))
