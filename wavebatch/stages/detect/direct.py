"""What all detectors share, and the detectors that search the waveform itself, smoothed or filtered.

Shared are the signal that they search and the table of candidates that they return. Times in ns; widths are first
guesses for the fit. The classic detectors are those of Wagner et al. (2007) and of Jutzi and Stilla (2005);
`detect.maximum` finds more than each of them at the same cost (docs/algorithms.md 1.1, 1.3).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.frozen import frozen
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import exp, log
from wavebatch.kernels.fit.closed_form import estimate_starts
from wavebatch.kernels.library import Samples
from wavebatch.kernels.signal import filters
from wavebatch.kernels.signal.runs import find_runs, gap_distance, highest_samples, run_moments, walk_down
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, find_peaks, find_varying, smooth_121, transpose_samples
from wavebatch.stages.chain import Range, stage


@frozen(eq=False)
class Searched:
    """The signal in which a detector searches n waveforms for echoes; `wavebatch plot waveform --show` draws it."""

    label: str
    """What it is, with its unit."""
    rule: str
    """When a maximum or a minimum of it is an echo."""
    values: np.ndarray
    """(q, n) as kernels give it."""
    least: np.ndarray
    """Threshold: a level, or the depth that a minimum needs, (n,); NaN without one."""
    signal: np.ndarray
    """What it was made of: waveforms above their baselines [DN], f4 (s, n)."""
    unit: float = 1.0
    """What one DN is in it: pictures divide by it."""
    first: float = 0.0
    """Place of the first value [samples]."""
    deep: bool = False
    """Whether `least` is the depth of minima instead of a level."""
    second: np.ndarray | None = None
    """A further line with the same unit and times, to which `least` belongs, as `values`."""
    second_label: str = ""


def signal_above(block: WaveformBlock, noise: Noise) -> np.ndarray:
    """Subtract the baseline of each waveform.

    Parameters
    ----------
    block : WaveformBlock
        n waveforms of s samples.
    noise : Noise
        Their baselines.

    Returns
    -------
    float32 array, shape (s, n)
        Signal above the baseline [DN]; waveforms lie along the last axis, as kernels need it.
    """
    signal = transpose_samples(block.samples)
    signal -= noise.level.T
    if block.missing is not None:
        missing = block.missing.T
        signal[missing] = 0
        # An echo across a single sample is one.
        single = missing[1:-1] & ~missing[:-2] & ~missing[2:]
        signal[1:-1] = np.where(single, 0.5 * (signal[:-2] + signal[2:]), signal[1:-1])
    return signal


def samples_of(block: WaveformBlock, noise: Noise) -> Samples:
    """Put the waveforms of a block and their noise together, as kernels take them.

    Parameters
    ----------
    block, noise
        As for a stage.

    Returns
    -------
    Samples
        Raw counts with their levels and what is known of their errors.
    """
    levels = noise.baseline if noise.of_sample is None else noise.of_sample
    return Samples(block.samples, levels, noise.std, block.missing, noise.baseline_err)


def make_table(
    block: WaveformBlock,
    waveform: np.ndarray,
    time: np.ndarray,
    amplitude: np.ndarray,
    width: np.ndarray,
    *,
    varies: bool = False,
) -> EchoTable:
    """Turn candidates in samples into a table in ns.

    Constant waveforms and gaps between two recordings get none, whatever a filter shows at their ends.

    Parameters
    ----------
    block : WaveformBlock
        The waveforms.
    waveform : int array, shape (m,)
        Row of the block.
    time, width : float array, shape (m,)
        Centre and standard deviation [samples].
    amplitude : float array, shape (m,)
        Height above the baseline [DN].
    varies : bool
        Whether constant waveforms have none already.

    Returns
    -------
    EchoTable
        Candidates, sorted.

    References
    ----------
    docs/algorithms.md H10.
    """
    kept = np.ones(len(waveform), bool)
    if not varies:
        rows, row = np.unique(waveform, return_inverse=True)
        kept = find_varying(block.samples[rows])[row]
    if block.missing is not None:
        kept &= gap_distance(block.missing, waveform, time) > -1.0
    columns = (waveform, time * block.spacing, amplitude, width * block.spacing)
    return EchoTable.build(*(columns if kept.all() else (values[kept] for values in columns)))


def candidate_table(
    block: WaveformBlock,
    system: SystemPulse,
    waveform: np.ndarray,
    time: np.ndarray,
    amplitude: np.ndarray,
    width: np.ndarray | None = None,
) -> EchoTable:
    """Turn candidates in samples into a table in ns, with all values brought into their legal ranges.

    Widths are clipped to 0.7 to 4 system widths, times to the waveform, amplitudes to 0 and above.

    Parameters
    ----------
    block : WaveformBlock
        The waveforms.
    system : SystemPulse
        With the width of the system pulse.
    waveform : int array, shape (m,)
        Row of the block.
    time : float array, shape (m,)
        Centre [samples].
    amplitude : float array, shape (m,)
        Height above the baseline [DN].
    width : float array, shape (m,), optional
        Standard deviation [samples]; the system's by default.

    Returns
    -------
    EchoTable
        Candidates, sorted.
    """
    ref = system.sigma_ref / block.spacing
    last = block.samples.shape[1] - 1
    width = np.full(len(time), ref) if width is None else width
    return make_table(
        block, waveform, np.clip(time, 0.0, last), np.maximum(amplitude, 0.0), np.clip(width, 0.7 * ref, 4.0 * ref)
    )


TWICE_SMOOTHED_GAIN = float(np.sqrt(70.0) / 16.0)
"""Standard deviation of white noise after two passes of the [1 2 1]/4 filter."""

LEAST_BLUR = 0.7
"""Least width of the smoothing before a derivative [samples]."""

BROAD = 4.0
"""Width of the system pulse [samples] from which the smoothing grows with it."""


def _smooth_twice(block: WaveformBlock, noise: Noise, system: SystemPulse, *, threshold: float) -> Searched:
    """What `maximum` searches: its kernel smooths one waveform after the other."""
    _, taps, gain = choose_smoothing(system.sigma_ref / block.spacing)
    signal = signal_above(block, noise)
    smoothed = smooth_121(smooth_121(signal)) if taps is None else filters.filter_symmetric(signal, taps)
    least = threshold * gain * noise.std
    return Searched("smoothed [DN]", f"maxima above {threshold:g} std", smoothed, least, signal)


@stage("detect", searches=("", _smooth_twice))
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
    return make_table(block, waveform, time, amplitude, width, varies=True)


def choose_smoothing(ref: float) -> tuple[float, np.ndarray | None, float]:
    """Return the smoothing that a system pulse asks for.

    Parameters
    ----------
    ref : float
        Width of the system pulse [samples].

    Returns
    -------
    broad : float
        Width of the Gaussian [samples], for pulses broader than BROAD; 0 for two passes of the [1 2 1]/4 filter.
    taps : np.ndarray, optional
        Half of the Gaussian, of unit sum; None without one.
    gain : float
        Standard deviation of unit white noise after it.
    """
    if ref <= BROAD:
        return 0.0, None, TWICE_SMOOTHED_GAIN
    broad = 0.5 * (ref - BROAD) + 1.0
    taps = filters.gaussian_taps(broad)
    taps = taps / (taps[0] + 2 * taps[1:].sum())
    return broad, taps, float(np.sqrt(filters.filter_energy(taps)))


def _correlate(block: WaveformBlock, noise: Noise, system: SystemPulse, *, threshold: float) -> Searched:
    """What `matched_filter` searches: its kernel takes one waveform after the other."""
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
    taps = filters.gaussian_taps(ref)
    energy = filters.filter_energy(taps)
    waveform, *found = filters.find_correlated(samples_of(block, noise), threshold * np.sqrt(energy), ref, taps)
    time, height, width = found
    return EchoTable.build(waveform, time * block.spacing, height / energy, width * block.spacing)


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


INFLECTED = 2.0
"""Least negative curvature between two inflection points [standard deviations of its noise]."""


def _smoothed_height(smoothed: np.ndarray, at: np.ndarray, waveform: np.ndarray, ref: float) -> tuple[np.ndarray, ...]:
    """Amplitudes and widths to start with of peaks (m,), and heights of the smoothed signal between its samples."""
    amplitude, _, width = estimate_starts(smoothed, waveform, at, ref)
    top = smoothed[at, waveform]
    height = np.maximum(amplitude / np.sqrt(1 + 0.5 / np.maximum(width, 0.3) ** 2), 0.0)
    return amplitude, width, np.clip(height, top, 1.2 * top)


def _time_to_peak(edge: np.ndarray, ratio: np.ndarray, ref: float) -> np.ndarray:
    """Time from an edge to the peak of an echo of the system's width, smoothed by [1 2 1]/4 (m,) [samples].

    edge: where a line between two samples meets the level. Flanks are bent, so that the line meets it too early, by .1
    sample for strong echoes; the place between the samples gives the correction.
    ratio: height of the peak over the level.
    """
    width = np.sqrt(ref * ref + 0.5)
    away = width * np.sqrt(2 * log(np.maximum(ratio, 1.0)))
    place = edge - np.floor(edge)
    before, after = (ratio * exp(-0.5 * (lag / width) ** 2) for lag in (away + place, away - (1 - place)))
    late = place - (1 - before) / np.maximum(after - before, 1e-9)
    return away + np.where(after > 1, np.clip(late, 0.0, 0.5), 0.0)


def _smooth(block: WaveformBlock, noise: Noise, system: SystemPulse, *, level: float, **_: Any) -> Searched:
    """What most classic detectors search."""
    signal = signal_above(block, noise)
    least = np.float32(level * SMOOTH_GAIN) * noise.std
    return Searched("smoothed [DN]", f"level {level:g} std", smooth_121(signal), least, signal)


@stage("detect", searches=("", _smooth))
def threshold(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *,
    level: Annotated[float, Range(0.1, 1e6)] = 4.0,
    correct_walk: bool = True,
) -> EchoTable:  # fmt: skip
    """One echo per run of smoothed signal above a level, timed at its leading edge.

    The stronger the echo, the earlier its leading edge.

    Parameters
    ----------
    level : float
        Level of the trigger [standard deviations of the smoothed noise].
    correct_walk : bool
        Add the time from the level to the peak of an echo of this amplitude and the system's width; without it, times
        are those of the edge.

    References
    ----------
    Wagner et al. (2007), section 3.
    """
    found = _smooth(block, noise, system, level=level)
    smoothed, s = found.values, len(found.values)
    starts, ends = find_runs(smoothed, found.least)
    waveform = starts // s
    peak = highest_samples(smoothed, starts, ends)
    ref = system.sigma_ref / block.spacing
    amplitude, width, height = _smoothed_height(smoothed, peak, waveform, ref)
    first, trigger = starts - waveform * s, found.least[waveform]
    inside, outside = smoothed[first, waveform], smoothed[np.maximum(first - 1, 0), waveform]
    rise = np.where(first > 0, inside - outside, np.float32(np.inf))
    time = first - (inside - trigger) / rise
    if correct_walk:
        time = np.minimum(time + _time_to_peak(time, height / trigger, ref), ends - waveform * s)
    return candidate_table(block, system, waveform, time, amplitude, width)


@stage("detect", searches=("", _smooth))
def constant_fraction(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *,
    fraction: Annotated[float, Range(0.0, 1.0)] = 0.5,
    level: Annotated[float, Range(0.1, 1e6)] = 4.0,
) -> EchoTable:  # fmt: skip
    """One echo per local maximum, timed where its leading edge reaches a fraction of its height.

    The time does not depend on the amplitude. The time from the edge to the peak of a system pulse is added, so times
    are those of the peak.

    Parameters
    ----------
    fraction : float
        Of the height, above 0 and below 1.
    level : float
        Least height above the baseline [standard deviations of the smoothed noise].

    References
    ----------
    Wagner et al. (2007), section 3.
    """
    if not 0 < fraction < 1:
        raise ConfigError(f"fraction must lie between 0 and 1, got {fraction}")
    found = _smooth(block, noise, system, level=level)
    smoothed, ref = found.values, system.sigma_ref / block.spacing
    waveform, sample = find_peaks(smoothed, found.least)
    amplitude, width, height = _smoothed_height(smoothed, sample, waveform, ref)
    level = np.minimum(fraction * height, 0.999 * smoothed[sample, waveform])
    edge = walk_down(smoothed, waveform, sample, np.full(len(sample), level), -1)
    time = edge + _time_to_peak(edge, np.full(len(edge), 1 / fraction), ref)
    return candidate_table(block, system, waveform, time, amplitude, width)


def _list_samples(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *, level: float, duration: float
) -> Searched:
    signal, rule = signal_above(block, noise), f"runs above {level:g} std for {duration:g} pulses"
    return Searched("above the baseline [DN]", rule, signal, np.float32(level) * noise.std, signal)


@stage("detect", searches=("", _list_samples))
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
    found = _list_samples(block, noise, system, level=level, duration=duration)
    signal, smoothed = found.signal, smooth_121(found.signal)
    ref = system.sigma_ref / block.spacing
    least = max(round(duration * FWHM_PER_SIGMA * ref), 1)
    starts, ends = find_runs(signal, found.least)
    long = ends - starts >= least
    starts, ends = starts[long], ends[long]
    waveform = starts // len(signal)
    peak = highest_samples(smoothed, starts, ends)
    amplitude, time, width = estimate_starts(smoothed, waveform, peak, ref)
    return candidate_table(block, system, waveform, time, amplitude, width)


@stage("detect", searches=("", _smooth))
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
    found = _smooth(block, noise, system, level=level)
    signal, smoothed = found.signal, found.values
    starts, ends = find_runs(smoothed, found.least)
    waveform = starts // len(signal)
    peak = highest_samples(smoothed, starts, ends)
    time, width = run_moments(signal, starts, ends)
    return candidate_table(block, system, waveform, time, smoothed[peak, waveform], width)


def _differentiate(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *, derivative: str, level: float, scale: float
) -> Searched:
    signal, high = signal_above(block, noise), f"where the smoothed signal is above {level:g} std"
    blur = max(scale * system.sigma_ref / block.spacing, LEAST_BLUR)
    if derivative == "first":
        values, least = filters.filter_antisymmetric(signal, filters.slope_taps(blur)), np.full(len(block), np.nan)
        return Searched("derivative [DN/sample]", f"falls through zero {high}", values, least, signal)
    taps = filters.curvature_taps(blur)
    values = filters.filter_symmetric(signal, taps)
    least = np.float32(INFLECTED * np.sqrt(filters.filter_energy(taps))) * noise.std
    return Searched("- second derivative [DN/sample2]", f"middle of two zeros {high}", values, least, signal)


@stage("detect", searches=("derivative", _differentiate))
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
    found = _differentiate(block, noise, system, derivative=derivative, level=level, scale=scale)
    smoothed = smooth_121(found.signal)
    ref = system.sigma_ref / block.spacing
    if derivative == "first":
        # Where the slope goes from positive to zero or below.
        n = found.values.shape[1]
        falling = found.values[:-1] > 0
        falling &= found.values[1:] <= 0
        before_it, waveform = np.divmod(np.flatnonzero(falling), n) if n else (np.empty(0, np.int64),) * 2
        before, after = found.values[before_it, waveform], found.values[before_it + 1, waveform]
        time = before_it + before / (before - after)
        width = np.full(len(time), ref)
    else:
        # The middle of each stretch of positive curvature that exceeds the noise.
        blur = max(scale * ref, LEAST_BLUR)
        waveform, sample = find_peaks(found.values, found.least)
        left, right = (walk_down(found.values, waveform, sample, np.zeros(len(sample)), side) for side in (-1, 1))
        half = 0.5 * (right - left)
        time, width = left + half, np.sqrt(np.maximum(half * half - blur * blur, 0.0))
    sample = np.clip(np.rint(time), 0, len(smoothed) - 1).astype(np.int64)
    amplitude = smoothed[sample, waveform]
    high = amplitude > (level * SMOOTH_GAIN) * noise.std[waveform]
    return candidate_table(block, system, waveform[high], time[high], amplitude[high], width[high])
