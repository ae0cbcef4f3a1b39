"""The skew of a strip's echoes, whichever pulse its survey chose: for decomposers that fit log-normals.

`survey` calls `measure_skew` at its end. A survey that chose a sum of Gaussians has no use for the skew, but
`decompose.skewed` has: without it, it would fit plain Gaussians.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import UNCLEAN, EchoTable
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.fit.free_skew import MOST_SKEW, SkewPrior, fit_skews
from wavebatch.kernels.fit.least_squares import OUTSIDE, Limits, Windows
from wavebatch.stages.noise import pooled
from wavebatch.surveying.measuring.lone_echoes import MIN_SNR
from wavebatch.surveying.measuring.noise_and_width import ENOUGH_TO_LEARN, FEW, find_edge

MOST_FITTED = 400
"""Echoes whose skews are measured; more do not make the skew of the strip better known."""

LOBE = 3.0
"""Widths of an echo around its peak that its skew is fitted to: a tail is no skew."""

NARROW = 1.1
"""Width, over the narrowest that repeats, up to which an echo is one of a flat target: its skew is the pulse's."""

WEAK_PRIOR = SkewPrior(0.0, 0.5)
"""Keeps the skew of an echo that says nothing of it within reason."""

MOST, NORMAL_MOST = 0.9, 1.645
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
        all single echoes lie from it beyond their errors. Unchanged where fewer than 50 echoes are clear.

    References
    ----------
    Wang, Wang and Tseng eq. 2; docs/algorithms.md 1.2.
    """
    clear = (echoes.count(len(block))[echoes.waveform] == 1) & (echoes.amplitude > MIN_SNR * system.noise_std)
    rows = np.flatnonzero(clear & ((echoes.flags & np.uint16(UNCLEAN)) == 0))
    if len(rows) < ENOUGH_TO_LEARN:
        return system
    # Not every second or third: channels take turns.
    chosen = echoes.take(rows[np.unique(np.linspace(0, len(rows) - 1, MOST_FITTED).astype(np.int64))])
    skew, error = fit_single(block, system, chosen)
    known = np.isfinite(skew) & np.isfinite(error) & (error > 0)
    narrow = known & (chosen.sigma < NARROW * find_edge(chosen.sigma))
    if np.count_nonzero(narrow) < FEW:
        return system
    typical = float(np.median(skew[narrow]))
    scatter = float(np.quantile(np.abs(skew[known] - typical), MOST)) / NORMAL_MOST
    excess = scatter**2 - float(np.median(error[known] ** 2))
    return replace(system, skew=typical, skew_spread=max(float(np.sqrt(max(excess, 0.0))), LEAST_SPREAD))


def fit_single(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> tuple[np.ndarray, np.ndarray]:
    """Fit a skewed pulse to every echo alone.

    Parameters
    ----------
    block : WaveformBlock
        The waveforms.
    system : SystemPulse
        With the noise.
    echoes : EchoTable
        m echoes that are alone in their waveforms.

    Returns
    -------
    skew, error : float64 array, shape (m,)
        Skew of each echo and its standard deviation.
    """
    spacing, s = block.spacing, block.samples.shape[1]
    part = block.rows(echoes.waveform)
    signal = (part.samples - pooled(part, system).level).astype(np.float32)
    time, width = echoes.time / spacing, echoes.sigma.astype(np.float64) / spacing
    reach = np.maximum(LOBE * width, 2.5)
    length = min(int(np.ceil(2 * reach.max())) + 2, s)
    begin = np.clip(np.rint(time - 0.5 * length), 0, s - length).astype(np.int64)
    at = begin[:, None] + np.arange(length)
    x, rows = at.astype(np.float32), np.arange(len(echoes))[:, None]
    signal = signal[rows, at]
    outside = np.abs(x - time[:, None]) > reach[:, None]
    if part.missing is not None:
        outside |= part.missing[rows, at]
    x[outside], signal[outside] = OUTSIDE, 0
    windows = Windows(signal, x, np.full(len(echoes), system.noise_std))
    start = np.stack([echoes.amplitude.astype(np.float64), time, width, np.zeros(len(echoes))], axis=1)[:, :, None]
    edges = np.array([[0.0, -3.0, 0.05, -MOST_SKEW], [1e9, s + 3.0, float(s), MOST_SKEW]])
    fit = fit_skews(windows, start, Limits(*edges[:, None, :, None]), prior=WEAK_PRIOR)
    known = fit.converged & ~fit.at_bound[:, 0]
    return tuple(np.where(known, values[:, 3, 0], np.nan) for values in (fit.parameters, fit.errors))
