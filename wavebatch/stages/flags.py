"""Flags of echoes that need no fit: weak, cut, narrow, ringing, saturated. Every decomposer sets them at its end."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.units import SQRT_PI
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.signal.runs import gap_distance
from wavebatch.stages.pulse_tables import clip_level, fit_misfit

NEIGHBOURS = 5
"""Each echo is compared with this many echoes before and after it."""

RINGING_REACH = 12.0
"""Ringing is looked for up to this many system widths after an echo (docs/algorithms.md H7)."""

RINGING_FACTOR = 1.2
"""Echoes up to this many times the strip's ringing may be ringing (docs/algorithms.md H7)."""

TAIL_FACTOR, FAR_TAIL_FACTOR = 1.5, 2.0
"""An echo must be so many times as high as the measured misfit of a stronger echo's tail at its place. The second one
counts beyond BESIDE, where no component of the pulse reaches: it is measured in steps of a width, and ringing is higher
between them."""

KNOWN = 2.0
"""Errors of its amplitude that an echo must be higher than such a tail: less is the tail and noise. One in forty strong
echoes shows so much; with 3 of them real echoes close behind strong ones are lost (2 % on a strip of GeoLas)."""

CORE, CORE_STD = 4.0, 0.34
"""Distance up to which the misfit of an echo adds to the errors of others [system widths], and standard deviation of
what it leaves, over it: the misfit is 1.4 times the 0.8 quantile of the best of six places, 2.9 for normal values."""

CLEAR, BESIDE = 20.0, 10.5
"""Amplitude, over the noise, of an echo beside which others have larger errors, up to so many system widths away."""

SPAN = 8.0
"""Length of the window in which an echo is fitted [system widths]."""

BEYOND_CHANCE = 4.0
"""Standard deviations of chi2 per sample beyond which it is no chance."""

CLIPPED_TAIL = 0.005
"""Share of a clipped echo that an echo must exceed anywhere in its waveform: tails of echoes beyond the digitizer's
range were never measured, and 0.2 % of four times the range is many times the noise.
"""

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


def drop_unproven(table: EchoTable, system: SystemPulse, top: float = np.inf) -> EchoTable:
    """Drop echoes that are so faint next to a stronger one that an error of its pulse, or of its tail, explains them.

    Parameters
    ----------
    table : EchoTable
        Fitted echoes.
    system : SystemPulse
        With the components of the learned pulse, what is known of it, and the misfit of its tail.
    top : float
        Height above the baseline from which echoes are clipped [count].

    Returns
    -------
    EchoTable
        The remaining echoes.
    """
    faint = np.zeros(len(table), bool)
    if system.components:
        delays = [abs(delay) + 3 * sigma for _, delay, sigma in system.components]
        faint = _faint_beside(table, system.faint_share, 0.0, max([4 * system.sigma_ref, *delays]), before=True)
        clipped = np.where(table.amplitude >= top, CLIPPED_TAIL * table.amplitude, 0)
        for row, other, _ in list_neighbours(table) if clipped.any() else ():
            faint[row] |= table.amplitude[row] < clipped[other]
    if system.tail_misfit:
        for row, other, lag in list_neighbours(table):
            factor = np.where(np.abs(lag) < BESIDE * system.sigma_ref, TAIL_FACTOR, FAR_TAIL_FACTOR)
            tail = _tail_share(system, lag) * table.amplitude[other]
            noise = np.where(tail > 0, KNOWN * np.nan_to_num(table.amplitude_err[row]), 0)
            faint[row] |= table.amplitude[row] < np.maximum(factor * tail, tail + noise)
    return table.take(np.flatnonzero(~faint)) if faint.any() else table


def cover_misfit(table: EchoTable, system: SystemPulse, spacing: float) -> EchoTable:
    """Add to the errors what fits leave unexplained, of the echo itself and of those beside it.

    Parameters
    ----------
    table : EchoTable
        Fitted echoes.
    system : SystemPulse
        With the misfit of its pulse.
    spacing : float
        Time between two samples [ns].

    Returns
    -------
    EchoTable
        The same echoes. What is left beside a strong one, and of its core, counts as noise that moves an amplitude as
        far; errors of a fit that is `find_unexplained` grow with the root of chi2.

    References
    ----------
    docs/algorithms.md R3.
    """
    return scale_errors(table, misfit_factor(table, system, spacing))


def misfit_factor(table: EchoTable, system: SystemPulse, spacing: float) -> np.ndarray:
    """Return by how much errors (m,) are larger than those of noise alone; arguments as for `cover_misfit`."""
    variance = np.zeros(len(table))
    lags, beside = np.array(system.beside or ((0.0, 0.0),)).T
    energy = SQRT_PI * system.sigma_ref / spacing / system.noise.std**2
    for row, other, lag in list_neighbours(table) if system.misfit or system.beside else ():
        core = np.where(np.abs(lag) < CORE * system.sigma_ref, CORE_STD * system.misfit * table.amplitude[other], 0.0)
        strong = (table.amplitude[other] > CLEAR * system.noise.std) & (np.abs(lag) < BESIDE * system.sigma_ref)
        more = energy * core**2 + np.where(strong, np.interp(lag, lags, beside), 0.0)
        variance[row] = np.maximum(variance[row], more)
    return np.sqrt(find_unexplained(table, system, spacing) * (1 + variance))


