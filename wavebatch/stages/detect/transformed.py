"""Detectors that search a transformed waveform: chains call them, `plot waveform` draws what they search.

Wavelets and deconvolution, and comparison with a reference pulse: correlation and average square difference (ASDF).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import exp
from wavebatch.kernels.elementary import log as logarithm
from wavebatch.kernels.signal import filters
from wavebatch.kernels.signal.deconvolve import deconvolve_richardson_lucy
from wavebatch.kernels.signal.runs import list_samples
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, find_peaks, smooth_121
from wavebatch.stages.chain import Range, stage
from wavebatch.stages.detect.direct import Searched, candidate_table, signal_above
from wavebatch.stages.pulse_tables import ReferenceKind, reference_pulse

HAT_WIDTH = 0.75
"""Width of the Mexican hat that separates echoes as the B3 wavelet does [system widths] (docs/algorithms.md 1.2)."""

COARSEST = 15
"""Level of the B3 transform that spans the longest waveforms."""

BACKGROUND = 3
"""Added to waveforms for the iteration, which needs positive values [standard deviations of the noise]."""

AT_A_TIME = 1024
"""Waveforms whose arrays stay in the cache together."""


def _transform(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *, wavelet: str, threshold: float, scale: float
) -> Searched:
    signal = signal_above(block, noise)
    detail, gain = transform(signal, system.sigma_ref / block.spacing, wavelet, scale, block.spacing)
    rule, least = f"maxima above {threshold:g} std", np.float32(threshold * gain) * noise.std
    return Searched(f"{wavelet} coefficients [DN]", rule, detail, least, signal)


@stage("detect", searches=("wavelet", _transform))
def wavelet(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *,
    wavelet: Literal["b3", "mexican_hat"] = "b3",
    threshold: Annotated[float, Range(0.0, 1e6)] = 4.0,
    scale: Annotated[float, Range(0.0, 100.0)] = 0.0,
) -> EchoTable:  # fmt: skip
    """Echoes at the maxima of one scale of a wavelet transform.

    The B3-spline transform with holes separates echoes from a distance of about one full width at half maximum on; its
    level follows the width of the system pulse.

    Parameters
    ----------
    wavelet : {"b3", "mexican_hat"}
        `b3` for the B3-spline transform, `mexican_hat` for the second derivative of a Gaussian.
    threshold : float
        Least value at a maximum [standard deviations of the transformed noise]; the paper's is 3.
    scale : float
        Level of the B3 transform (1, 2, ...), or width of the Mexican hat [ns]; 0 chooses by the system pulse.

    References
    ----------
    Wang, Wang and Tseng; docs/algorithms.md 1.2.
    """
    found = _transform(block, noise, system, wavelet=wavelet, threshold=threshold, scale=scale)
    waveform, sample = find_peaks(found.values, found.least)
    time, _ = filters.refine_peaks(found.values, waveform, sample)
    amplitude = smooth_121(found.signal)[sample, waveform]
    return candidate_table(block, system, waveform, time, amplitude)


def transform(signal: np.ndarray, ref: float, wavelet: str, scale: float, spacing: float) -> tuple[np.ndarray, float]:
    """Transform waveforms at one scale.

    Parameters
    ----------
    signal : float array, shape (s, n)
        Waveforms above their baselines [DN].
    ref : float
        Width of the system pulse [samples].
    wavelet : {"b3", "mexican_hat"}
    scale : float
        As for stage detect.wavelet.
    spacing : float
        Of the samples [ns].

    Returns
    -------
    detail : float array, shape (s, n)
        Coefficients.
    gain : float
        Standard deviation of unit white noise in them.

    Raises
    ------
    ConfigError
        For a level of the B3 transform that is too coarse.
    """
    if wavelet != "b3":
        taps = filters.curvature_taps(max(scale / spacing if scale > 0 else HAT_WIDTH * ref, 0.5))
        return filters.filter_symmetric(signal, taps), float(np.sqrt(filters.filter_energy(taps)))
    level = max(round(scale), 1) if scale > 0 else filters.b3_level(ref)
    if level > COARSEST:
        raise ConfigError(f"scale is the level of the b3 wavelet, at most {COARSEST}, it is {scale:g}")
    return filters.b3_detail(signal, level), filters.b3_gain(level)


def _deconvolve(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *, reference: ReferenceKind, iterations: int,
    threshold: float, reach: float, pulse: str,
) -> Searched:  # fmt: skip
    """What `richardson_lucy` searches in parts: deconvolved waveforms, and about the sums of its spikes."""
    given, signal = reference_pulse(system, block.spacing, reference, reach, pulse), signal_above(block, noise)
    profile = deconvolve_richardson_lucy(signal, given.taps, BACKGROUND * noise.std, iterations)
    wide = 2 * spike_reach(system.sigma_ref / block.spacing) + 1
    sums = filters.slide_taps(filters.pad_samples(profile.astype(np.float64), wide // 2), np.ones(wide))
    rule, least = f"spikes whose sum is above {threshold:g} std", threshold / np.sqrt(np.sum(given.taps**2)) * noise.std
    return Searched("deconvolved [DN]", rule, profile, least, signal, first=given.peak - given.middle,
                    second=sums, second_label=f"sum of {wide} samples")  # fmt: skip


@stage("detect", searches=("deconvolved", _deconvolve))
def richardson_lucy(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *,
    reference: Literal["gaussian", "system", "given"] = "system",
    iterations: Annotated[int, Range(1, 10_000)] = 16,
    threshold: Annotated[float, Range(0.0, 1e6)] = 4.27,
    reach: Annotated[float, Range(0.5, 20.0)] = 3.0,
    pulse: str = "",
) -> EchoTable:  # fmt: skip
    """Echoes at the peaks of the waveform deconvolved by Richardson and Lucy's iteration with the pulse.

    Each iteration starts from an extrapolation of the earlier ones. Separates echoes of the system's width that are 2
    widths apart (1.5 with 40 iterations), but draws close ones together.

    Parameters
    ----------
    reference : {"gaussian", "system", "given"}
        A Gaussian of the system's width, the system pulse of the survey, or the pulse given below.
    iterations : int
        More iterations separate closer echoes, and split more broad ones.
    threshold : float
        Least amplitude of an echo [standard deviations that the amplitude of an isolated echo would have].
    reach : float
        Half of the reference's length [widths of the system pulse].
    pulse : str
        Samples of the given pulse, separated by spaces, with the spacing of the waveform.

    References
    ----------
    Richardson (1972), Lucy (1974); docs/algorithms.md 2.5.
    """
    given = reference_pulse(system, block.spacing, reference, reach, pulse)
    signal = signal_above(block, noise)
    busy = np.flatnonzero((smooth_121(signal) > np.float32(2.0 * SMOOTH_GAIN) * noise.std).any(axis=0))
    least = threshold / np.sqrt(np.sum(given.taps**2))
    half = spike_reach(system.sigma_ref / block.spacing)

    def detect(signal: np.ndarray, std: np.ndarray) -> Peaks:
        profile = deconvolve_richardson_lucy(signal, given.taps, BACKGROUND * std, iterations)
        # A spike reaches `half` samples around its peak, or halfway to the next peak; its sum counts.
        lowest, s = np.float32(least) * std, len(profile)
        waveform, sample = find_peaks(profile, 0.1 * lowest / half)
        low, high = np.maximum(sample - half, 0), np.minimum(sample + half + 1, s)
        same = waveform[1:] == waveform[:-1]
        middle = (sample[1:] + sample[:-1] + 1) // 2
        low[1:] = np.where(same, np.maximum(low[1:], middle), low[1:])
        high[:-1] = np.where(same, np.minimum(high[:-1], middle), high[:-1])
        spike, place = list_samples(waveform * s + low, waveform * s + high)
        at = place % s
        value = profile[at, place // s].astype(np.float64)
        amplitude = np.bincount(spike, value, minlength=len(sample))
        time = np.bincount(spike, value * at, minlength=len(sample)) / np.where(amplitude > 0, amplitude, 1.0)
        keep = amplitude >= lowest[waveform]
        return waveform[keep], time[keep] + (given.peak - given.middle), amplitude[keep]

    waveform, time, amplitude = _in_parts(signal[:, busy], noise.std[busy], detect, AT_A_TIME)
    return candidate_table(block, system, busy[waveform], time, amplitude)


def spike_reach(ref: float) -> int:
    """Return how many samples a spike reaches to each side, for a system pulse of width `ref` [samples]."""
    return max(int(round(ref)), 1)


Peaks = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Waveform, time [samples], amplitude."""


