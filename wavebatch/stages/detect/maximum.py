"""Detectors: where a waveform holds echoes. Times in ns; widths are first guesses."""

from __future__ import annotations

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.closed_form import estimate_starts
from wavebatch.kernels.signal.filters import (
    curvature_taps,
    filter_energy,
    filter_symmetric,
    gaussian_taps,
    refine_peaks,
)
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, find_peaks, smooth_121
from wavebatch.stages.chain import stage
from wavebatch.stages.detect.candidates import make_table, signal_above

TWICE_SMOOTHED_GAIN = float(np.sqrt(70.0) / 16.0)
"""Standard deviation of white noise after two passes of the [1 2 1]/4 filter."""

BROAD = 4.0
"""Width of the system pulse [samples] from which the smoothing grows with it."""


@stage("detect")
def maximum(block: WaveformBlock, noise: Noise, system: SystemPulse, *, threshold: float = 4.0) -> EchoTable:
    """Echoes at the local maxima of the [1 4 6 4 1]/16-smoothed waveform.

    Of pulses wider than 4 samples, on whose tops noise has maxima of its own, a Gaussian takes the place of these taps,
    which grows by half of what they are wider. Time, amplitude and width come from a log-parabola through five samples
    around the maximum. Never splits a broad echo. Source: Wagner et al. (2007), max-detection; smoothing as in
    ALGORITHMS 1.1.

    threshold: least height above the baseline, in standard deviations of the smoothed noise.
    """
    signal = signal_above(block, noise)
    ref = system.sigma_ref / block.spacing
    broad = 0.5 * (ref - BROAD) + 1.0 if ref > BROAD else 0.0
    if broad:
        taps = gaussian_taps(broad)
        taps /= taps[0] + 2 * taps[1:].sum()
        even = smoothed = filter_symmetric(signal, taps)
        gain = float(np.sqrt(filter_energy(taps)))
    else:
        smoothed = smooth_121(signal)
        even, gain = smooth_121(smoothed), TWICE_SMOOTHED_GAIN
    waveform, sample = find_peaks(even, np.float32(threshold * gain) * noise.std)
    amplitude, time, width = estimate_starts(smoothed, waveform, sample, ref)
    gap = _nearest_gap(waveform, sample)
    crowded = np.flatnonzero(gap < 4.0 * ref)
    time[crowded], amplitude[crowded] = refine_peaks(smoothed, waveform[crowded], sample[crowded])
    width = np.minimum(width, 0.5 * gap)
    if broad:
        width = np.sqrt(np.maximum(width * width - broad * broad, 0.25 * ref * ref))
        amplitude *= np.hypot(1.0, broad / width)
    return make_table(block, waveform, time, amplitude, np.clip(width, 0.7 * ref, 4.0 * ref))


def _nearest_gap(waveform: np.ndarray, sample: np.ndarray) -> np.ndarray:
    """Samples to the nearest other maximum of the waveform (m,), infinite without one.

    Echoes closer than two widths have one maximum (ALGORITHMS 2.2), so half of the gap bounds the width.
    """
    gap = np.full(len(sample) + 1, np.inf)
    gap[1:-1] = np.where(np.diff(waveform) == 0, np.diff(sample), np.inf)
    return np.minimum(gap[:-1], gap[1:])


@stage("detect")
def matched_filter(block: WaveformBlock, noise: Noise, system: SystemPulse, *, threshold: float = 4.27) -> EchoTable:
    """Echoes at the maxima of the correlation with the system pulse: the most sensitive detector of weak echoes.

    Sub-sample times by a parabola through the logarithms of three correlations (1.00-1.04 of the Cramer-Rao bound
    for an isolated echo of the system's width). Source: ALGORITHMS 1.1 (4), 1.3, 4.1.

    threshold: least correlation, in standard deviations of the filtered noise; 4.27 lets noise through in 0.1 % of 200
    samples.
    """
    ref = system.sigma_ref / block.spacing
    taps = gaussian_taps(ref)
    energy = filter_energy(taps)
    signal = signal_above(block, noise)
    correlation = filter_symmetric(signal, taps)
    waveform, sample = find_peaks(correlation, np.float32(threshold * np.sqrt(energy)) * noise.std)
    time, height = refine_peaks(correlation, waveform, sample)
    _, _, width = estimate_starts(smooth_121(signal), waveform, sample, ref)
    return make_table(block, waveform, time, height / energy, np.clip(width, 0.8 * ref, 2.0 * ref))


@stage("detect")
def second_derivative(
    block: WaveformBlock,
    noise: Noise,
    system: SystemPulse,
    *,
    threshold: float = 2.0,
    scale: float = 0.85,
    level: float = 4.0,
) -> EchoTable:
    """Echoes at the maxima of the negative second derivative: separates echoes that share one maximum.

    The derivative is taken of the waveform smoothed by a Gaussian. Equal echoes are told apart from
    1.48 sqrt(s^2 + a^2) on, a the smoothing. Source: Hofton et al. (2000), inflection points; ALGORITHMS 1.2, 2.2.

    threshold: least curvature, in standard deviations of the filtered noise.
    scale: width of the smoothing, in widths of the system pulse.
    level: least height of the smoothed signal above the baseline, in standard deviations of its noise.
    """
    signal = signal_above(block, noise)
    smoothed = smooth_121(signal)
    ref = system.sigma_ref / block.spacing
    taps = curvature_taps(max(scale * ref, 0.7))
    curvature = filter_symmetric(signal, taps)
    waveform, sample = find_peaks(curvature, np.float32(threshold * np.sqrt(filter_energy(taps))) * noise.std)
    s, n = smoothed.shape
    high = smoothed.reshape(-1)[sample * n + waveform] > (level * SMOOTH_GAIN) * noise.std[waveform]
    waveform, sample = waveform[high], sample[high]
    time, _ = refine_peaks(curvature, waveform, sample)
    amplitude, _, width = estimate_starts(smoothed, waveform, sample, ref)
    return make_table(block, waveform, time, amplitude, np.clip(width, 0.8 * ref, 2.0 * ref))
