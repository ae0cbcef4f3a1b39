"""The skew of a strip's echoes, whichever pulse its survey chose: for decomposers that fit log-normals.

`survey` calls `measure_skew` at its end. A survey that chose a sum of Gaussians has no use for the skew, but
`decompose.skewed` has: without it, it would fit plain Gaussians.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.order import distinct, median, quantile
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.fit.decompose import Candidates, Clusters, Settings, decompose_clusters
from wavebatch.stages.detect.direct import samples_of
from wavebatch.stages.noise import pooled
from wavebatch.surveying.measuring.noise_and_width import ENOUGH_TO_LEARN, FEW, find_edge, find_single

MOST_FITTED = 400
"""Echoes whose skews are measured; more do not make the skew of the strip better known."""

LOBE = 3.0
"""Widths of an echo around its peak that its skew is fitted to: a tail is no skew."""

NARROW = 1.1
"""Width, over the narrowest that repeats, up to which an echo is one of a flat target: its skew is the pulse's."""

WEAK_PRIOR = 0.5
"""Standard deviation of a prior around 0: it keeps the skew of an echo that says nothing of it within reason."""

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
    fit = decompose_clusters(samples_of(part, pooled(part, system)), starts, clusters, settings)
    skew, error = fit.parameters[:, 3], fit.errors[:, 3]
    known = fit.converged & ~fit.at_bound & np.isfinite(skew) & np.isfinite(error) & (error > 0)
    narrow = known & (chosen.sigma < NARROW * find_edge(chosen.sigma))
    if np.count_nonzero(narrow) < FEW:
        return system
    typical = float(median(skew[narrow]))
    scatter = quantile(np.abs(skew[known] - typical), MOST) / NORMAL_MOST
    excess = scatter**2 - float(median(error[known] ** 2))
    return replace(system, skew=typical, skew_spread=max(float(np.sqrt(max(excess, 0.0))), LEAST_SPREAD))
