"""Spikes, patterns of the converter, transients, slopes and seams: which a strip has, and how they are removed.

The survey measures them after its first look at noise and width; `Chain.run` and the survey clean every block before
anything else. A defect counts only if chance cannot explain it, so waveforms of other strips stay unchanged. Cleaned
samples are float32, so that a block that was cleaned is known by its samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from wavebatch.core.order import median, quantiles
from wavebatch.core.waveforms import Defects, SystemPulse, WaveformBlock
from wavebatch.kernels.signal.defects import fill_spikes, find_pattern, find_spikes, find_transient, fit_slopes
from wavebatch.kernels.signal.noise import DRIFT, find_levels
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, find_quiet, transpose_samples
from wavebatch.stages.pulse_tables import clip_level, floor_level

GUARD = 3.0
"""Samples this close to a signal do not show the slope of the baseline [widths of the system pulse]."""


LEAST_SPIKES = 0.003
"""Spikes per waveform from which they are taken off."""

NARROWEST = 1.2
"""Width of the system pulse [samples] from which a spike cannot be an echo, whose neighbours are seven tenths of it."""

PATTERN, CERTAIN = 0.05, 6.0
"""Offset of a pattern that matters [DN, or noise of a sample], and its standard errors."""

SLOPES, STEEP = 0.02, 5.0
"""Share of the waveforms whose slope must exceed this many of its errors for slopes to be taken off ..."""

LEAST_RISE = 0.5
"""... and standard deviation of the baseline's rise over half of a waveform [noise of a sample]."""

LEAST_WAVEFORMS, MOST_WAVEFORMS = 50, 1024
"""Waveforms from which defects are looked for, and how many are looked at."""

SHORTEST = 24
"""Samples of a waveform from which defects are looked for."""


def clean_block(block: WaveformBlock, system: SystemPulse) -> WaveformBlock:
    """Return the block without the strip's pattern, slopes, spikes, transients and seams.

    Parameters
    ----------
    block : WaveformBlock
        Raw counts; a block that was cleaned stays as it is.
    system : SystemPulse
        With the defects that the survey found.

    Returns
    -------
    WaveformBlock
        With float32 samples; clipped ones keep their count. Transients and seams are marked as missing; a block with a
        seam and no other defect keeps its counts.

    References
    ----------
    docs/algorithms.md H17.
    """
    if block.samples.dtype.kind == "f":
        return block
    block = mark_seam(block, system.seams)
    defects = system.defects
    if not defects:
        return block
    raw = transpose_samples(block.samples)
    signal = raw.copy()
    if defects.pattern:
        offsets = np.array(defects.pattern, np.float32)
        signal -= offsets[np.arange(len(signal)) % len(offsets)][:, None]
    missing = None if block.missing is None else block.missing.T
    if defects.slope_spread > 0:
        # The sloping part of each baseline, 0 in its middle: own slopes, drawn towards none by their errors.
        reach = int(np.ceil(GUARD * system.sigma_ref / block.spacing))
        recovery = int(np.ceil(system.noise.recovery / block.spacing))
        slope, error = fit_slopes(signal, system.noise.quiet, reach, missing=missing, recovery=recovery)
        spread = system.defects.slope_spread * block.spacing
        slope = np.where(np.isfinite(error), slope * spread**2 / (spread**2 + np.minimum(error, 1e6) ** 2), 0.0)
        x = np.arange(len(signal), dtype=np.float32) - np.float32(0.5 * (len(signal) - 1))
        signal -= x[:, None] * slope.astype(np.float32)
    if defects.spikes > 0:
        level = median(signal, axis=0) if defects.slope_spread > 0 else np.float32(system.noise.baseline)
        fill_spikes(signal, find_spikes(signal - level, system.noise.quiet, system.sigma_ref / block.spacing))
    clipped = (raw >= clip_level(block, system)) | (raw <= floor_level(system))
    np.copyto(signal, raw, where=clipped)
    samples = np.ascontiguousarray(signal.T)
    samples.flags.writeable = False
    lost = round(defects.transient / block.spacing)
    if lost:
        gone = np.zeros(samples.shape, bool) if block.missing is None else block.missing.copy()
        gone[:, :lost] = True
        return replace(block, samples=samples, missing=gone)
    return replace(block, samples=samples)


