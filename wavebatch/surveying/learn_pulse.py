"""The shape of the system pulse, learned from a sample's clear isolated echoes: the simplest model that serves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.units import FWHM_PER_SIGMA, QUANTISATION_STD
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.fit.learn_pulse import PulseFit, Stack, fit_gaussians, fit_skewed, stack_pulse
from wavebatch.stages.decompose.fit import adaptive, closed_form
from wavebatch.stages.detect.maximum import maximum
from wavebatch.stages.noise import pooled as pooled_noise
from wavebatch.stages.pulse_tables import pulse_measures, pulse_shape, shape_limits
from wavebatch.surveying.measure import ENOUGH_TO_LEARN, FEW, MIN_SNR, find_mode, find_strongest, keep_lone

MOST_STACKED = 3000
"""Isolated echoes that a stack takes; more do not make it better."""

BEFORE, AFTER = 9.0, 25.0
"""Samples before and behind an echo that its stack covers."""

REACHED = 0.3
"""Misfit of a pulse model, in noise at the strip's strongest amplitudes, that nobody can see."""

GOAL = 1.25
"""Misfit of a pulse model, in errors of the stack, that nobody can tell from none."""

NEAR_BEST = 1.25
"""Misfit, over that of the best model, at which a simpler one is taken."""

WIDENED = 1.1
"""Width of an echo, over that of the strip's pulse, from which its target has widened it."""

MOST_WIDENED = 500
"""Widened echoes, the strongest ones, in which two pulses are compared."""

BETTER = 0.97
"""Misfit of widened echoes, over that of a simpler pulse, at which the other one is taken."""


