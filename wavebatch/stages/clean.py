"""Takes off what the receiver adds to the waveforms of a strip, where its survey found such defects.

`Chain.run` and the survey call it before anything else. Waveforms of other strips pass through untouched. Cleaned
samples are float32, so that a block that was cleaned is known by its samples.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.signal.defects import fill_spikes, find_spikes, fit_slopes
from wavebatch.kernels.signal.signal import transpose_samples
from wavebatch.stages.pulse_tables import clip_level

GUARD = 3.0
"""Samples this close to a signal do not show the slope of the baseline [widths of the system pulse]."""


def clean_block(block: WaveformBlock, system: SystemPulse) -> WaveformBlock:
    """Return the block without the strip's pattern, slopes, spikes and transients.

    Parameters
    ----------
    block : WaveformBlock
        Raw counts; a block that was cleaned stays as it is.
    system : SystemPulse
        With the defects that the survey found.

    Returns
    -------
    WaveformBlock
        With float32 samples; clipped ones keep their count. Transients are marked as missing.

    References
    ----------
    docs/algorithms.md H17.
    """
    if not system.has_defects or block.samples.dtype.kind == "f":
        return block
    raw = transpose_samples(block.samples)
    signal = raw.copy()
    if system.pattern:
        offsets = np.array(system.pattern, np.float32)
        signal -= offsets[np.arange(len(signal)) % len(offsets)][:, None]
    missing = None if block.missing is None else block.missing.T
    if system.slope_spread > 0:
        signal -= _slopes(signal, system, block.spacing, missing)
    if system.spikes > 0:
        level = np.median(signal, axis=0) if system.slope_spread > 0 else np.float32(system.baseline)
        fill_spikes(signal, find_spikes(signal - level, sample_noise(system), system.sigma_ref / block.spacing))
    clipped = raw >= clip_level(block, system)
    np.copyto(signal, raw, where=clipped)
    samples = np.ascontiguousarray(signal.T)
    samples.flags.writeable = False
    lost = round(system.transient / block.spacing)
    if lost:
        gone = np.zeros(samples.shape, bool) if block.missing is None else block.missing.copy()
        gone[:, :lost] = True
        return replace(block, samples=samples, missing=gone)
    return replace(block, samples=samples)


def sample_noise(system: SystemPulse) -> float:
    """Return the noise of a quiet sample: `noise_std` is larger where noise is coloured."""
    return min(system.noise_std, system.noise_by_kind.get("quiet") or system.noise_std)


def _slopes(signal: np.ndarray, system: SystemPulse, spacing: float, missing: np.ndarray | None) -> np.ndarray:
    """The sloping part of each baseline (s, n), 0 in its middle: own slopes, drawn towards none by their errors."""
    reach = int(np.ceil(GUARD * system.sigma_ref / spacing))
    slope, error = fit_slopes(signal, sample_noise(system), reach, missing=missing)
    spread = system.slope_spread * spacing
    slope = np.where(np.isfinite(error), slope * spread**2 / (spread**2 + np.minimum(error, 1e6) ** 2), 0.0)
    x = np.arange(len(signal), dtype=np.float32) - np.float32(0.5 * (len(signal) - 1))
    return x[:, None] * slope.astype(np.float32)
