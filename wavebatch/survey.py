"""What sensor and scene are: noise, baseline, width of the system pulse, saturation, from a sample of the strip."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from wavebatch.blocks import EchoFlag, EchoTable, Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.noise import PooledNoise, estimate_noise
from wavebatch.kernels.signal import transpose_samples
from wavebatch.stages.decompose import closed_form
from wavebatch.stages.detect import maximum
from wavebatch.units import QUANTISATION_STD

SAMPLE = 8192
"""Waveforms that a survey looks at."""

FEW = 20
"""Isolated echoes below which the width of the system pulse is a guess."""

FIRST_WIDTH = 2.0
"""First guess of the system pulse's width [samples]."""


def measure(blocks: Iterable[WaveformBlock]) -> SystemPulse:
    """The strip's system pulse from blocks sampled over it; the largest group of one spacing and length decides."""
    groups: dict[tuple[float, int], list[WaveformBlock]] = {}
    for block in blocks:
        if len(block):
            groups.setdefault((block.spacing, block.samples.shape[1]), []).append(block)
    if not groups:
        return SystemPulse(sigma_ref=FIRST_WIDTH)
    chosen = max(groups.values(), key=lambda group: (sum(block.samples.size for block in group), group[0].spacing))
    samples = np.concatenate([block.samples for block in chosen])
    block = WaveformBlock.from_samples(samples, spacing=chosen[0].spacing, bits=chosen[0].digitizer.bits)
    return measure_block(block)


def measure_block(block: WaveformBlock) -> SystemPulse:
    """The system pulse from one block of waveforms: noise, then widths of isolated echoes, twice."""
    saturation = find_saturation(block.samples, block.digitizer.max_count)
    width = FIRST_WIDTH
    system = SystemPulse(sigma_ref=width * block.spacing)
    for _ in range(3):
        pooled = estimate_noise(transpose_samples(block.samples), int(np.ceil(3 * width)))
        system = _system(block, pooled, width, saturation)
        found = _isolated_widths(block, system)
        if len(found) < FEW:
            break
        width = float(np.clip(_mode_of_narrow(found), 0.5, 50.0))
    return _system(block, pooled, width, saturation)


def _system(block: WaveformBlock, pooled: PooledNoise, width: float, saturation: float | None) -> SystemPulse:
    std = max(pooled.std, pooled.smoothed_std, QUANTISATION_STD)
    return SystemPulse(
        sigma_ref=width * block.spacing,
        baseline=pooled.level,
        baseline_spread=pooled.spread,
        noise_std=std,
        noise_by_kind={"quiet": pooled.std, "quiet smoothed": pooled.smoothed_std},
        saturation=saturation,
    )


def _isolated_widths(block: WaveformBlock, system: SystemPulse) -> np.ndarray:
    """Widths [samples] of clean echoes that are alone in their waveform, SNR above 20, not near an edge or clipped."""
    n = len(block)
    noise = Noise(np.full(n, system.baseline, np.float32), np.full(n, system.noise_std, np.float32))
    echoes: EchoTable = closed_form(block, noise, system, maximum(block, noise, system), steps=4)
    alone = echoes.count(n)[echoes.waveform] == 1
    bad = EchoFlag.NEAR_EDGE | EchoFlag.SATURATED | EchoFlag.AT_BOUND
    good = alone & (echoes.amplitude > 20 * system.noise_std) & ((echoes.flags & int(bad)) == 0)
    return echoes.sigma[good] / block.spacing


def _mode_of_narrow(widths: np.ndarray) -> float:
    """Width of the system pulse: centre of the shortest interval that holds a third of the widths.

    Flat targets give the system width again and again, slopes and vegetation scatter above it; a mode is not moved by
    them, as a median would be.
    """
    ordered = np.sort(widths.astype(np.float64))
    hold = max(len(ordered) // 3, 2)
    span = ordered[hold - 1 :] - ordered[: len(ordered) - hold + 1]
    first = int(np.argmin(span))
    return float(np.median(ordered[first : first + hold]))


def find_saturation(samples: np.ndarray, max_count: int) -> float | None:
    """Count at which the digitizer clips: its maximum, or a maximum that many waveforms share on flat tops (H6)."""
    top = int(samples.max(initial=0))
    if top == 0:
        return None
    at_top = samples == top
    flat = (at_top[:, 1:] & at_top[:, :-1]).any(axis=1)
    if top == max_count:
        return float(top)
    reached = at_top.any(axis=1).sum()
    return float(top) if flat.sum() >= max(3, 0.5 * reached) and reached >= 5 else None