def use_noise_errors(table: EchoTable, system: SystemPulse, spacing: float) -> EchoTable:
    """Take back the errors of what a fit misses: while a pulse is looked for, that says nothing about an echo.

    Parameters
    ----------
    table, system, spacing
        As for `cover_misfit`, which grew them.

    Returns
    -------
    EchoTable
        The same echoes.
    """
    return scale_errors(table, 1 / np.sqrt(find_unexplained(table, system, spacing)))


def scale_errors(table: EchoTable, factor: np.ndarray) -> EchoTable:
    """Return the echoes (m,) with all errors times `factor`, float (m,)."""
    if (factor == 1).all():
        return table
    factor = factor.astype(np.float32)
    errors = ("time_err", "amplitude_err", "sigma_err", "relative_energy_err")
    return replace(table, **{name: getattr(table, name) * factor for name in errors})


def find_unexplained(table: EchoTable, system: SystemPulse, spacing: float) -> np.ndarray:
    """Find fits that miss their samples by more than noise and the pulse's misfit explain.

    Parameters
    ----------
    table, system, spacing
        As for `cover_misfit`.

    Returns
    -------
    float64 array, shape (m,)
        chi2 per sample of the echo's fit, over what is expected; 1 where chance explains it.
    """
    samples = SPAN * system.sigma_ref / spacing
    energy = table.amplitude.astype(np.float64) ** 2 * table.sigma
    energy = np.bincount(table.waveform, energy)[table.waveform] * SQRT_PI / spacing / system.noise.std**2
    expected = 1 + fit_misfit(system, spacing) ** 2 * energy / samples
    chi2 = np.nan_to_num(table.residual).astype(np.float64) ** 2 / expected
    return np.where(chi2 > 1 + BEYOND_CHANCE * np.sqrt(2 / samples), chi2, 1.0)


def _tail_share(system: SystemPulse, lag: np.ndarray) -> np.ndarray:
    """Share of an echo (k,) that its tail leaves unexplained at these lags [ns].

    It was measured in steps of the pulse's width: a line between two lags at most two steps apart, as a step on a flank
    may not be told from neighbours; elsewhere nothing is left.
    """
    if not system.tail_misfit:
        return np.zeros(len(lag))
    lags, shares = np.array(system.tail_misfit).T
    near = np.abs(lag[:, None] - lags).min(axis=1) <= 0.6 * system.sigma_ref
    after = np.searchsorted(lags, lag)
    between = np.diff(lags, prepend=-np.inf, append=np.inf)[after] < 2.5 * system.sigma_ref
    return np.where(near | between, np.interp(lag, lags, shares), 0.0)


def list_neighbours(table: EchoTable) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """List the echoes that have others in their waveform.

    Parameters
    ----------
    table : EchoTable
        By waveform and time.

    Yields
    ------
    row, other : int64 arrays, shape (k,)
        An echo, and another one of its waveform, up to NEIGHBOURS away.
    lag : float64 array, shape (k,)
        How much later it is than the other [ns].
    """
    for step in range(1, min(NEIGHBOURS, len(table) - 1) + 1):
        first = np.flatnonzero(table.waveform[step:] == table.waveform[:-step])
        lag = table.time[first + step] - table.time[first]
        yield first + step, first, lag
        yield first, first + step, -lag


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
    for row, other, lag in list_neighbours(table):
        gap = np.abs(lag) if before else lag
        near = (gap >= nearest) & (gap <= furthest)
        faint[row] |= near & (table.amplitude[row] < ratio * table.amplitude[other])
    return faint


def _flag_saturated(block: WaveformBlock, noise: Noise, level: float, table: EchoTable) -> EchoTable:
    """Flag echoes with clipped samples within 1.5 widths of their centre, and amplitudes that are guesses."""
    clipped = block.samples >= level
    if block.missing is not None:
        clipped &= ~block.missing
    s = block.samples.shape[1]
    place = np.flatnonzero(clipped)
    is_clipped = np.zeros(len(clipped), bool)
    is_clipped[place // s] = True
    rows = np.flatnonzero(is_clipped[table.waveform])
    if not len(rows):
        return table
    # The first clipped sample after the beginning of an echo must lie before its end. Looked up in the list of clipped
    # samples: echoes x samples would be 4e8 for one waveform of 65,535 samples with spikes.
    place = np.append(place, len(clipped) * s)
    time, reach = table.time[rows], 1.5 * table.sigma[rows]
    low = np.ceil(np.clip((time - reach) / block.spacing, 0, s)).astype(np.int64)
    high = np.floor(np.clip((time + reach) / block.spacing, -1, s - 1)).astype(np.int64)
    start = table.waveform[rows].astype(np.int64) * s
    saturated = np.zeros(len(table), bool)
    saturated[rows] = place[np.searchsorted(place, start + low)] <= start + high
    guess = saturated & (UNRELIABLE_BELOW * table.amplitude > level - noise.baseline[table.waveform])
    table = table.with_flags(EchoFlag.SATURATED, saturated)
    return table.with_flags(EchoFlag.AMPLITUDE_UNRELIABLE, guess)
