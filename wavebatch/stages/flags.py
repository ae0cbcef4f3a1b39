"""Flags of echoes that need no fit: weak, cut, narrow, ringing, saturated. Every decomposer sets them at its end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.signal.runs import gap_distance
from wavebatch.stages.pulse_tables import clip_level

NEIGHBOURS = 5
"""Each echo is compared with this many echoes before and after it."""

RINGING_REACH = 12.0
"""Ringing is looked for up to this many system widths after an echo (docs/algorithms.md H7)."""

RINGING_FACTOR = 1.2
"""Echoes up to this many times the strip's ringing may be ringing (docs/algorithms.md H7)."""

TAIL_FACTOR = 1.5
"""An echo must be so many times as high as the measured misfit of a stronger echo's tail at its place."""

LEAST_RATIO = 0.02
"""Share of a stronger neighbour that an echo must exceed: no learned pulse is better known (docs/algorithms.md R3)."""

UNRELIABLE_BELOW = 0.15
"""Below this share of an echo under the digitizer's limit its amplitude is a guess (docs/algorithms.md H6)."""


def flag_echoes(block: WaveformBlock, noise: Noise, system: SystemPulse, table: EchoTable) -> EchoTable:
    """Set the flags WEAK, NEAR_EDGE, NARROW, RINGING_SUSPECT, SATURATED and AMPLITUDE_UNRELIABLE.

    Parameters
    ----------
    block : WaveformBlock
        The waveforms.
    noise : Noise
        Their baselines and noise.
    system : SystemPulse
        Pulse, ringing and saturation level of the strip.
    table : EchoTable
        Echoes of the block.

    Returns
    -------
    EchoTable
        The same echoes with these flags.
    """
    last = (block.samples.shape[1] - 1) * block.spacing
    table = table.with_flags(EchoFlag.WEAK, table.amplitude < 5 * noise.std[table.waveform])
    edge = np.minimum(table.time, last - table.time) < table.sigma
    if block.missing is not None:
        away = gap_distance(block.missing, table.waveform, table.time / block.spacing)
        edge |= away * block.spacing < table.sigma
    table = table.with_flags(EchoFlag.NEAR_EDGE, edge)
    narrow = table.sigma + 3 * np.nan_to_num(table.sigma_err) < system.sigma_ref
    table = table.with_flags(EchoFlag.NARROW, narrow & (table.sigma < 0.93 * system.sigma_ref))
    if system.ringing > 0:
        limit = RINGING_FACTOR * system.ringing
        suspect = _faint_beside(table, limit, 2.0 * system.sigma_ref, RINGING_REACH * system.sigma_ref, before=False)
        table = table.with_flags(EchoFlag.RINGING_SUSPECT, suspect & (table.amplitude > 0))
    return _flag_saturated(block, noise, clip_level(block, system), table)


def drop_unproven(table: EchoTable, system: SystemPulse) -> EchoTable:
    """Drop echoes that are so faint next to a stronger one that an error of the learned pulse explains them.

    Parameters
    ----------
    table : EchoTable
        Fitted echoes.
    system : SystemPulse
        With the components of the learned pulse.

    Returns
    -------
    EchoTable
        The remaining echoes.
    """
    delays = [abs(delay) + 3 * sigma for _, delay, sigma in system.components]
    reach = max([4 * system.sigma_ref, *delays])
    faint = _faint_beside(table, LEAST_RATIO, 0.0, reach, before=True)
    if system.tail_misfit:
        faint |= _explained_by_tails(table, np.array(system.tail_misfit))
    return table.take(np.flatnonzero(~faint))


def _explained_by_tails(table: EchoTable, misfit: np.ndarray) -> np.ndarray:
    """True (m,) for echoes that are no higher than what the pulse leaves unexplained around stronger ones.

    misfit: lag [ns] and share of the strong echo's amplitude, (k, 2), sorted by lag.
    """
    faint = np.zeros(len(table), bool)
    waveform, time, amplitude = table.waveform, table.time, table.amplitude
    # Between two lags that were measured side by side the share is a line; elsewhere nothing is left.
    lags, shares = misfit.T
    width = np.min(np.diff(lags)) if len(lags) > 1 else 0.0
    for step in range(1, min(NEIGHBOURS, len(table) - 1) + 1):
        same = waveform[step:] == waveform[:-step]
        lag = time[step:] - time[:-step]
        for weak, strong, at, place in (
            (amplitude[step:], amplitude[:-step], lag, slice(step, None)),
            (amplitude[:-step], amplitude[step:], -lag, slice(None, -step)),
        ):
            near = np.abs(at[:, None] - lags).min(axis=1) <= 0.6 * width
            limit = np.where(same & near, TAIL_FACTOR * np.interp(at, lags, shares), 0.0)
            faint[place] |= weak < limit * strong
    return faint


def clear_lone(table: EchoTable) -> EchoTable:
    """Clear OVERLAPPED where no other echo of the waveform has it: its partners in the fit were dropped.

    Parameters
    ----------
    table : EchoTable
        Fitted echoes.

    Returns
    -------
    EchoTable
        The same echoes.
    """
    overlapped = (table.flags & np.uint16(EchoFlag.OVERLAPPED)) != 0
    merged = (table.flags & np.uint16(EchoFlag.MERGED)) != 0
    number = np.bincount(table.waveform[overlapped], minlength=int(table.waveform.max(initial=0)) + 1)
    lone = overlapped & ~merged & (number[table.waveform] == 1)
    return replace(table, flags=np.where(lone, table.flags & ~np.uint16(EchoFlag.OVERLAPPED), table.flags))


def _faint_beside(table: EchoTable, ratio: float, nearest: float, furthest: float, *, before: bool) -> np.ndarray:
    """Find echoes below `ratio` of an echo of their waveform that lies nearest..furthest ns before them.

    before: also of an echo that follows within this distance.
    """
    faint = np.zeros(len(table), bool)
    waveform, time, amplitude = table.waveform, table.time, table.amplitude
    for step in range(1, min(NEIGHBOURS, len(table) - 1) + 1):
        gap = time[step:] - time[:-step]
        near = (waveform[step:] == waveform[:-step]) & (gap >= nearest) & (gap <= furthest)
        faint[step:] |= near & (amplitude[step:] < ratio * amplitude[:-step])
        if before:
            faint[:-step] |= near & (amplitude[:-step] < ratio * amplitude[step:])
    return faint


def _flag_saturated(block: WaveformBlock, noise: Noise, level: float, table: EchoTable) -> EchoTable:
    """Flag echoes with clipped samples within 1.5 widths of their centre, and amplitudes that are guesses."""
    rows = np.flatnonzero(np.any(block.samples >= level, axis=1)[table.waveform])
    if not len(rows):
        return table
    sample = np.arange(block.samples.shape[1]) * block.spacing
    near = np.abs(sample - table.time[rows, None]) <= 1.5 * table.sigma[rows, None]
    if block.missing is not None:
        near &= ~block.missing[table.waveform[rows]]
    clipped = ((block.samples[table.waveform[rows]] >= level) & near).any(axis=1)
    saturated = np.zeros(len(table), bool)
    saturated[rows] = clipped
    guess = saturated & (UNRELIABLE_BELOW * table.amplitude > level - noise.baseline[table.waveform])
    table = table.with_flags(EchoFlag.SATURATED, saturated)
    return table.with_flags(EchoFlag.AMPLITUDE_UNRELIABLE, guess)
