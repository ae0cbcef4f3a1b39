"""The detectors of Wagner et al. (2007) and Jutzi and Stilla (2005) that only comparisons need.

`detect.maximum` finds more than each of them at the same cost (docs/algorithms.md 1.1, 1.3).
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np

from wavebatch import EchoTable, Noise, SystemPulse, WaveformBlock, stage
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.kernels.fit.closed_form import estimate_starts
from wavebatch.kernels.signal.filters import curvature_taps, filter_energy, filter_symmetric
from wavebatch.kernels.signal.runs import find_runs, highest_samples, list_samples, walk_down
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, find_peaks, smooth_121
from wavebatch.stages.chain import Range
from wavebatch.stages.detect.candidates import candidate_table, signal_above
from wavebatch.stages.detect.maximum import LEAST_BLUR

INFLECTED = 2.0
"""Least negative curvature between two inflection points [standard deviations of its noise]."""


@stage("detect")
def sustained_threshold(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *,
    level: Annotated[float, Range(0.1, 1e6)] = 3.0,
    duration: Annotated[float, Range(0.0, 100.0)] = 1.0,
) -> EchoTable:  # fmt: skip
    """One echo per run of samples above a level that lasts as long as the system pulse, at its highest sample.

    Finds half of the echoes of 5.5 noise standard deviations and all of 10. It made no false echo in 20,000 waveforms
    of noise.

    Parameters
    ----------
    level : float
        Every sample of the run exceeds it [standard deviations of the noise].
    duration : float
        Least length of the run [full widths at half maximum of the system pulse].

    References
    ----------
    Jutzi and Stilla (2005); docs/algorithms.md 1.3.
    """
    signal = signal_above(block, noise)
    smoothed = smooth_121(signal)
    ref = system.sigma_ref / block.spacing
    least = max(round(duration * FWHM_PER_SIGMA * ref), 1)
    starts, ends = find_runs(signal, np.float32(level) * noise.std)
    long = ends - starts >= least
    starts, ends = starts[long], ends[long]
    waveform = starts // len(signal)
    peak = highest_samples(smoothed, starts, ends)
    amplitude, time, width = estimate_starts(smoothed, waveform, peak, ref)
    return candidate_table(block, system, waveform, time, amplitude, width)


@stage("detect")
def center_of_gravity(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *, level: Annotated[float, Range(0.1, 1e6)] = 4.0
) -> EchoTable:
    """One echo per run of smoothed signal above a level, at the centre of gravity of its samples.

    Insensitive to noise and to the shape of the pulse; overlapping echoes become one echo between them. The width is
    the standard deviation of the samples in time.

    Parameters
    ----------
    level : float
        Every sample of the run exceeds it [standard deviations of the smoothed noise].

    References
    ----------
    Wagner et al. (2007), section 3.
    """
    signal = signal_above(block, noise)
    smoothed = smooth_121(signal)
    starts, ends = find_runs(smoothed, np.float32(level * SMOOTH_GAIN) * noise.std)
    waveform = starts // len(signal)
    peak = highest_samples(smoothed, starts, ends)
    time, width = run_moments(signal, starts, ends)
    return candidate_table(block, system, waveform, time, smoothed[peak, waveform], width)


@stage("detect")
def zero_crossing(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *,
    derivative: Literal["first", "second"] = "first",
    level: Annotated[float, Range(0.1, 1e6)] = 4.0,
    scale: Annotated[float, Range(0.0, 100.0)] = 0.5,
) -> EchoTable:  # fmt: skip
    """Echoes where the first derivative falls through zero, or midway between two zeros of the second.

    The zeros of the second derivative are the inflection points: an echo lies midway between two of them, and its width
    is half of their distance.

    Parameters
    ----------
    derivative : {"first", "second"}
        Which derivative of the waveform.
    level : float
        Least height of the smoothed signal above the baseline [standard deviations of its noise].
    scale : float
        Width of the Gaussian that smooths before the derivative [widths of the system pulse].

    References
    ----------
    Wagner et al. (2007), section 3; Hofton et al. (2000).
    """
    signal = signal_above(block, noise)
    smoothed = smooth_121(signal)
    ref = system.sigma_ref / block.spacing
    blur = max(scale * ref, LEAST_BLUR)
    if derivative == "first":
        waveform, time = _falls_through_zero(filter_antisymmetric(signal, slope_taps(blur)))
        width = np.full(len(time), ref)
    else:
        taps = curvature_taps(blur)
        waveform, time, width = _between_inflections(filter_symmetric(signal, taps), taps, noise, blur)
    sample = np.clip(np.rint(time), 0, len(smoothed) - 1).astype(np.int64)
    amplitude = smoothed[sample, waveform]
    high = amplitude > (level * SMOOTH_GAIN) * noise.std[waveform]
    return candidate_table(block, system, waveform[high], time[high], amplitude[high], width[high])


def _falls_through_zero(slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Waveform and time (m,) of the places where slope (s, n) goes from positive to zero or below."""
    n = slope.shape[1]
    falling = slope[:-1] > 0
    falling &= slope[1:] <= 0
    sample, waveform = np.divmod(np.flatnonzero(falling), n) if n else (np.empty(0, np.int64),) * 2
    before, after = slope[sample, waveform], slope[sample + 1, waveform]
    return waveform, sample + before / (before - after)