def _in_parts(
    signal: np.ndarray, std: np.ndarray, detect: Callable[..., Peaks], most: int | None = None
) -> Peaks:
    """Candidates of the columns of signal (s, n), `most` at a time, so that arrays stay in the cache."""
    found: list[Peaks] = [(np.empty(0, np.int64), np.empty(0), np.empty(0))]
    most = most or filters.COLUMNS_AT_A_TIME
    for begin in range(0, signal.shape[1], most):
        part = slice(begin, begin + most)
        waveform, time, amplitude = detect(np.ascontiguousarray(signal[:, part]), std[part])
        found.append((waveform + begin, time, amplitude))
    waveform, time, amplitude = (np.concatenate(fields) for fields in zip(*found, strict=True))
    return waveform, time, amplitude


def _correlate(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *, reference: ReferenceKind, threshold: float,
    similarity: float, reach: float, pulse: str,
) -> Searched:  # fmt: skip
    """What `correlation` searches in parts."""
    given, signal = reference_pulse(system, block.spacing, reference, reach, pulse), signal_above(block, noise)
    energy = float(np.sum(given.taps**2))
    rule = f"maxima above {threshold:g} std, coefficient at least {similarity:g}"
    values = filters.slide_taps(filters.pad_samples(signal, given.middle), given.taps)
    least = threshold * np.sqrt(energy) * noise.std
    return Searched("correlation [DN]", rule, values, least, signal, energy, given.peak - given.middle)


