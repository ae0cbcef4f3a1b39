"""Echoes that noise makes: in mirrored residuals, and where a recording holds no signal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from bench.real.inject import TOLERANCE
from bench.real.noise import QuietNoise, unround
from bench.real.pool import Pool, Solver, each_echo, find_gaps
from bench.real.templates import bare_block

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.stages.pulse_tables import clip_level
from wavebatch.stages.score import match_echoes

STRONG = 8.0
"""Echoes from this many noise standard deviations on are signal; weaker ones in a signal-free stretch are not."""

CLEAR_BEFORE, CLEAR_AFTER = 2.0, 8.0
"""A stretch ends this long before the first signal, or begins this long after the last one [FWHM]."""

NEAR = 4.0
"""Echoes nearer to another one are counted apart [FWHM]."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """Recording without signal, before or after all of it."""

    length: float
    """Of all waveforms together [ns]."""
    echoes: int
    """Found in it."""
    mirrored: int
    """Found in it once the residuals are mirrored."""


@dataclass(frozen=True, slots=True)
class FalseEchoes:
    """What the chain finds where nothing is."""

    recording: float
    """Length of all waveforms [ns]."""
    echoes: int
    """Found in them as they are."""
    mirrored_near: int
    """More echoes with mirrored residuals, near other echoes ..."""
    mirrored_far: int
    """... and far from them."""
    before: Stretch
    after: Stretch

    @property
    def correctness(self) -> float:
        """Share of the echoes that noise did not make; NaN without any."""
        return 1 - (self.mirrored_near + self.mirrored_far) / self.echoes if self.echoes else float("nan")


def count_false(
    pool: Pool, solver: Solver, echoes: Sequence[EchoTable], noise: QuietNoise, rng: np.random.Generator
) -> FalseEchoes:
    """Counts false echoes in all waveforms of the pool.

    Mirrored: the residual of each sample is turned over, the fitted echoes stay. Noise is as likely up as down, so
    the new echoes are as many as noise made before; echoes that the fit missed leave holes, which are none. What
    undershoot the sensor has counts as well, so that the figure is an upper limit.
    """
    length, found, near, far = 0.0, 0, 0, 0
    stretches = np.zeros((2, 3))
    for block, table in zip(pool.blocks, echoes, strict=True):
        new = _mirror(block, table, solver, noise, rng)
        first, last = _signal_span(block, table, noise.std)
        alone = np.ones(len(new), bool)
        for have, echo in each_echo(table, new.waveform):
            alone[have] &= np.abs(new.time[have] - table.time[echo]) > NEAR * solver.fwhm
        length += block.samples.size * block.spacing
        found += len(table)
        near, far = near + int((~alone).sum()), far + int(alone.sum())
        stretches += _count_stretches(block, table, new, first, last, solver.fwhm)
    before, after = (Stretch(float(part[0]), int(part[1]), int(part[2])) for part in stretches)
    return FalseEchoes(length, found, near, far, before, after)


def _mirror(
    block: WaveformBlock, table: EchoTable, solver: Solver, noise: QuietNoise, rng: np.random.Generator
) -> EchoTable:
    """Echoes that appear when residuals change their sign."""
    limit = clip_level(block, solver.system.of(block))
    expected = solver.expect(block, table)
    turned = np.rint(2.0 * expected - unround(block.samples, expected, noise, rng))
    turned = np.clip(turned, 0, min(limit, np.iinfo(block.samples.dtype).max))
    keep = find_gaps(block) | (block.samples >= limit)
    samples = np.where(keep, block.samples, turned).astype(block.samples.dtype)
    found = solver.run(bare_block(block, samples))
    match = match_echoes(found, table, 2 * TOLERANCE * solver.fwhm)
    lone, lost = np.ones(len(found), bool), np.ones(len(table), bool)
    lone[match.found], lost[match.truth] = False, False
    # Where one is found and another lost, an echo has moved; the weakest of the new ones are what is too much.
    lost = np.bincount(table.waveform[lost], minlength=len(block))
    new = found.take(np.flatnonzero(lone))
    order = np.lexsort((new.amplitude, new.waveform))
    count = new.count(len(block))
    place = np.arange(len(new)) - np.repeat(np.cumsum(count) - count, count)
    kept = order[place < (count - lost)[new.waveform[order]]]
    return new.take(np.sort(kept))


def _signal_span(block: WaveformBlock, table: EchoTable, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Times of the first and the last signal of each waveform [ns]; those without any have none to count."""
    strong = table.amplitude >= STRONG * noise
    waveform, time = table.waveform[strong], table.time[strong]
    if block.returns is not None:
        waveform, time = np.r_[waveform, block.returns.waveform], np.r_[time, block.returns.time]
    first, last = np.full(len(block), np.inf), np.full(len(block), -np.inf)
    np.minimum.at(first, waveform, time)
    np.maximum.at(last, waveform, time)
    return first, last


def _count_stretches(
    block: WaveformBlock, table: EchoTable, new: EchoTable, first: np.ndarray, last: np.ndarray, fwhm: float
) -> np.ndarray:
    """Length, echoes and mirrored echoes of the stretches before and after the signal, (2, 3)."""
    known = np.isfinite(first) & ~find_gaps(block).any(axis=1)
    end = (block.samples.shape[1] - 1) * block.spacing
    until = np.where(known, np.clip(first - CLEAR_BEFORE * fwhm, 0.0, end), 0.0)
    since = np.where(known, np.clip(last + CLEAR_AFTER * fwhm, 0.0, end), end)
    return np.array([
        [until.sum(), *(np.count_nonzero(t.time < until[t.waveform]) for t in (table, new))],
        [(end - since).sum(), *(np.count_nonzero(t.time > since[t.waveform]) for t in (table, new))],
    ])  # fmt: skip
