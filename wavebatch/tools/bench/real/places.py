"""Where echoes are injected: random places in quiet stretches, or near the strongest echo of a waveform."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.tools.bench.real.pool import Solver, fill_of

QUIET = 4.0
"""An injected echo this far from every echo of its waveform lies in a quiet stretch [FWHM of the system pulse]."""

NEAREST, FARTHEST = 0.5, 4.0
"""Separations from the strongest echo that are tried, before and after it [FWHM]."""

EDGE = 1.5
"""Least distance of an injected echo from the ends of its waveform [FWHM]."""

TRIES = 24
"""Places that are tried for an echo in a waveform before another waveform is taken."""

HOST = 10.0
"""Least amplitude of the strongest echo of a waveform near which one is injected [noise standard deviations]."""


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where echoes are injected into a block."""

    row: np.ndarray
    """Of the block, i8 (k,)."""
    time: np.ndarray
    """[ns], f8 (k,)."""
    strongest: np.ndarray
    """Row in the table of echoes of the strongest echo of the waveform; -1 for quiet stretches."""


def find_places(
    block: WaveformBlock,
    table: EchoTable,
    solver: Solver,
    noise: float,
    wanted: int,
    near: bool,
    rng: np.random.Generator,
) -> Places:
    """Random places that meet the rules; fewer than wanted where the strip has no room."""
    fwhm, end = solver.fwhm, (block.samples.shape[1] - 1) * block.spacing
    strongest = _strongest(table, len(block))
    hosts = np.arange(len(block))
    if near:
        strong = np.where(strongest >= 0, table.amplitude[strongest] if len(table) else 0.0, 0.0)
        hosts = np.flatnonzero(strong > HOST * noise)
    if not len(hosts) or end <= 2 * EDGE * fwhm:
        return Places(*(np.empty(0, np.int64),) * 3)
    row = np.repeat(rng.choice(hosts, wanted), TRIES)
    if near:
        # As many at each ratio of separations: the narrow ones matter most.
        apart = np.exp(rng.uniform(np.log(NEAREST), np.log(FARTHEST), len(row))) * rng.choice((-1, 1), len(row))
        time = table.time[strongest[row]] + apart * fwhm
    else:
        time = rng.uniform(EDGE * fwhm, end - EDGE * fwhm, len(row))
    good = (time >= EDGE * fwhm) & (time <= end - EDGE * fwhm)
    good &= _is_clear(table, row, time, fwhm, strongest if near else None)
    good &= ~_touches_fill(block, row, time, fwhm)
    tries = good.reshape(wanted, TRIES)
    done = np.flatnonzero(tries.any(axis=1))
    chosen = done * TRIES + tries[done].argmax(axis=1)
    owner = strongest[row[chosen]] if near else np.full(len(chosen), -1)
    return Places(row[chosen], time[chosen], owner)


def _strongest(table: EchoTable, n: int) -> np.ndarray:
    """Row of the strongest echo of each waveform, -1 without any."""
    strongest = np.full(n, -1)
    order = np.lexsort((table.amplitude, table.waveform))
    strongest[table.waveform[order]] = order
    return strongest


def _is_clear(
    table: EchoTable, row: np.ndarray, time: np.ndarray, fwhm: float, strongest: np.ndarray | None
) -> np.ndarray:
    """Whether no echo of the waveform is near; the strongest may be, and others of it further off then."""
    clear = np.ones(len(row), bool)
    count = np.bincount(table.waveform, minlength=int(row.max(initial=0)) + 1)
    first = np.cumsum(count) - count
    for order in range(int(count.max(initial=0))):
        have = np.flatnonzero(count[row] > order)
        echo = first[row[have]] + order
        apart = np.abs(time[have] - table.time[echo]) / fwhm
        limit = QUIET if strongest is None else np.where(strongest[row[have]] == echo, 0.0, 0.5 * QUIET)
        clear[have] &= apart >= limit
    return clear


def _touches_fill(block: WaveformBlock, row: np.ndarray, time: np.ndarray, fwhm: float) -> np.ndarray:
    """Whether a gap between two recordings lies under the echo or next to it."""
    fill = fill_of(block)
    if not fill.any():
        return np.zeros(len(row), bool)
    before = np.concatenate([np.zeros((len(fill), 1), np.int64), np.cumsum(fill, axis=1)], axis=1)
    s = fill.shape[1]
    low = np.clip(np.floor((time - EDGE * fwhm) / block.spacing), 0, s).astype(int)
    high = np.clip(np.ceil((time + EDGE * fwhm) / block.spacing) + 1, 0, s).astype(int)
    return before[row, high] > before[row, low]
