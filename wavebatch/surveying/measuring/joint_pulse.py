"""The system pulse from all echoes of a sample together, also of waveforms with several (docs/algorithms.md R2).

`choose_pulse` calls it in turn with decompositions of the sample. Before you change it: the pulse must not depend on
where the alternation begins, nor have the scene in its tail.
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.units import FWHM_PER_SIGMA, SQRT_PI
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import exp, solve
from wavebatch.kernels.fit.describe import gather_pulse
from wavebatch.kernels.fit.learn_pulse import Stack, fit_gaussians
from wavebatch.stages.pulse_tables import shape_limits
from wavebatch.surveying.measuring.judge import Explained, find_own_width, sample_noise
from wavebatch.surveying.measuring.learn_pulse import with_fit

BEFORE, CORE, AFTER = 5.0, 4.0, 40.0
"""Widths of the pulse before its peak where it may begin; after it up to which it is drawn in fine steps; and at which
it ends."""

FINE, NARROW = 0.5, 0.6
"""Distance and width of the Gaussians of the core [widths]: their sum can bend as fast as a pulse of 0.8 widths."""

GROWTH = 0.22
"""Distance of the Gaussians in the tail, over their lag: receivers forget more slowly the longer it is."""

SMOOTH = 0.08
"""How far the weight of a Gaussian may be from the line between its neighbours [largest weight], one standard
deviation: a fifth of what the second difference of a Gaussian pulse is there."""

EARLY, LATE = 0.02, 0.15
"""The same far before and after the core, over its value: before a pulse there is hardly anything."""

STEP, TAIL_STEP = 0.07, 5.0
"""Steps of the lag at which the core is drawn [widths], also where they are a tenth of a sample: echoes lie anywhere
between samples, and coarser steps do not see what the Gaussians miss. And those in the tail over them."""

LEAST_CHANGE = 0.003
"""Least misfit that is expected of the strongest echoes, so that a few do not decide alone."""

MOST_ECHOES = 8
"""Echoes of a waveform from which it says nothing of the pulse: what is one echo is then a guess."""

LEAST_ERROR = 2e-4
"""Least error of the pulse, over its peak: its Gaussians are no better known."""

ALIKE = 1.1
"""Misfit of a sum of Gaussians, over that of the best, at which a simpler one is taken."""


def learn_jointly(
    block: WaveformBlock, system: SystemPulse, explained: Explained, change: float, counted: float = 1.0
) -> SystemPulse:
    """Learn the pulse that describes all waveforms best, given where their echoes are.

    Parameters
    ----------
    block : WaveformBlock
    system : SystemPulse
        With the present pulse.
    explained : Explained
        The block decomposed with it.
    change : float
        Of the pulse from shot to shot, as a share of its amplitude.
    counted : float
        Weight of errors of the pulse that amplitudes and times of the echoes may absorb.

    Returns
    -------
    SystemPulse
        With the new pulse, its ringing, and as misfit what the Gaussians miss of it; as it was where the waveforms show
        no pulse.

    Notes
    -----
    The pulse is linear in the weights of Gaussians of fixed places and widths. An echo that is wider than the pulse has
    all of them widened by the same variance. The weights are smooth, and small far from the core; where nothing is
    known they are 0. The kernels then get the sum of the fewest free Gaussians that serves as well.
    """
    spacing = block.spacing
    stack = stack_jointly(system, explained, change, spacing, counted)
    half = stack.lag[stack.value > 0.5]
    if not len(half):  # of steps and other signal that is no echo nothing is learned
        return system
    width = float(half[-1] - half[0]) / FWHM_PER_SIGMA
    fits = fit_gaussians(stack, width)
    missed = [float(np.mean((fit.draw(stack.lag) - stack.value) ** 2)) for fit in fits]
    best = next(fit for fit, rest in zip(fits, missed, strict=True) if rest <= ALIKE**2 * min(missed))
    core = np.abs(stack.lag - best.datum) < CORE * width
    # As the kernel counts it: root of the energy that is left over that of a Gaussian of this width.
    left = (best.draw(stack.lag) - stack.value)[core]
    misfit = float(np.sqrt(np.sum(left * left) * (STEP * system.sigma_ref / spacing) / (SQRT_PI * width)))
    return with_fit(system, best, stack, width, spacing, misfit)


def stack_jointly(
    system: SystemPulse, explained: Explained, change: float, spacing: float, counted: float = 1.0
) -> Stack:
    """Return the pulse with its errors by lag [samples]."""
    s = explained.sums.left.shape[1]
    width = system.sigma_ref / spacing
    reference = shape_limits(system, spacing).ref
    reference *= find_own_width(explained, reference)
    core = np.arange(-BEFORE, CORE, FINE)
    far, wide = [CORE], [1.0]
    while far[-1] < min(AFTER, 0.7 * s / width):
        wide.append(GROWTH * far[-1])
        far.append(far[-1] + wide[-1])
    narrow = max(NARROW * width, NARROW)
    sigma = np.r_[np.full(len(core), narrow), np.maximum(np.array(wide) * width, narrow)]
    delay = np.r_[core, far] * width
    noise = sample_noise(system)
    # Samples that were cut off leave nothing, whatever the pulse is there: they teach nothing.
    sums = explained.sums._replace(used=explained.sums.used & (explained.sums.left != 0))
    matrix, right = gather_pulse(
        sums, noise, max(change, LEAST_CHANGE), delay, sigma, reference, MOST_ECHOES, counted
    )
    # Coloured noise: so many samples say as much as one of white noise.
    share = (system.noise.std / max(system.noise.quiet, 1e-6)) ** 2
    matrix, right = matrix / share, right / share
    # Height 1 means the amplitude of the present main component; areas of narrower Gaussians are drawn higher.
    # What is known of the weights before any waveform, as a matrix of normal equations; lag in widths.
    lag = delay / width
    away = np.where(
        np.abs(lag) < 2.5, 1.0, np.maximum(exp(-(np.abs(lag) - 2.5) / 3.0), np.where(lag > 0, LATE, EARLY))
    )
    # Weights are areas: those of a pulse of height 1 are about its sigma times the distance of two Gaussians.
    spread = SMOOTH * away * sigma / sigma[0]
    bend = np.diff(np.eye(len(lag)), 2, axis=0) / (0.5 * spread[1:-1])[:, None]
    matrix[:-1, :-1] += np.einsum("ki,kj->ij", bend, bend) + np.diag((np.abs(lag) > 2.5) / (3 * spread) ** 2)
    matrix += 1e-9 * np.trace(matrix) / len(delay) * np.eye(len(matrix))
    inverse = solve(matrix, np.eye(len(matrix)))
    weight = np.einsum("ij,j->i", inverse, right)
    step, end = STEP * width, min(AFTER * width, 0.8 * s)
    lag = np.r_[np.arange(-6 * width, 8 * width, step), np.arange(8 * width, end, TAIL_STEP * step)]
    rows = exp(-0.5 * ((lag[:, None] - delay) / sigma) ** 2) / sigma
    value = np.einsum("lk,k->l", rows, weight[:-1])
    error = np.sqrt(np.maximum(np.einsum("lk,kj,lj->l", rows, inverse[:-1, :-1], rows), 0.0))
    top = max(float(value.max()), 1e-30)
    return Stack(lag, value / top, np.maximum(error / top, LEAST_ERROR))
