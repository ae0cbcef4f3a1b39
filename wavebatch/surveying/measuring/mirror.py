"""Mirrored residuals: echoes of (samples - 2 residuals) that match no echo found. Noise makes as many up as down; the
pulse's misfit that echoes absorb, and noise taken for echoes, show here.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.stages.pulse_tables import clip_level
from wavebatch.stages.score import list_pairs, pair_nearest
from wavebatch.surveying.measuring.judge import explain

STRONG = 30.0
ZONE = 2.0


@dataclass(frozen=True, slots=True)
class Mirror:
    mains: int
    beside: int
    """Unmatched mirrored echoes within ZONE full widths of a main echo above STRONG noises."""
    echoes: int
    quiet: int
    """Unmatched ones elsewhere."""


def look_in_mirror(block: WaveformBlock, system: SystemPulse) -> Mirror:
    block = block.rows(np.flatnonzero((block.samples < clip_level(block, system)).all(axis=1)))
    e = explain(block, system)
    mirrored = replace(block, samples=np.ascontiguousarray((block.samples - 2 * e.sums.left).astype(np.float32)))
    echoes, other = e.echoes, explain(mirrored, system).echoes
    fwhm = system.sigma_ref * FWHM_PER_SIGMA
    left, right = list_pairs(other.waveform, other.time, echoes.waveform, echoes.time, fwhm)
    near = np.abs(other.time[left] - echoes.time[right])
    kept = pair_nearest(left, right, near, len(other), len(echoes))
    unmatched = np.ones(len(other), bool)
    unmatched[left[kept]] = False
    rest = other.take(np.flatnonzero(unmatched))
    n = len(block)
    top = np.zeros(n)
    np.maximum.at(top, echoes.waveform, echoes.amplitude)
    main = np.flatnonzero((echoes.amplitude == top[echoes.waveform]) & (echoes.amplitude > STRONG * system.noise.std))
    time = np.full(n, np.inf)
    time[echoes.waveform[main]] = echoes.time[main]
    beside = np.abs(rest.time - time[rest.waveform]) <= ZONE * fwhm
    near, _ = list_pairs(rest.waveform, rest.time, echoes.waveform, echoes.time, ZONE * fwhm)
    quiet = np.ones(len(rest), bool)
    quiet[near] = False
    return Mirror(len(main), int(beside.sum()), len(echoes), int((quiet & ~beside).sum()))