@stage("detect", searches=("correlation", _correlate))
def correlation(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *,
    reference: Literal["gaussian", "system", "given"] = "system",
    threshold: Annotated[float, Range(0.0, 1e6)] = 4.27,
    similarity: Annotated[float, Range(0.0, 1.0)] = 0.5,
    reach: Annotated[float, Range(0.5, 20.0)] = 3.0,
    pulse: str = "",
) -> EchoTable:  # fmt: skip
    """Echoes at the maxima of the correlation with a reference pulse, where the waveform resembles it.

    Times come from a parabola through the logarithms of three correlations.

    Parameters
    ----------
    reference : {"gaussian", "system", "given"}
        A Gaussian of the system's width, the system pulse of the survey, or the pulse given below.
    threshold : float
        Least correlation [standard deviations of the filtered noise].
    similarity : float
        Least correlation coefficient of waveform and reference, at most 1.
    reach : float
        Half of the reference's length [widths of the system pulse].
    pulse : str
        Samples of the given pulse, separated by spaces, with the spacing of the waveform.

    References
    ----------
    Hofton and Blair (2002); Jutzi and Stilla (2005); docs/algorithms.md 1.3.
    """
    given = reference_pulse(system, block.spacing, reference, reach, pulse)
    energy = float(np.sum(given.taps**2))

    def detect(signal: np.ndarray, std: np.ndarray) -> Peaks:
        padded = filters.pad_samples(signal, given.middle)
        correlations = filters.slide_taps(padded, given.taps)
        waveform, sample = find_peaks(correlations, np.float32(threshold * np.sqrt(energy)) * std)
        squares = filters.slide_energy(padded, len(given.taps))[sample, waveform]
        value = correlations[sample, waveform]
        alike = value >= similarity * np.sqrt(np.maximum(squares, 0) * np.float32(energy))
        waveform, sample = waveform[alike], sample[alike]
        time, height = filters.refine_peaks(correlations, waveform, sample)
        return waveform, time + (given.peak - given.middle), height / energy

    return candidate_table(block, system, *_in_parts(signal_above(block, noise), noise.std, detect))


def _compare(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *, reference: ReferenceKind, rule: str,
    fraction: float, threshold: float, interpolation: str, reach: float, pulse: str,
) -> Searched:  # fmt: skip
    """What `asdf` searches in parts."""
    given, signal = reference_pulse(system, block.spacing, reference, reach, pulse), signal_above(block, noise)
    height = signal.max(axis=0)
    difference, _ = filters.square_differences(signal, given.taps, height)
    if rule == "paper":
        least = fraction * np.ptp(difference, axis=0)
        words = f"minima as deep as {fraction:g} of the range (bars)"
    else:
        least = 2 * threshold * np.sqrt(np.sum(given.taps**2)) * noise.std * np.maximum(height, 0)
        words = f"minima as deep as the bars ({threshold:g} std), with a correlation above {threshold:g} std"
    first = given.peak - (len(given.taps) - 1)
    return Searched("square difference R [DN2]", words, difference, least, signal, first=first, deep=True)


