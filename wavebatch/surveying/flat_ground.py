"""The width of echoes from level ground: the reference against which widths of slopes are compared.

A survey takes the narrowest echoes for those of level ground seen from above. Few are: across a swath, rays hit level
ground at up to half the field of view. A reference that is 1 % too wide turns 5 degrees into 2. Where the sensor's
position and the divergence are known, the broadening by each ray's angle is removed first (docs/algorithms.md 1.4).
`angle_limits` calls it.
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
from wavebatch.surveying.measure import ENOUGH_TO_LEARN, MIN_SNR, decompose_sample

ROUNDS = 10
"""Steps from the mode of the variances to the mean around it."""


def measure_level(blocks: Iterable[WaveformBlock], system: SystemPulse, spacing: float) -> SystemPulse:
    """Measure variance and scatter of the widths of level ground seen from above.

    Parameters
    ----------
    blocks : iterable of WaveformBlock
        Sampled over the strip, with the sensor's positions; blocks of another spacing are left out.
    system : SystemPulse
        With the beam's divergence.
    spacing : float
        Of the samples that are used [ns].

    Returns
    -------
    SystemPulse
        With `level_variance` and `width_scatter`; unchanged where the divergence is unknown or fewer than 50 clean
        echoes are found.
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
    # The survey's pulse may include slopes, so the true one can be narrower, but never wider.
    level = min(_find_level(variance, error), 0.0)
    below = variance < level
    ratio = np.median(((level - variance[below]) / error[below]) ** 2) / SQUARED_NORMAL_MEDIAN if below.any() else 1.0
    excess = np.median(error[below] ** 2) * max(float(ratio) - 1.0, 0.0) if below.any() else 0.0
    scatter = float(np.sqrt(excess) / (2.0 * system.sigma_ref))
    return replace(system, level_variance=level, width_scatter=scatter)


def _find_level(variance: np.ndarray, error: np.ndarray) -> float:
    """The mode of variances (n,), then the weighted mean of those within two errors of it, until it stays."""
    level = _find_mode(variance)
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


def _find_mode(values: np.ndarray) -> float:
    """Centre of the shortest interval that holds a third of the values, which slopes and plants do not move."""
    ordered = np.sort(values.astype(np.float64))
    hold = max(len(ordered) // 3, 2)
    span = ordered[hold - 1 :] - ordered[: len(ordered) - hold + 1]
    first = int(np.argmin(span))
    return float(np.median(ordered[first : first + hold]))
