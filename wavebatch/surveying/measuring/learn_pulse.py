"""The shape of the system pulse, learned from a sample's clear isolated echoes: the simplest model that serves.

Whichever pulse a survey chose, `measure_skew` gives the skew of its echoes in the end: a survey that chose a sum of
Gaussians has no use for it, but `decompose.skewed` has: without it, it would fit plain Gaussians.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.order import distinct, median, quantile
from wavebatch.core.units import FWHM_PER_SIGMA, QUANTISATION_STD, SQRT_PI
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import log
from wavebatch.kernels.fit.decompose import Candidates, Clusters, Settings, decompose_clusters
from wavebatch.kernels.fit.learn_pulse import PulseFit, Stack, fit_gaussians, fit_skewed, stack_pulse
from wavebatch.kernels.fit.pulse_shape import measure_pulse
from wavebatch.stages.decompose.fit import adaptive
from wavebatch.stages.detect.direct import samples_of
from wavebatch.stages.noise import pooled as pooled_noise
from wavebatch.stages.pulse_tables import floor_level, pulse_shape, shape_limits
from wavebatch.surveying.measuring.noise_and_width import (
    ENOUGH_TO_LEARN,
    FEW,
    MIN_SNR,
    SMALL,
    find_edge,
    find_single,
    fit_lone,
)
from wavebatch.surveying.systems.figures import Figures

MOST_STACKED = 3000
"""Isolated echoes that a stack takes; more do not make it better."""

BEFORE, AFTER = 9.0, 40.0
"""Samples before and after an echo that its stack covers, for a pulse of 2 samples; broader ones in proportion."""

NARROWEST = 0.06
"""How far the width of an echo that teaches the pulse may be from the lower edge, as a share of it."""

FAR_FROM_LIMIT = 0.75
"""Amplitude, over the largest count, up to which no receiver compresses an echo much."""


FIRST_COMPONENTS = 3
"""Components of the first pulse, which only has to fit well enough to separate echoes."""

MOST_STRONG = 800
"""Strong echoes in which the misfit of the pulse is measured; a quarter as many weaker ones tell whether it is one."""

REACHED = 0.3
"""Misfit of a pulse model, in noise at the strip's strongest amplitudes, that is too small to be seen."""

GOAL, NEAR_BEST = 1.25, 1.25
"""Root of chi2 of a pulse model to the stack that chance alone makes; and chi over that of the best model, at which a
simpler one is taken."""

WIDENED = 1.1
"""Width of an echo, over that of the strip's pulse, from which its target has widened it."""

MOST_WIDENED = 500
"""Widened echoes, the strongest ones, in which two pulses are compared."""

BETTER = 0.97
"""Misfit of widened echoes, over that of a simpler pulse, at which the other one is taken."""