def _between_inflections(
    curvature: np.ndarray, taps: np.ndarray, noise: Noise, blur: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Waveform, time and width (m,) of the stretches of positive curvature that exceed the noise."""
    waveform, sample = find_peaks(curvature, np.float32(INFLECTED * np.sqrt(filter_energy(taps))) * noise.std)
    zero = np.zeros(len(sample))
    left = walk_down(curvature, waveform, sample, zero, -1)
    right = walk_down(curvature, waveform, sample, zero, 1)
    half = 0.5 * (right - left)
    return waveform, left + half, np.sqrt(np.maximum(half * half - blur * blur, 0.0))


def run_moments(signal: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre of gravity and standard deviation of the positive signal in each run.

    Parameters
    ----------
    signal : float (s, n)
        Waveforms.
    starts, ends : int64 (k,)
        Runs.

    Returns
    -------
    centre, spread : float64 (k,), samples
        The middle of the run and 0 where no sample is positive.
    """
    s, n = signal.shape
    run, place = list_samples(starts, ends)
    sample = place % s
    weight = np.maximum(signal.reshape(-1)[sample * n + place // s], 0).astype(np.float64)
    middle = 0.5 * (starts + ends - 1) - starts // s * s
    lag = sample - middle[run]
    # bincount adds sample after sample, so that sums do not depend on the rest of the block.
    total, first, second = (np.bincount(run, weight * lag**p, minlength=len(starts)) for p in range(3))
    total = np.where(total > 0, total, 1.0)
    mean = first / total
    return middle + mean, np.sqrt(np.maximum(second / total - mean**2, 0.0))


def slope_taps(width: float, reach: float = 4.0) -> np.ndarray:
    """Half of an antisymmetric filter, the derivative of a Gaussian: taps 0, 1, ... [samples], the first one 0,
    float64.

    It gives the slope per sample of a straight line.
    """
    x = np.arange(int(np.ceil(reach * width)) + 1)
    taps = x * np.exp(-0.5 * (x / width) ** 2)
    return taps / (2 * np.sum(taps * x))


def filter_antisymmetric(signal: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Signal correlated with an antisymmetric filter.

    Parameters
    ----------
    signal : float32 (s, n)
        Waveforms; zero outside.
    taps : float (k,)
        Taps 0, 1, ... towards later samples; earlier samples have the negative ones.

    Returns
    -------
    float32 (s, n)
    """
    s = len(signal)
    total = np.zeros_like(signal)
    for i, tap in enumerate(taps[1:s], start=1):
        part = np.float32(tap) * signal
        total[:-i] += part[i:]
        total[i:] -= part[:-i]
    return total
