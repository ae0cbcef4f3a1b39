"""The effect of neighbours that are too close to be found on the times of echoes (docs/algorithms.md 2.2).

The survey calls `measure_hidden` with the echoes of its sample. Before you change it: a strip must get the same numbers
every time, so the seed is fixed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import UNCLEAN, EchoFlag, EchoTable
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.stages.decompose.merge import excess_variance
from wavebatch.surveying.measuring.noise_and_width import FEW
from wavebatch.surveying.measuring.residuals import decompose_sample
from wavebatch.surveying.predict_error import SEED, simulate_again

PAIRS = 1024
"""Pairs that are simulated; a class of widths then holds some tens that were not separated."""

NEAR, FAR = 2.5, 4.0
"""Distances, in widths of the system pulse, from which pairs are found nearly always, and up to which as many echoes
lie in a step of distance as nearer. Pairs are simulated up to FAR."""

CLEAR = 10.0
"""Least amplitude over noise of echoes whose widths are counted."""

LEVEL, AROUND = 64, 24.0
"""Samples, and widths of the pulse, of a simulated waveform: what a level comes from, and FAR with ten widths around
it; longer ones show the same."""

MOST_LOST = 0.7
"""Share of groups of three and more that may hold another hidden echo: beyond, nothing tells how many there are."""

EXCESS = 0.025 * 2.0 ** np.arange(10)
"""Borders of classes of widths: variance over that of the system pulse, less 1."""

_MIDDLE = np.sqrt(2.0) * EXCESS[:-1]
_CUT = UNCLEAN & ~(EchoFlag.OVERLAPPED | EchoFlag.MERGED)


def measure_hidden(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> SystemPulse:
    """Find how far hidden neighbours move echoes, from the strip's own rate of close pairs.

    Parameters
    ----------
    block : WaveformBlock
        A sample of the strip.
    system : SystemPulse
    echoes : EchoTable
        Of the sample.

    Returns
    -------
    SystemPulse
        With `hidden`; unchanged where too few echoes lie close together.

    Notes
    -----
    Pairs with amplitudes and widths of the strip, up to FAR apart, are simulated and decomposed. Those that stay one
    echo are wider than the pulse, and lie off the nearer target. The strip's pairs from NEAR to FAR say how many such
    there are for each class of widths; the strip's echoes of that class say which share of them they are.
    """
    number = echoes.count(len(block))[echoes.waveform]
    lone, others = (_measure_class(block, system, echoes, number, company) for company in (False, True))
    if not (lone.any() or others.any()):
        return system
    # Too few groups of three: another neighbour is then as likely as a first one.
    rows = np.stack([_MIDDLE, lone, others if others.any() else lone], axis=1)
    return replace(system, hidden=tuple(map(tuple, rows.tolist())))


def _measure_class(
    block: WaveformBlock, system: SystemPulse, echoes: EchoTable, number: np.ndarray, company: bool
) -> np.ndarray:
    """Mean square of the shift over the excess variance, of echoes with (company) or without another in their waveform.

    number: echoes in the waveform of each. An echo that hides another was in a waveform with one more.
    """
    nothing, source = np.zeros(len(_MIDDLE)), number > 2 if company else number == 2
    pick = np.flatnonzero(source & ((echoes.flags & np.uint16(_CUT)) == 0))
    near = _count_near(echoes, source, system.sigma_ref)
    if len(pick) < FEW or not near:
        return nothing
    excess, shift = _hide_pairs(block, system, echoes.take(pick))
    expected = near / (FAR - NEAR) * FAR / min(PAIRS, len(block))
    if company:
        # A group with one more, hidden echo looks smaller: its near pair was not counted.
        groups = len(np.unique(echoes.waveform[source]))
        expected /= 1.0 - min(expected * len(excess) / groups, MOST_LOST)
    clear = (echoes.amplitude > CLEAR * system.noise.std) & ((number > 1) if company else (number == 1))
    there = np.histogram(excess_variance(echoes.take(np.flatnonzero(clear)), system), EXCESS)[0]
    hidden = expected * np.histogram(excess, EXCESS)[0]
    moved = expected * np.histogram(excess, EXCESS, weights=shift**2 / np.maximum(excess, EXCESS[0]))[0]
    return moved / np.maximum(np.maximum(there, hidden), 1.0)


def _count_near(echoes: EchoTable, source: np.ndarray, width: float) -> int:
    """Pairs of echoes of one waveform from NEAR to FAR apart."""
    total = 0
    for step in (1, 2, 3):
        gap = (echoes.time[step:] - echoes.time[:-step]) / width
        same = (echoes.waveform[step:] == echoes.waveform[:-step]) & source[step:]
        total += int(np.count_nonzero(same & (gap >= NEAR) & (gap < FAR)))
    return total


def _hide_pairs(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> tuple[np.ndarray, np.ndarray]:
    """Excess variance, and distance to the nearer target [widths of the pulse], of pairs that are found as one echo."""
    rng = np.random.default_rng(SEED)
    block = block.rows(slice(0, PAIRS))
    n, ref = len(block), system.sigma_ref
    length = min(block.samples.shape[1], LEVEL + int(np.ceil(AROUND * ref / block.spacing)))
    half, chosen = 0.5 * FAR * ref * rng.random(n), rng.integers(0, len(echoes), 2 * n)
    middle = block.spacing * (0.5 * length + rng.random(n))
    time = np.stack([middle - half, middle + half], axis=1)
    pairs = EchoTable.build(np.repeat(np.arange(n), 2), time.ravel(), echoes.amplitude[chosen], echoes.sigma[chosen])
    found = decompose_sample(*simulate_again(block, system, pairs, rng, length))
    one = found.alone(n) & (found.amplitude > CLEAR * system.noise.std)
    found = found.take(np.flatnonzero(one))
    shift = np.abs(time[found.waveform] - found.time[:, None]).min(axis=1)
    return excess_variance(found, system), shift / ref