@stage("detect", searches=("asdf", _compare))
def asdf(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *,
    reference: Literal["gaussian", "system", "given"] = "gaussian",
    rule: Literal["absolute", "paper"] = "absolute",
    fraction: Annotated[float, Range(0.0, 1.0)] = 0.3,
    threshold: Annotated[float, Range(0.0, 1e6)] = 4.0,
    interpolation: Literal["log", "parabola"] = "log",
    reach: Annotated[float, Range(0.5, 20.0)] = 5.0,
    pulse: str = "",
) -> EchoTable:  # fmt: skip
    """Echoes at the minima of the average square difference to a reference pulse as high as the waveform.

    The paper's rule loses echoes below 30 % of the strongest and finds at least one echo in noise alone. The absolute
    rule asks for a minimum that is deeper than noise makes it, at a maximum of the correlation.

    Parameters
    ----------
    reference : {"gaussian", "system", "given"}
        A Gaussian of the system's width, the system pulse of the survey, or the pulse given below.
    rule : {"absolute", "paper"}
        `absolute` for a threshold in noise, `paper` for one relative to the waveform's largest and least difference.
    fraction : float
        Paper's rule: share of the range of differences that separates minima.
    threshold : float
        Absolute rule: least depth of a minimum and least correlation at it [standard deviations of the filtered noise].
    interpolation : {"log", "parabola"}
        `log` for a parabola through the logarithms of the correlation, which has no bias for Gaussians; `parabola` for
        the paper's, through the differences.
    reach : float
        Half of the reference's length [widths of the system pulse].
    pulse : str
        Samples of the given pulse, separated by spaces, with the spacing of the waveform.

    References
    ----------
    Wagner et al. (2007) eq. 6, 7; docs/algorithms.md 1.1.
    """
    given = reference_pulse(system, block.spacing, reference, reach, pulse)
    gain = np.float32(threshold * np.sqrt(np.sum(given.taps**2)))

    def detect(signal: np.ndarray, std: np.ndarray) -> Peaks:
        height = signal.max(axis=0)
        difference, correlations = filters.square_differences(signal, given.taps, height)
        values = np.ascontiguousarray(difference.T)
        if rule == "paper":
            minima = filters.find_minima(values)
            least = np.float32(fraction) * (difference.max(axis=0) - difference.min(axis=0))
        else:
            minima = filters.find_minima(values, np.ascontiguousarray((correlations > gain * std).T))
            least = 2 * gain * std * np.maximum(height, 0)
        kept = minima.take(filters.keep_prominent(minima, least))
        # Distance from the minima to the peak [samples], and whether the correlation peaks there.
        waveform, row = kept.waveform, kept.row
        shift = parabola_shift(*(values[waveform, row + d] for d in (-1, 0, 1)))
        near = [correlations[row + d, waveform] for d in (-1, 0, 1)]
        positive = (near[0] > 0) & (near[1] > 0) & (near[2] > 0)
        by_log = parabola_shift(*(-logarithm(np.where(positive, y, 1).astype(np.float64)) for y in near))
        peaked = positive & (np.abs(by_log) < 1.5)
        shift = np.where(peaked & (interpolation == "log"), by_log, shift)
        time = kept.row - (len(given.taps) - 1) + given.peak + shift
        amplitude = correlations[kept.row, kept.waveform] / np.sum(given.taps**2)
        inside = (time >= 0) & (time <= len(signal) - 1) & (peaked | (rule == "paper"))
        return kept.waveform[inside], time[inside], amplitude[inside]

    table = candidate_table(block, system, *_in_parts(signal_above(block, noise), noise.std, detect))
    if interpolation == "log":
        return table
    bias = block.spacing * parabola_bias(system.sigma_ref / block.spacing)
    return replace(table, time_err=np.full(len(table), bias, np.float32))


@lru_cache(maxsize=8)
def parabola_bias(width: float) -> float:
    """Find the error that a parabola through a Gaussian's square differences has without noise.

    Parameters
    ----------
    width : float
        Of the system pulse [samples].

    Returns
    -------
    float
        Root mean square over the phases of the samples [samples].

    References
    ----------
    docs/algorithms.md 1.1, item 3.
    """
    phase = np.linspace(-0.5, 0.5, 41)
    near = [-exp(-((lag - phase) ** 2) / (4 * width * width)) for lag in (-1, 0, 1)]
    return float(np.sqrt(np.mean((parabola_shift(*near) - phase) ** 2)))


def parabola_shift(before: np.ndarray, here: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Find the vertex of the parabola through three equidistant values.

    Parameters
    ----------
    before, here, after : float array, shape (k,)
        The three values.

    Returns
    -------
    float64 array, shape (k,)
        Samples from the middle value to the vertex; inf where the parabola has no minimum.
    """
    before, here, after = (values.astype(np.float64) for values in (before, here, after))
    curve = before - 2 * here + after
    return np.where(curve > 0, 0.5 * (before - after) / np.where(curve > 0, curve, 1.0), np.inf)
