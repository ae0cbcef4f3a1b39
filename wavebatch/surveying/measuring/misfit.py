"""What the pulse's model leaves unexplained of strong single echoes, at the echo and in its tail.

Growth and detection ask more of an echo beside a strong one by these figures (docs/algorithms.md R3, R5).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import MEDIAN_ERROR, SQRT_PI
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.cluster import Candidates, Clusters
from wavebatch.kernels.fit.decompose import promise_echoes
from wavebatch.kernels.fit.problem import Settings
from wavebatch.kernels.library import Samples
from wavebatch.kernels.signal.filters import filter_energy, filter_symmetric, gaussian_taps
from wavebatch.stages.decompose.fit import adaptive
from wavebatch.stages.detect.candidates import samples_of
from wavebatch.stages.noise import pooled as pooled_noise
from wavebatch.stages.pulse_tables import (
    clip_level,
    fit_misfit,
    model_parameters,
    noise_filter,
    pulse_shape,
    shape_limits,
)
from wavebatch.surveying.measuring.lone_echoes import MIN_SNR, find_strongest
from wavebatch.surveying.measuring.noise_and_width import ENOUGH_TO_LEARN, FEW
from wavebatch.surveying.measuring.residuals import find_common, render_own, subtract_echoes

MISFIT_QUANTILE = 0.8
"""Share of the strong single echoes that the pulse's misfit explains; the others may hold a second target."""

SCATTERED = 1.4
"""The strongest echoes miss the pulse by so much more than those at the quantile: receivers compress the highest."""

COMMON_QUANTILE = 0.95
"""The same share of what echoes of about one height have in common: the strongest miss the pulse most."""

CLIPPED = 0.1
"""Share of clipped waveforms from which the bound is what a Gaussian leaves in common, and no learned pulse can exceed:
what is clipped misses the pulse by more than the rest."""

NOISE_PROMISE = 8.0
"""Fall of chi2 that noise alone promises: the best of some twenty places, exceeded by a fifth of right fits."""

NORMAL_BELOW = 0.0228, 0.1587
"""Shares of normal values that lie two standard deviations, and one, or more below their mean."""

CORE_REACH = 4.0
"""Widths of the pulse around an echo in which its misfit is looked for; beyond them it is the tail's."""

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


def measure_misfit(
    block: WaveformBlock, system: SystemPulse, strong: EchoTable, *, bounded: bool = True, reach: float = CORE_REACH
) -> SystemPulse:
    """The system with what its pulse leaves unexplained of strong single echoes, as shares of their amplitude.

    Parameters
    ----------
    block : WaveformBlock
    system : SystemPulse
        Its misfit is the least: 0, or that of a known sensor.
    strong : EchoTable
        The strongest single echoes that no target has widened, one per waveform.
    bounded : bool
        The misfit is at most what the echoes have in common.
    reach : float
        How far from an echo its misfit is looked for [widths of the pulse].

    Returns
    -------
    SystemPulse
        `misfit`: an echo that is added to a strong one must explain more than this share of its energy.
        `tail_misfit`: by lag, the share of a strong echo that is left before and after it.

    Notes
    -----
    Each strong echo is fitted alone; a score test says how much chi2 one more echo would gain. A wrong pulse promises
    the same share of the energy for all of them, a second target for a few: the share that MISFIT_QUANTILE of them
    stay below is the pulse's. In a canopy most of them have a second target, but at another lag in every waveform. So
    the misfit is at most what echoes of about one height leave in common at every lag. Receivers compress high
    amplitudes, so that echoes of middle strength fit better than strong ones (docs/algorithms.md R3, R5).
    """
    if len(strong) < FEW:
        return system
    rows = np.arange(len(strong), dtype=np.int32)
    part = block.rows(strong.waveform)
    noise = pooled_noise(part, system)
    fitted = adaptive(part, noise, system, replace(strong, waveform=rows), max_echoes=1, significance=0.0)
    fitted = fitted.take(find_strongest(fitted, len(part))[0])
    misfit = 0.0
    if len(fitted) >= FEW:
        ratio = fitted.amplitude.astype(np.float64) / system.noise.std
        energy = SQRT_PI * ratio**2 * fitted.sigma / block.spacing
        energy *= fit_misfit(replace(system, misfit=1.0), block.spacing) ** 2
        every = (_promise(part, samples_of(part, noise), system, fitted, reach) - NOISE_PROMISE) / energy
        share = np.quantile(every, MISFIT_QUANTILE)
        if bounded:
            clipped = np.mean(block.samples.max(axis=1) >= (system.saturation or np.inf)) >= CLIPPED
            pulse = replace(system, kappa=0.0, components=()) if clipped else system
            common = _common_promise(part, noise, pulse, fitted, reach) / energy
            share = min(share, np.quantile(common, COMMON_QUANTILE))
        misfit = SCATTERED * float(np.sqrt(max(share, 0.0)))
    # A known sensor's pulse changes from shot to shot: of that echoes of a strip have nothing in common.
    return replace(system, misfit=max(misfit, system.misfit), tail_misfit=_measure_tail(part, system, fitted))


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


def _promise(part: WaveformBlock, samples: Samples, system: SystemPulse, echoes: EchoTable, reach: float) -> np.ndarray:
    """Fall of chi2 (m,) that one more echo promises near each echo, the only one of its waveform."""
    spacing = part.spacing
    shape, limits = pulse_shape(system, spacing), shape_limits(system, spacing)
    whole = np.stack([echoes.amplitude, echoes.time / spacing, echoes.sigma / spacing], axis=1).astype(np.float64)
    main = model_parameters(shape, limits, whole)
    s = part.samples.shape[1]
    far = int(np.ceil(reach * system.sigma_ref / spacing))
    middle = np.rint(whole[:, 1]).astype(np.int64)
    low, high = np.clip(middle - far, 0, s - 1), np.clip(middle + far + 1, 1, s)
    echo = np.arange(len(echoes))
    windows = Clusters(echoes.waveform.astype(np.int64), low, high, echo, np.ones_like(echo))
    amplitude, time, width = main.T
    settings = Settings(*limits, shape, clip_level(part, system), system.noise.gain, whitening=noise_filter(system))
    fitted = Candidates(windows.waveform, time, amplitude, width)
    return promise_echoes(samples, fitted, windows, settings)


def _common_promise(
    part: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, reach: float
) -> np.ndarray:
    """The same for waveforms of the pulse and of what all echoes of about one height leave of it beyond chance."""
    residual = subtract_echoes(part, system, echoes)[echoes.waveform] / echoes.amplitude[:, None]
    lag = np.arange(residual.shape[1]) - (echoes.time / part.spacing)[:, None]
    lag /= (echoes.sigma / part.spacing)[:, None]
    near = (np.abs(lag) < reach) & np.isfinite(residual)
    height = np.broadcast_to(echoes.amplitude[:, None], lag.shape)[near]
    common, number, spread = find_common(residual[near].astype(np.float64), lag[near], height, reach)
    chance = system.noise.quiet / height
    error = MEDIAN_ERROR * spread / np.sqrt(number) + 2 * np.maximum(spread - chance, 0.0)
    drawn, (row, place) = render_own(part, system, echoes, echoes.waveform, len(part)), np.nonzero(near)
    drawn[echoes.waveform[row], place] += np.sign(common) * np.maximum(np.abs(common) - error, 0.0) * height
    return _promise(part, Samples(drawn, np.zeros(len(part), np.float32), noise.std), system, echoes, reach)


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
