"""Candidates of a detector as clusters to be fitted: in samples, without false ones, grouped where they overlap."""

from __future__ import annotations

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.cluster import Candidates, Clusters, Settings, cluster_candidates
from wavebatch.kernels.fit.pulse_shape import pulse_tail, tail_at, tail_reach
from wavebatch.stages.detect.candidates import samples_of
from wavebatch.stages.pulse_tables import ShapeLimits, clip_level, model_parameters

MARGIN = 1.2
"""Windows extend this many system widths beyond the signal above the noise."""

REACH = 3.0
"""Windows extend at least this many system widths beyond the outer candidates."""

LEAST_PLATEAU = 2
"""Two candidates stand on one flat top if at least so many clipped samples lie between them ..."""

PLATEAU_SLACK = 2
"""... and at most so many that are not clipped (docs/algorithms.md H6)."""

MOST_JOINED = 6
"""A run of signal with more candidates is fitted in parts."""


def find_clusters(
    block: WaveformBlock,
    noise: Noise,
    system: SystemPulse,
    echoes: EchoTable,
    settings: Settings,
    most: int = MOST_JOINED,
) -> tuple[Candidates, Clusters]:
    """Turn candidates into parameters of the pulse in samples, and group those that must be fitted together.

    Parameters
    ----------
    block, noise, system, echoes
        As for a stage.
    settings : Settings
        Pulse and limits of the fit.
    most : int
        Most candidates of a cluster.

    Returns
    -------
    candidates : Candidates
        Without those that a flat top or an after-pulse explains.
    clusters : Clusters
        Disjoint windows with their candidates.
    """
    limits = ShapeLimits(settings.width_ref, settings.width_low, settings.width_high)
    columns = np.maximum(echoes.amplitude, 0), echoes.time / block.spacing, echoes.sigma / block.spacing
    start = np.stack(columns, axis=1).astype(np.float64)
    amplitude, time, width = model_parameters(settings.shape, limits, start).T
    candidates = Candidates(echoes.waveform.astype(np.int64), time, amplitude, np.clip(width, limits.low, limits.high))
    candidates = _join_plateaus(block, candidates, clip_level(block, system))
    candidates, tail = _explain_tails(candidates, noise, settings)
    ref = system.sigma_ref / block.spacing
    clusters = cluster_candidates(
        samples_of(block, noise),
        candidates,
        margin=int(np.ceil(MARGIN * ref)),
        reach=int(np.ceil(REACH * ref)),
        most=most,
        tail=tail,
    )
    return candidates, clusters


def _join_plateaus(block: WaveformBlock, candidates: Candidates, clip: float) -> Candidates:
    """Candidates, one for each flat top: clipped samples between two candidates are no sign of two echoes."""
    waveform, time, amplitude, _ = candidates
    if len(waveform) < 2:
        return candidates
    pair = np.flatnonzero(waveform[1:] == waveform[:-1])
    present, row = np.unique(waveform[pair], return_inverse=True)
    s = block.samples.shape[1]
    # Places of clipped samples, not a table of pairs by samples: one waveform of 65,536 samples may have 10,000 pairs.
    clipped = np.flatnonzero(block.samples[present] >= clip)
    if not len(clipped):
        return candidates
    begin, end = np.rint(time[pair]).astype(np.int64), np.rint(time[pair + 1]).astype(np.int64)
    first, stop = (row * s + np.clip(place, 0, s - 1) for place in (begin + 1, end))
    between = np.searchsorted(clipped, stop) - np.searchsorted(clipped, first)
    flat = (between >= LEAST_PLATEAU) & (end - begin - 1 - between <= PLATEAU_SLACK)
    if not flat.any():
        return candidates
    joined = np.zeros(len(waveform), bool)
    joined[pair[flat] + 1] = True
    first = np.flatnonzero(~joined)
    number = np.diff(np.r_[first, len(waveform)])
    middle = np.add.reduceat(time, first) / number
    kept = Candidates(*(field[first] for field in candidates))
    return kept._replace(time=np.where(number > 1, middle, kept.time), amplitude=np.maximum.reduceat(amplitude, first))


def _explain_tails(candidates: Candidates, noise: Noise, settings: Settings) -> tuple[Candidates, np.ndarray | None]:
    """Candidates that after-pulses of stronger echoes do not explain, and how far tails reach (docs/algorithms.md H7).

    Growth finds a dropped candidate again if the fit of the stronger echo leaves a residual there.
    """
    tail = pulse_tail(settings.shape, settings.width_ref)
    if tail is None:
        return candidates, None
    waveform, time, amplitude, _ = candidates
    expected = np.zeros(len(waveform))
    for step in range(1, min(MOST_JOINED, len(waveform))):
        same = waveform[step:] == waveform[:-step]
        lag = time[step:] - time[:-step]
        expected[step:] += np.where(same, amplitude[:-step] * tail_at(tail, lag), 0.0)
        expected[:-step] += np.where(same, amplitude[step:] * tail_at(tail, -lag), 0.0)
    std = noise.std[waveform]
    keep = (expected <= 0) | (amplitude - expected > 2.2 * std + 0.5 * expected)
    candidates = Candidates(*(field[keep] for field in candidates))
    return candidates, tail_reach(tail, candidates.amplitude / std[keep])
