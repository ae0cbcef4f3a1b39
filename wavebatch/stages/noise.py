"""Noise stages: baseline and noise of every waveform. The first stage of a chain."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.core.order import known_median, median
from wavebatch.core.units import MEDIAN_ERROR, QUANTISATION_STD
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.library import Samples
from wavebatch.kernels.signal.filters import quiet_levels
from wavebatch.kernels.signal.noise import DRIFT, MOST_CUT, MOST_LEAST, find_levels, floor_response, floor_share
from wavebatch.kernels.signal.runs import find_stretches, list_samples
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, quiet_mean, sum_samples, transpose_samples
from wavebatch.stages.chain import Range, stage
from wavebatch.stages.pulse_tables import clip_level

LEAST_QUIET, LOWEST_TENTH = 6, 1.28
"""Quiet samples from which they give the level of a recording; how far, in standard deviations, the lowest tenth of
normal noise lies below its mean."""

APART, MARGIN = 4.0, 0.5
"""A recording has another level if it differs from its waveform's baseline by APART standard errors and MARGIN
times the noise, as much as the foot of an echo can raise its quiet samples."""

MOST_RECORDINGS = 8
"""Waveforms with more keep one level: sensors join two or three, and each takes as long as a whole waveform."""

FOOT = 2.0
"""Error of a level that only the lowest samples show, over the noise: the foot of an echo may lie there."""


@stage("noise")
def pooled(
    block: WaveformBlock,
    system: SystemPulse,
    *,
    guard: Annotated[float, Range(0.0, 100.0)] = 3.0,
    limit: Annotated[float, Range(0.1, 1e6)] = 3.5,
) -> Noise:
    """Baseline of each waveform from its quiet samples and the strip's baseline; standard deviation of the strip.

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
    std = max(system.noise.std, QUANTISATION_STD)
    reach = int(np.ceil(guard * system.sigma_ref / block.spacing))
    recovery = int(np.ceil(min(system.noise.recovery / block.spacing, block.samples.shape[1])))
    spread, quiet = system.noise.baseline_spread, max(system.noise.quiet, QUANTISATION_STD)
    drifts, least, own = spread > DRIFT * std, np.zeros(1), np.arange(n)
    mean, number = np.zeros(n, np.float32), np.zeros(n, np.int64)
    if not drifts:
        level = np.full(n, system.noise.baseline, np.float32)
        samples = Samples(block.samples, level, np.ones(n, np.float32), block.missing)
        mean, number = quiet_levels(samples, limit * np.hypot(SMOOTH_GAIN * std, spread), reach, recovery)
        if MOST_LEAST < floor_share(system.noise.baseline, quiet) <= MOST_CUT:
            offset, response, _ = floor_response(system.noise.baseline, quiet)
            mean = (mean - offset) / response
        own = np.flatnonzero((number == 0) & (spread > 0))
    if len(own):
        signal = transpose_samples(block.samples[own])
        signal -= np.float32(system.noise.baseline)
        above, used, seen, lowest = find_levels(signal, std, reach, limit, recovery)
        if block.missing is not None:
            used &= ~block.missing[own].T
            above, seen = quiet_mean(signal, used)
        if drifts:
            least = np.where(seen > 0, 0.0, FOOT * std)
            lowest += np.float32(LOWEST_TENTH * std)
            mean, number = np.where(seen > 0, above, lowest), np.maximum(seen, 1)
        else:
            # However far its level is from the strip's: echoes do not make most of a waveform flat, unless clipped.
            recorded = len(signal) if block.missing is None else (~block.missing[own]).sum(axis=1)
            flat = (2 * seen > recorded) & (above + std < clip_level(block, system) - system.noise.baseline)
            mean[own[flat]], number[own[flat]] = above[flat], seen[flat]
    trust = spread**2 / (spread**2 + std**2 / np.maximum(number, 1)) * (number > 0)
    baseline = system.noise.baseline + trust * mean
    error = np.maximum(spread * np.sqrt(1 - trust), least).astype(np.float32) if spread else None
    noise = Noise(baseline.astype(np.float32), np.full(n, std, np.float32), baseline_err=error)
    return noise if block.missing is None else _split_levels(block, noise, system, limit)


