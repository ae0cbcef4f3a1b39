"""The classic detectors of Wagner et al. (2007) that users ask for: leading edge, constant fraction.

Their other ones are a plug-in, examples/papers/paper_stages.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import exp, log
from wavebatch.kernels.fit.closed_form import estimate_starts
from wavebatch.kernels.signal.runs import find_runs, highest_samples, walk_down
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, find_peaks, smooth_121
from wavebatch.stages.chain import Range, stage
from wavebatch.stages.detect.candidates import candidate_table, signal_above


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


@stage("detect")
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
    smoothed = smooth_121(signal_above(block, noise))
    s = len(smoothed)
    limit = np.float32(level * SMOOTH_GAIN) * noise.std
    starts, ends = find_runs(smoothed, limit)
    waveform = starts // s
    peak = highest_samples(smoothed, starts, ends)
    ref = system.sigma_ref / block.spacing
    amplitude, width, height = _smoothed_height(smoothed, peak, waveform, ref)
    first, trigger = starts - waveform * s, limit[waveform]
    inside, outside = smoothed[first, waveform], smoothed[np.maximum(first - 1, 0), waveform]
    rise = np.where(first > 0, inside - outside, np.float32(np.inf))
    time = first - (inside - trigger) / rise
    if correct_walk:
        time = np.minimum(time + _time_to_peak(time, height / trigger, ref), ends - waveform * s)
    return candidate_table(block, system, waveform, time, amplitude, width)


@stage("detect")
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
    smoothed = smooth_121(signal_above(block, noise))
    ref = system.sigma_ref / block.spacing
    waveform, sample = find_peaks(smoothed, np.float32(level * SMOOTH_GAIN) * noise.std)
    amplitude, width, height = _smoothed_height(smoothed, sample, waveform, ref)
    level = np.minimum(fraction * height, 0.999 * smoothed[sample, waveform])
    edge = walk_down(smoothed, waveform, sample, level, -1)
    time = edge + _time_to_peak(edge, np.full(len(edge), 1 / fraction), ref)
    return candidate_table(block, system, waveform, time, amplitude, width)