def find_isolated(block: WaveformBlock, system: SystemPulse, clear: EchoTable) -> EchoTable:
    """Echoes to learn from: of the clear ones those far from the limit that are as narrow as the pulse (R2).

    The half of them nearest to the lower edge of the widths: flat targets, whose echoes slopes do not widen.
    """
    top = system.saturation or float(block.samples.max())
    # At least half of them, where all are nearly as high.
    highest = max(FAR_FROM_LIMIT * top, float(median(clear.amplitude)) if len(clear) else 0.0)
    echoes = clear.take(np.flatnonzero(clear.amplitude <= highest))
    if len(echoes) < FEW:
        return echoes
    # At most half of the echoes, those whose widths are nearest to the lower edge of all, and at most NARROWEST off.
    # In a forest hardly an echo has the pulse's width: there it is fewer, but at least ENOUGH_TO_LEARN.
    distance = np.abs(log(echoes.sigma / find_edge(echoes.sigma)))
    order = np.argsort(distance, kind="stable")
    near = int(np.count_nonzero(distance < NARROWEST))
    order = order[: max(min(len(echoes) // 2, near), ENOUGH_TO_LEARN)]
    return echoes.take(np.sort(order[:: max(len(order) // MOST_STACKED, 1)]))


def part_strong(echoes: EchoTable) -> tuple[EchoTable, EchoTable]:
    """Part the clear echoes that no target has widened: the strongest fifth (FEW where there are so many), the others.

    Fewer than FEW clear ones are all strong.
    """
    if len(echoes) < FEW:
        return echoes, echoes.take(np.empty(0, np.int64))
    narrow = echoes.take(np.flatnonzero(echoes.sigma < WIDENED * find_edge(echoes.sigma)))
    share = min(max(1 - FEW / len(narrow), 0.0), 0.8)
    strong = narrow.amplitude >= quantile(narrow.amplitude, share)
    parts = (np.flatnonzero(strong), MOST_STRONG), (np.flatnonzero(~strong), MOST_STRONG // 4)
    first, second = (narrow.take(rows[:: max(len(rows) // most, 1)]) for rows, most in parts)
    return first, second


def find_clear(block: WaveformBlock, system: SystemPulse) -> EchoTable:
    """Echoes of any width that are the strongest by ten to one of their waveform, not near an edge or clipped."""
    echoes = fit_lone(block, pooled_noise(block, system), system, MIN_SNR, fraction=0.5)
    top = system.saturation or float(block.samples.max())
    # Three retro-reflectors make no ground weak: the light that a share, or FEW, of the waveforms reach is bright.
    peaks = np.sort(block.samples.max(axis=1))
    bright = float(peaks[-min(FEW, 1 + len(peaks) // 10)])
    return echoes.take(np.flatnonzero((echoes.amplitude > 0.08 * bright) & (echoes.amplitude < top)))


def learn_pulse(
    block: WaveformBlock, system: SystemPulse, clear: EchoTable, main: EchoTable, figures: Figures
) -> tuple[SystemPulse, ...]:
    """The simplest pulse model that reaches the noise: Gaussian, skewed, or a sum of Gaussians (R1, R2).

    A skewed one also as a sum of Gaussians: the judge decides, where lone echoes do not.
    """
    noise = pooled_noise(block, system)
    signal = block.samples[main.waveform] - noise.level[main.waveform]
    if block.missing is not None:
        signal[block.missing[main.waveform]] = np.nan
    width = system.sigma_ref / block.spacing
    amplitude, time = main.amplitude.astype(np.float64), main.time / block.spacing
    cut = block.samples[main.waveform] <= floor_level(system)
    half = max(width / 2, 1)
    stack = stack_pulse(signal, amplitude, time, BEFORE * half, AFTER * half, QUANTISATION_STD, cut=cut)
    strongest = quantile(main.amplitude, 0.99)
    goal = REACHED * system.noise.std / strongest
    small = len(block) < SMALL
    sums = fit_gaussians(stack, width, FIRST_COMPONENTS, 0.0 if small else goal)
    skewed = fit_skewed(stack, width)
    figures.misfit_goal, figures.misfit_skewed, figures.kappa = goal, skewed.rms, skewed.kappa
    figures.misfit_gaussians = {len(fit.components): fit.rms for fit in sums}
    best = sums[-1]
    if not small:
        # The first fit whose misfit is below the goal, or that the errors of the stack allow, or that is near the best.
        # By its errors: what a few lags of the tail show for sure is nothing in the mean of all.
        fits, error = [sums[0], skewed, *sums[1:]], np.maximum(stack.error, 0.25 * median(stack.error))
        chi = [float(np.sqrt(np.mean((_draw_scaled(fit, stack) / error - stack.value / error) ** 2))) for fit in fits]
        enough = max(GOAL, NEAR_BEST * min(chi))
        best = next(fit for fit, one in zip(fits, chi, strict=True) if one <= enough or fit.rms <= goal)
    if len(best.components) > 1:
        # All components that were worth fitting: fewer would save nothing, and tiles would disagree on their number.
        best = sums[-1]
    chosen = _with_pulse(system, best, stack, block.spacing)
    if best.kappa and len(sums) > 1:
        # The same pulse on level ground, so that widened echoes alone decide.
        drawn = stack._replace(value=best.draw(stack.lag), error=np.full(len(stack.lag), 1.0))
        other = fit_gaussians(drawn, width)[-1]
        return _fit_wide_best(block, system, clear, (chosen, _with_pulse(system, other, stack, block.spacing)))
    return (chosen,)


def _fit_wide_best(
    block: WaveformBlock, system: SystemPulse, clear: EchoTable, pulses: tuple[SystemPulse, ...]
) -> tuple[SystemPulse, ...]:
    """Two pulses that fit level ground equally well; the second alone where it fits widened echoes better.

    A target that widens a skewed pulse stretches it as a whole; a sum of Gaussians grows round. Only the strongest
    echoes of slopes and plants show which of them is right.
    """
    top = system.saturation or float(block.samples.max())
    clear = clear.take(np.flatnonzero(clear.amplitude < FAR_FROM_LIMIT * top))
    if not len(clear):
        return pulses
    clear = clear.take(np.flatnonzero(clear.sigma > WIDENED * find_edge(clear.sigma)))
    clear = clear.take(np.sort(np.argsort(-clear.amplitude, kind="stable")[:MOST_WIDENED]))
    if not len(clear):
        return pulses
    part, rows = block.rows(clear.waveform), np.arange(len(clear))
    misfits: list[float] = []
    for pulse in pulses:
        noise = pooled_noise(part, pulse)
        alone = replace(clear, waveform=rows.astype(np.int32))
        # In a canopy most of them are several echoes, which no pulse fits: the tenth that fits best is of one.
        residual = adaptive(part, noise, pulse, alone, max_echoes=1).residual
        if not len(residual):
            return pulses
        misfits.append(quantile(residual, 0.1))
    return pulses[1:] if misfits[1] < BETTER * misfits[0] else pulses


CORE = 4.0
"""Widths of the pulse around its peak in which its misfit counts."""


def _draw_scaled(fit: PulseFit, stack: Stack) -> np.ndarray:
    """The pulse of a fit at the height of the stack: those of its echoes are of Gaussians, which few pulses are."""
    drawn = fit.draw(stack.lag)
    return drawn * np.einsum("l,l->", drawn, stack.value) / np.einsum("l,l->", drawn, drawn)


def _with_pulse(system: SystemPulse, fit: PulseFit, stack: Stack, spacing: float) -> SystemPulse:
    """The system with the pulse that lone echoes show.

    A Gaussian keeps the width that the echoes themselves had: aligning them for the stack widens it a little.
    """
    width = system.sigma_ref / spacing
    # What the model misses of the stack's core beyond chance, in the kernel's terms: its energy over
    # that of a Gaussian. Further out are neighbours.
    core = np.abs(stack.lag - fit.datum) < CORE * width
    rest = _draw_scaled(fit, stack) - stack.value
    missed = max(float(np.mean(rest[core] ** 2 - stack.error[core] ** 2)), 0.0)
    misfit = float(np.sqrt(missed * 2 * CORE / SQRT_PI))
    found = with_fit(system, fit, stack, width, spacing, misfit)
    return found if found.components or found.kappa else replace(found, sigma_ref=system.sigma_ref)


def with_fit(
    system: SystemPulse, fit: PulseFit, stack: Stack, width: float, spacing: float, misfit: float
) -> SystemPulse:
    """Return the system with the pulse of a fit, in ns; its ringing is what the stack has beyond 4 widths [samples]."""
    far = np.abs(stack.lag - fit.datum) > 4 * width
    ringing = float(np.abs(stack.value[far]).max(initial=0.0))
    scaled = tuple((float(w), float(d) * spacing, float(s) * spacing) for w, d, s in fit.components)
    components = scaled if len(scaled) > 1 else ()
    system = replace(system, ringing=ringing, kappa=fit.kappa, components=components, misfit=misfit)
    if not components:
        return replace(system, sigma_ref=scaled[0][2])
    limits = shape_limits(system, spacing)
    table = measure_pulse(pulse_shape(system, spacing), limits.low, limits.high)
    half_width = float(np.interp(limits.ref, table.width, table.half_width))
    return replace(system, sigma_ref=half_width / FWHM_PER_SIGMA * spacing)


MOST_FITTED = 400
"""Echoes whose skews are measured; more do not make the skew of the strip better known."""

LOBE = 3.0
"""Widths of an echo around its peak that its skew is fitted to: a tail is no skew."""

NARROW = 1.1
"""Width, over the narrowest that repeats, up to which an echo is one of a flat target: its skew is the pulse's."""

WEAK_PRIOR = 0.5
"""Standard deviation of a prior around 0: it keeps the skew of an echo that says nothing of it within reason."""

MOST_OF_SKEWS, NORMAL_MOST = 0.9, 1.645
"""Share of the echoes from which the spread is found, and the distance within which a normal law has so many: half of
them would not show the plants of a scene that is mostly ground."""

LEAST_SPREAD = 0.02
"""Least spread of skews: no strip has only one."""


def measure_skew(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> SystemPulse:
    """Measure the skew of clear single echoes.

    Parameters
    ----------
    block : WaveformBlock
        A sample of the strip.
    system : SystemPulse
        Its survey so far.
    echoes : EchoTable
        The block decomposed with it.

    Returns
    -------
    SystemPulse
        With `skew`, the median of the echoes that the target has not widened, and `skew_spread`, how far the skews of
        all single echoes lie from it beyond their errors. Unchanged where fewer than 20 echoes are clear.

    References
    ----------
    Wang, Wang and Tseng eq. 2; docs/algorithms.md 1.2.
    """
    rows = np.flatnonzero(find_single(echoes, len(block), system))
    if len(rows) < ENOUGH_TO_LEARN:
        return system
    # Not every second or third: channels take turns.
    chosen = echoes.take(rows[distinct(np.linspace(0, len(rows) - 1, MOST_FITTED).astype(np.int64))])
    # A skewed pulse is fitted to each of them alone.
    spacing, s = block.spacing, block.samples.shape[1]
    part = block.rows(chosen.waveform)
    time, width = chosen.time / spacing, chosen.sigma.astype(np.float64) / spacing
    reach, row = np.maximum(LOBE * width, 2.5), np.arange(len(chosen))
    low = np.clip(np.ceil(time - reach), 0, s - 1).astype(np.int64)
    high = np.clip(np.floor(time + reach) + 1, low + 1, s).astype(np.int64)
    settings = Settings(1.0, 0.05, float(s), tolerance=0.1, grow=False, skew_spread=WEAK_PRIOR)
    starts = Candidates(row, time, chosen.amplitude.astype(np.float64), width)
    clusters = Clusters(row, low, high, row, np.ones_like(row))
    fit = decompose_clusters(samples_of(part, pooled_noise(part, system)), starts, clusters, settings)
    skew, error = fit.parameters[:, 3], fit.errors[:, 3]
    known = fit.converged & ~fit.at_bound & np.isfinite(skew) & np.isfinite(error) & (error > 0)
    narrow = known & (chosen.sigma < NARROW * find_edge(chosen.sigma))
    if np.count_nonzero(narrow) < FEW:
        return system
    typical = float(median(skew[narrow]))
    scatter = quantile(np.abs(skew[known] - typical), MOST_OF_SKEWS) / NORMAL_MOST
    excess = scatter**2 - float(median(error[known] ** 2))
    return replace(system, skew=typical, skew_spread=max(float(np.sqrt(max(excess, 0.0))), LEAST_SPREAD))