def find_isolated(block: WaveformBlock, system: SystemPulse) -> EchoTable:
    """Echoes to learn from: the strongest by ten to one of their waveform, unsaturated, of the most common width (R2).

    The half of them nearest to the mode of the widths: flat targets, whose echoes slopes do not widen.
    """
    echoes = _find_clear(block, system)
    distance = np.abs(echoes.sigma - find_mode(echoes.sigma)) if len(echoes) >= FEW else echoes.sigma
    order = np.argsort(distance, kind="stable")[: max(len(echoes) // 2, ENOUGH_TO_LEARN)]
    return echoes.take(np.sort(order[:: max(len(order) // MOST_STACKED, 1)]))


def find_strong(block: WaveformBlock, system: SystemPulse) -> tuple[EchoTable, EchoTable]:
    """The strongest fifth of the isolated echoes that are not clipped, and the third fifth.

    Without those that targets have widened.
    """
    echoes = _find_clear(block, system, most=1.0)
    if len(echoes) < FEW:
        return echoes, echoes
    low, high, strong = np.quantile(echoes.amplitude, (0.4, 0.6, 0.8))
    parts = (echoes.amplitude >= strong, (echoes.amplitude >= low) & (echoes.amplitude < high))
    narrow = echoes.sigma < WIDENED * find_mode(echoes.sigma)
    return echoes.take(np.flatnonzero(parts[0] & narrow)), echoes.take(np.flatnonzero(parts[1] & narrow))


def _find_clear(block: WaveformBlock, system: SystemPulse, most: float = 0.75) -> EchoTable:
    """Echoes of any width that are the strongest by ten to one of their waveform, not near an edge or clipped.

    most: largest amplitude, as a share of the largest count.
    """
    n = len(block)
    noise = pooled_noise(block, system)
    echoes = closed_form(block, noise, system, maximum(block, noise, system), fraction=0.5, steps=4)
    strongest, second = find_strongest(echoes, n)
    echoes = echoes.take(strongest)
    top = system.saturation or float(block.samples.max())
    good = echoes.amplitude > MIN_SNR * system.noise_std
    good &= (echoes.amplitude > 0.08 * top) & (echoes.amplitude < most * top)
    good &= (echoes.flags & int(EchoFlag.NEAR_EDGE | EchoFlag.SATURATED)) == 0
    return echoes.take(np.flatnonzero(keep_lone(good, echoes.amplitude, second)))


def learn_pulse(block: WaveformBlock, system: SystemPulse, main: EchoTable, figures: dict[str, float]) -> SystemPulse:
    """The simplest pulse model that reaches the noise: Gaussian, skewed, or a sum of Gaussians (R1, R2)."""
    noise = pooled_noise(block, system)
    width = system.sigma_ref / block.spacing
    signal = block.samples[main.waveform] - noise.baseline[main.waveform][:, None]
    before, after = BEFORE * max(width / 2, 1), AFTER * max(width / 2, 1)
    amplitude, time = main.amplitude.astype(np.float64), main.time / block.spacing
    stack = stack_pulse(signal, amplitude, time, before, after, QUANTISATION_STD)
    strongest = float(np.quantile(main.amplitude, 0.99))
    goal = max(REACHED * system.noise_std / strongest, GOAL * float(np.sqrt(np.mean(stack.error**2))))
    sums = fit_gaussians(stack, width)
    skewed = fit_skewed(stack, width)
    figures["misfit_goal"] = goal
    figures["misfit_skewed"], figures["kappa"] = skewed.rms, skewed.kappa
    for fit in sums:
        figures[f"misfit_{len(fit.components)}_gaussians"] = fit.rms
    best = _simplest([sums[0], skewed, *sums[1:]], goal)
    chosen = _with_pulse(system, best, stack, block.spacing)
    if best.kappa and len(sums) > 1:
        other = _with_pulse(system, _simplest(sums[1:], goal), stack, block.spacing)
        return _fit_wide_best(block, system, (chosen, other))
    return chosen


def _fit_wide_best(block: WaveformBlock, system: SystemPulse, pulses: tuple[SystemPulse, SystemPulse]) -> SystemPulse:
    """The first of two pulses that level ground cannot tell apart, unless the other fits widened echoes better.

    A skewed pulse is stretched as a whole where a target widens it, a sum of Gaussians grows round: which of them is
    right only the strongest echoes of slopes and plants say.
    """
    clear = _find_clear(block, system)
    clear = clear.take(np.flatnonzero(clear.sigma > WIDENED * find_mode(clear.sigma)))
    clear = clear.take(np.sort(np.argsort(-clear.amplitude, kind="stable")[:MOST_WIDENED]))
    if len(clear) < FEW:
        return pulses[0]
    part, rows = block.rows(clear.waveform), np.arange(len(clear))
    misfits = []
    for pulse in pulses:
        noise = pooled_noise(part, pulse)
        alone = replace(clear, waveform=rows.astype(np.int32))
        misfits.append(float(np.median(adaptive(part, noise, pulse, alone, max_echoes=1).residual)))
    return pulses[1] if misfits[1] < BETTER * misfits[0] else pulses[0]


def _simplest(fits: list[PulseFit], goal: float) -> PulseFit:
    """The first fit that reaches the goal, or comes near the best of all."""
    enough = max(goal, NEAR_BEST * min(fit.rms for fit in fits))
    return next(fit for fit in fits if fit.rms <= enough)


def _with_pulse(system: SystemPulse, fit: PulseFit, stack: Stack, spacing: float) -> SystemPulse:
    """The system with a learned pulse in ns; its ringing is the largest value beyond 4 widths.

    A Gaussian keeps the width that the echoes themselves had: aligning them for the stack widens it a little.
    """
    width = system.sigma_ref / spacing
    far = np.abs(stack.lag - fit.datum) > 4 * width
    system = replace(system, ringing=float(np.abs(stack.value[far]).max(initial=0.0)), kappa=fit.kappa)
    if len(fit.components) > 1:
        components = tuple((float(w), float(d) * spacing, float(s) * spacing) for w, d, s in fit.components)
        system = replace(system, components=components)
        limits = shape_limits(system, spacing)
        table = pulse_measures(pulse_shape(system, spacing), limits)
        half_width = float(np.interp(limits.ref, table.width, table.half_width))
        return replace(system, sigma_ref=half_width / FWHM_PER_SIGMA * spacing)
    if fit.kappa:
        return replace(system, sigma_ref=float(fit.components[0, 2]) * spacing)
    return system
