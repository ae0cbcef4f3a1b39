"""Noise stages: baseline and noise of every waveform. The first stage of a chain."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.core.units import QUANTISATION_STD
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.signal.noise import DRIFT, find_levels
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, find_quiet, quiet_mean, sum_samples, transpose_samples
from wavebatch.stages.chain import Range, stage


@stage("noise")
def pooled(
    block: WaveformBlock,
    system: SystemPulse,
    *,
    guard: Annotated[float, Range(0.0, 100.0)] = 3.0,
    limit: Annotated[float, Range(0.1, 1e6)] = 3.5,
) -> Noise:
    """Baseline of each waveform from its quiet samples, drawn towards the strip's; standard deviation of the strip.

    The standard deviation is that of all quiet samples of the strip, from its survey: a single waveform, rounded to
    whole counts, is too short to estimate it. The baseline is the best linear estimate from two values: the mean of the
    waveform's quiet samples, and the strip's baseline. The more baselines scatter between waveforms, the more weight
    the first has. Where they scatter by more than the noise, the quiet samples are found from each waveform alone.

    Parameters
    ----------
    guard : float
        Samples this close to a signal are not quiet [widths of the system pulse].
    limit : float
        A smoothed sample that differs from the strip's baseline by more than this is signal [noise standard
        deviations].

    References
    ----------
    docs/algorithms.md H10.
    """
    n = len(block)
    std = max(system.noise_std, QUANTISATION_STD)
    signal = transpose_samples(block.samples)
    signal -= np.float32(system.baseline)
    reach = int(np.ceil(guard * system.sigma_ref / block.spacing))
    recovery = int(np.ceil(min(system.recovery / block.spacing, signal.shape[0])))
    spread = system.baseline_spread
    if spread > DRIFT * std:
        mean, quiet, number = find_levels(signal, std, reach, limit, recovery)
        if block.missing is not None:
            quiet &= ~block.missing.T
            mean, number = quiet_mean(signal, quiet)
    else:
        quiet = find_quiet(signal, np.float32(limit * np.hypot(SMOOTH_GAIN * std, spread)), reach, recovery)
        if block.missing is not None:
            quiet &= ~block.missing.T
        mean, number = quiet_mean(signal, quiet)
    trust = spread**2 / (spread**2 + std**2 / np.maximum(number, 1)) * (number > 0)
    baseline = system.baseline + trust * mean
    return Noise(baseline.astype(np.float32), np.full(n, std, np.float32))


@stage("noise")
def tail(block: WaveformBlock, system: SystemPulse, *, samples: Annotated[int, Range(2, 65_535)] = 16) -> Noise:
    """Baseline and standard deviation of each waveform from its last samples.

    For sensors whose baseline drifts and whose waveforms end without signal. The standard deviation is never less than
    the strip's.

    Parameters
    ----------
    samples : int
        Number of samples at the end that are taken for noise.
    """
    if samples < 2:
        raise ConfigError(f"samples must be at least 2, got {samples}")
    end = transpose_samples(block.samples[:, -samples:])
    baseline = np.median(end, axis=0)
    deviation = end - baseline
    std = np.sqrt(sum_samples(deviation * deviation) / max(len(end) - 1, 1))
    return Noise(
        baseline.astype(np.float32), np.maximum(std, max(system.noise_std, QUANTISATION_STD)).astype(np.float32)
    )