def _split_levels(block: WaveformBlock, noise: Noise, system: SystemPulse, limit: float) -> Noise:
    """The noise with another level for each recording that differs from the baseline of its waveform.

    The level of a recording is that of its quiet samples. Where echoes leave fewer than LEAST_QUIET, it is that of its
    lowest samples: a level that is too high loses the foot of an echo, one that is too low makes false echoes.
    """
    row, start, end = find_stretches(~block.gaps)
    number = np.bincount(row, minlength=len(block))[row]
    several = (number > 1) & (number <= MOST_RECORDINGS)
    row, start, end = row[several], start[several], end[several]
    if not len(row):
        return noise
    s, length = block.samples.shape[1], end - start
    # Each recording is repeated up to the length of the waveform, so that quantiles stay what they are.
    place = (row * s + start)[:, None] + np.arange(s, dtype=np.int32) % length.astype(np.int32)[:, None]
    std, reach = float(noise.std[0]), int(np.ceil(system.sigma_ref / block.spacing))
    level, _, number, lowest = find_levels(block.samples.take(place).T, std, reach, limit, counted=length)
    level = np.where(number >= LEAST_QUIET, level, lowest + np.float32(LOWEST_TENTH * std))
    # The mean of correlated samples scatters more than that of as many independent ones.
    spread = std * np.sqrt(max(1.0, 1.0 + 2.0 * float(np.sum(system.noise.correlation))))
    apart = np.abs(level - noise.baseline[row]) > APART * spread / np.sqrt(np.maximum(number, 1)) + MARGIN * std
    if not apart.any():
        return noise
    of_sample = np.repeat(noise.baseline[:, None], s, axis=1)
    run, place = list_samples(*((row * s + edge)[apart] for edge in (start, end)))
    of_sample.reshape(-1)[place] = level[apart][run]
    known = np.where(number >= LEAST_QUIET, spread / np.sqrt(np.maximum(number, 1)), FOOT * std)
    error = np.zeros(len(block), np.float32) if noise.baseline_err is None else noise.baseline_err.copy()
    np.maximum.at(error, row[apart], known[apart].astype(np.float32))
    return replace(noise, of_sample=of_sample, baseline_err=error)


@stage("noise")
def tail(block: WaveformBlock, system: SystemPulse, *, samples: Annotated[int, Range(2, 65_535)] = 16) -> Noise:
    """Baseline and standard deviation of each waveform from its last samples.

    For sensors whose baseline drifts and whose waveforms end without signal. Samples that were not recorded do not
    count. The standard deviation is never less than the strip's.

    Parameters
    ----------
    samples : int
        Number of samples at the end that are taken for noise.
    """
    if samples < 2:
        raise ConfigError(f"samples must be at least 2, got {samples}")
    if block.missing is None:
        end = transpose_samples(block.samples[:, -samples:])
        baseline = median(end, axis=0)
        deviation = end - baseline
        number = np.array(len(end))
        std = np.sqrt(sum_samples(deviation * deviation) / max(len(end) - 1, 1))
    else:
        recorded = ~block.gaps
        behind = np.cumsum(recorded[:, ::-1], axis=1)[:, ::-1]
        end = np.where(recorded & (behind <= samples), block.samples, np.float32(np.nan)).T.astype(np.float32)
        number = np.isfinite(end).sum(axis=0)
        end[:, number == 0] = block.samples[number == 0].T
        baseline = known_median(end, 0)
        deviation = np.nan_to_num(end - baseline)
        std = np.sqrt(sum_samples(deviation * deviation) / np.maximum(number - 1, 1))
    std = np.maximum(std, max(system.noise.std, QUANTISATION_STD)).astype(np.float32)
    error = MEDIAN_ERROR * std / np.sqrt(np.maximum(number, 1))
    return Noise(baseline.astype(np.float32), std, baseline_err=error.astype(np.float32))