def mark_seam(block: WaveformBlock, seams: Mapping[int, int]) -> WaveformBlock:
    """Mark the interpolated sample of a block's seam as missing; it keeps its count, by which echoes are looked for.

    All others were recorded. Where time is lost between both recordings a fit across them misses its samples, and its
    errors say so; echoes this near to a gap are flagged.

    Parameters
    ----------
    block : WaveformBlock
        Raw counts.
    seams : mapping
        Sample of the seam by the number of samples of a packet.
    """
    at = seams.get(block.digitizer.n_samples, 0)
    if not 0 < at < block.samples.shape[1] - 1:
        return block
    missing = np.zeros(block.samples.shape, bool) if block.missing is None else block.missing.copy()
    missing[:, at] = True
    return replace(block, missing=missing)


def measure_defects(block: WaveformBlock, system: SystemPulse) -> SystemPulse:
    """Return the system with the defects of its waveforms.

    Parameters
    ----------
    block : WaveformBlock
        Raw waveforms of one digitizer.
    system : SystemPulse
        Noise and width as measured so far.

    References
    ----------
    docs/algorithms.md H17.
    """
    if len(block) < LEAST_WAVEFORMS or block.samples.shape[1] < SHORTEST:
        return system
    block = block.rows(slice(None, None, max(len(block) // MOST_WAVEFORMS, 1)))
    signal = transpose_samples(block.samples)
    missing = None if block.missing is None else block.missing.T
    std, width = system.noise.quiet, system.sigma_ref / block.spacing
    reach = int(np.ceil(3 * width))
    # Slopes come from runs of samples much longer than the noise is correlated.
    colour = float(np.sqrt(max(1.0 + 2.0 * sum(system.noise.correlation), 1.0)))
    recovery = int(np.ceil(system.noise.recovery / block.spacing))
    spread, defects = _slope_spread(signal, std, colour, reach, missing, recovery), Defects()
    if spread:
        # Everything else is measured about level baselines.
        defects = Defects(slope_spread=spread / block.spacing)
        signal = clean_block(block, replace(system, defects=defects)).samples.T
        level = median(signal, axis=0)
    elif system.noise.baseline_spread > DRIFT * std:
        level = find_levels(signal, std, reach).level
    else:
        level = np.float32(system.noise.baseline)
    above = signal - level
    if missing is not None:
        above[missing] = 0
    quiet = find_quiet(above, np.float32(3.5 * np.hypot(SMOOTH_GAIN * std, system.noise.baseline_spread) + 0.25), reach)
    if missing is not None:
        quiet &= ~missing
    offsets, error = find_pattern(signal, quiet)
    if np.abs(offsets).max() > max(PATTERN * max(std, 1.0), CERTAIN * error.max()):
        defects = replace(defects, pattern=tuple(offsets.tolist()))
    if width >= NARROWEST:
        spikes = np.count_nonzero(find_spikes(above, std, width)) / len(block)
        defects = replace(defects, spikes=spikes if spikes > LEAST_SPIKES else 0.0)
    defects = replace(defects, transient=find_transient(above, std) * block.spacing)
    return replace(system, defects=defects)


RARER = 0.1
"""Share of the steep slopes that must be of the rarer sign: tails, and weak echoes after the last clear one, slope one
way."""


def _slope_spread(
    signal: np.ndarray, std: float, colour: float, reach: int, missing: np.ndarray | None, recovery: int
) -> float:
    """Standard deviation of the slopes of baselines [DN per sample]; 0 where chance or signal explains them.

    colour: errors of slopes over those in white noise.
    """
    slope, error = fit_slopes(signal, std, reach, missing=missing, recovery=recovery)
    error = colour * error
    known = np.isfinite(error)
    if np.count_nonzero(known) < LEAST_WAVEFORMS:
        return 0.0
    slope, error = slope[known], error[known]
    share = np.mean(np.abs(slope) > STEEP * error)
    if min(np.mean(slope > STEEP * error), np.mean(slope < -STEEP * error)) < RARER * share:
        return 0.0
    low, middle, high = quantiles(slope, [0.1587, 0.5, 0.8413])
    excess = max(0.25 * (high - low) ** 2 + middle**2 - median(error) ** 2, 0.0)
    few = np.mean(slope**2) if share < 0.3 else 0.0
    spread = float(np.sqrt(max(excess, few - median(error) ** 2)))
    return spread if share > SLOPES and spread * 0.5 * len(signal) > LEAST_RISE * std else 0.0
