"""How wide level ground's echoes are, from rays whose angle is known: what widths of slopes are held against.

A survey takes the narrowest echoes for those of level ground seen from above. Few are: across a swath rays strike level
ground at up to half the field of view, and a reference that is 1 % too wide turns 5 degrees into 2. Where sensor and
divergence are known, what each ray's own angle widens is taken off first (ALGORITHMS 1.4: the nadir flat mode).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import UNCLEAN
from wavebatch.core.units import SQUARED_NORMAL_MEDIAN
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.physics.incidence import spread_of_angle
from wavebatch.stages.attribute.radiometry import is_alone, level_angle
from wavebatch.stages.attribute.width_angle import added_variance
from wavebatch.surveying.measure import ENOUGH_TO_LEARN, MIN_SNR, decompose_sample, find_mode

ROUNDS = 10
"""Steps from the mode of the variances to the mean around it."""


def measure_level(blocks: Iterable[WaveformBlock], system: SystemPulse, spacing: float) -> SystemPulse:
    """The system with the variance of level ground's echoes, and the scatter of widths, seen from above.

    blocks: with the sensor's positions, sampled over the strip; those of another spacing [ns] are left out. The system
    as it is where its divergence is not known or fewer than 50 clean echoes are found.
    """
    parts = [
        _measure(block, system)
        for block in blocks
        if block.sensor is not None and block.spacing == spacing and block.digitizer.index not in system.digitizers
    ]
    if system.divergence is None or not parts:
        return system
    variance, error = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    if len(variance) < ENOUGH_TO_LEARN:
        return system
    # The survey's pulse may hold slopes, but no echo is narrower than the true one.
    level = min(_find_level(variance, error), 0.0)
    below = variance < level
    ratio = np.median(((level - variance[below]) / error[below]) ** 2) / SQUARED_NORMAL_MEDIAN if below.any() else 1.0
    excess = np.median(error[below] ** 2) * max(float(ratio) - 1.0, 0.0) if below.any() else 0.0
    scatter = float(np.sqrt(excess) / (2.0 * system.sigma_ref))
    return replace(system, level_variance=level, width_scatter=scatter)


def _find_level(variance: np.ndarray, error: np.ndarray) -> float:
    """The mode of variances (n,), then the weighted mean of those within two errors of it, until it stays."""
    level = find_mode(variance)
    for _ in range(ROUNDS):
        near = np.abs(variance - level) < 2.0 * error
        if np.count_nonzero(near) < ENOUGH_TO_LEARN:
            break
        weight = error[near] ** -2.0
        level = float((weight * variance[near]).sum() / weight.sum())
    return level


def _measure(block: WaveformBlock, system: SystemPulse) -> tuple[np.ndarray, np.ndarray]:
    """Variance beyond the system's and beyond what level ground adds [ns2], and its error, of clean echoes."""
    system = replace(system, level_variance=0.0, width_scatter=0.0)
    echoes = decompose_sample(block, system)
    clean = is_alone(block, echoes) & (echoes.amplitude > MIN_SNR * system.noise_std)
    echoes = echoes.take(np.flatnonzero(clean & ((echoes.flags & np.uint16(UNCLEAN)) == 0)))
    variance, error = added_variance(block, system, echoes, "system", 0.0)
    row = echoes.waveform
    off = block.origin[row] + block.direction[row] * echoes.time[:, None] - block.sensor[row]
    distance = np.sqrt((off * off).sum(axis=1))
    divergence = np.nan if system.divergence is None else 1e-3 * system.divergence
    level = spread_of_angle(level_angle(block)[row], distance, divergence)
    known = np.isfinite(variance) & np.isfinite(level) & (error > 0)
    return (variance - level * level)[known], error[known]
