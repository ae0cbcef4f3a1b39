"""What the pulse's model leaves unexplained of strong single echoes, at the echo and in its tail.

Growth and detection ask more of an echo beside a strong one by these figures (docs/algorithms.md R3, R5).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.signal.filters import filter_energy, filter_symmetric, gaussian_taps
from wavebatch.stages.decompose.fit import adaptive
from wavebatch.stages.noise import pooled as pooled_noise
from wavebatch.surveying.measuring.lone_echoes import MIN_SNR, find_strongest
from wavebatch.surveying.measuring.noise_and_width import ENOUGH_TO_LEARN, FEW
from wavebatch.surveying.measuring.residuals import subtract_echoes

CLIPPED = 0.1
"""Share of clipped waveforms from which the bound is what a Gaussian leaves in common, and no learned pulse can exceed:
what is clipped misses the pulse by more than the rest."""

NORMAL_BELOW = 0.0228, 0.1587
"""Shares of normal values that lie two standard deviations, and one, or more below their mean."""

TAIL_BEFORE, TAIL_AFTER = 15, 40
"""Widths of the pulse before and after an echo in which its tail is measured."""

BESIDE, NOT_ABSORBED = 10, 3
"""Widths of the pulse beside an echo up to which what is left is measured, and from which."""

MOSTLY_FREE = 0.25
"""Share of the samples at a distance that must be free of other echoes: the few that are beside many hold echoes that
were not found."""

ONE_SIGMA = 0.6827
"""Share of normal values within one standard deviation."""

CONSTANT = 2.0
"""What comes before or after a pulse belongs to it where its mean share is so many times its scatter: else it is
neighbours, too weak to be found or taken for a part of the pulse."""

LEAST_TAIL = 0.002
"""Share of an echo below which its tail is as the pulse says."""


def measure_tail(block: WaveformBlock, system: SystemPulse, strong: EchoTable) -> SystemPulse:
    """The system with what its pulse leaves before and after strong single echoes: `tail_misfit`, as shares of them."""
    if len(strong) < FEW:
        return system
    rows = np.arange(len(strong), dtype=np.int32)
    part = block.rows(strong.waveform)
    noise = pooled_noise(part, system)
    fitted = adaptive(part, noise, system, replace(strong, waveform=rows), max_echoes=1, significance=0.0)
    fitted = fitted.take(find_strongest(fitted, len(part))[0])
    return replace(system, tail_misfit=_measure_tail(part, system, fitted))


def measure_beside(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> SystemPulse:
    """The system with what fits leave beside strong echoes: of their pulse, and of targets too weak to be found.

    Parameters
    ----------
    block : WaveformBlock
    system : SystemPulse
    echoes : EchoTable
        The block decomposed with it.

    Returns
    -------
    SystemPulse
        `beside`: by lag, the variance of a pulse's amplitude there beyond that of noise, over that of noise.

    Notes
    -----
    Around the strongest echo of each waveform, where no other echo was found (docs/algorithms.md R3). Nearer than
    NOT_ABSORBED its own fit takes what is left.
    """
    strongest, _ = find_strongest(echoes, len(block))
    strong = echoes.take(strongest[echoes.amplitude[strongest] > MIN_SNR * system.noise.std])
    if len(strong) < FEW:
        return system
    ref = system.sigma_ref / block.spacing
    taps = gaussian_taps(ref)
    left = np.nan_to_num(subtract_echoes(block, system, echoes))[strong.waveform]
    seen = filter_symmetric(left.T, taps).T / (np.sqrt(filter_energy(taps)) * system.noise.std)
    lag = (np.arange(left.shape[1]) - (strong.time / block.spacing)[:, None]) / ref
    free = np.ones(lag.shape, bool)
    owner = np.full(len(block), -1)
    owner[strong.waveform] = np.arange(len(strong))
    others = echoes.take(np.flatnonzero((owner[echoes.waveform] >= 0) & ~np.isin(np.arange(len(echoes)), strongest)))
    for row, time in zip(owner[others.waveform], others.time / block.spacing, strict=True):
        free[row, max(int(time - NOT_ABSORBED * ref), 0) : int(time + NOT_ABSORBED * ref) + 2] = False
    profile = []
    for place in range(-BESIDE, BESIDE + 1):
        near = (lag >= place - 0.5) & (lag < place + 0.5)
        here = np.abs(seen[free & near])
        if abs(place) >= NOT_ABSORBED and len(here) >= max(ENOUGH_TO_LEARN, MOSTLY_FREE * np.count_nonzero(near)):
            variance = float(np.quantile(here, ONE_SIGMA)) ** 2 - 1
            profile.append((float(place * system.sigma_ref), max(variance, 0.0)))
    return replace(system, beside=tuple(profile))


def _measure_tail(part: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> tuple[tuple[float, float], ...]:
    """(lag [ns], share) where strong echoes leave more than noise, in steps of the pulse's width."""
    ref = system.sigma_ref / part.spacing
    taps = gaussian_taps(ref)
    energy = filter_energy(taps)
    residual = subtract_echoes(part, system, echoes)[echoes.waveform]
    left = filter_symmetric(np.nan_to_num(residual).T.astype(np.float32), taps).T / np.float32(energy)
    left /= echoes.amplitude[:, None]
    lag = (np.arange(residual.shape[1]) - (echoes.time / part.spacing)[:, None]) / ref
    expected = system.noise.std / np.median(echoes.amplitude) / np.sqrt(energy)
    profile = []
    for place in range(-TAIL_BEFORE, TAIL_AFTER):
        here = left[(lag >= place - 0.5) & (lag < place + 0.5) & np.isfinite(residual)]
        if abs(place) < 3 or len(here) < ENOUGH_TO_LEARN:
            continue
        # Other targets only add, and in a canopy most waveforms have some: what the lowest echoes show is the tail.
        lowest, low = np.quantile(here, NORMAL_BELOW)
        spread = max(low - lowest, expected)
        common, scatter = abs(low + spread), 2 * np.sqrt(spread**2 - expected**2)
        share = common + scatter
        if share > LEAST_TAIL and common > CONSTANT * scatter:
            profile.append((float(place * system.sigma_ref), float(share)))
    return tuple(profile)
