"""Flags of echoes that need no fit: weak, cut, narrow, ringing, saturated. Every decomposer sets them at its end."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import SQRT_PI
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.neighbours import Faintness, Finishing, Flagging, Unexplained, finish_echoes, weigh_fits
from wavebatch.kernels.library import Samples
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

CLIPPED_REACH = 1.5
"""Widths around the centre of an echo in which a clipped sample is its own: a third of its height is left there."""

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
    columns = table.columns() | {"flags": table.flags.copy()}  # these steps change nothing else
    found = finish_echoes(columns, np.arange(len(table)), levels_of(block, noise), flagging(block, system))[0]
    return replace(table, flags=found["flags"])


def levels_of(block: WaveformBlock, noise: Noise) -> Samples:
    """Return raw counts with the one level of each waveform, for flags."""
    return Samples(block.samples, noise.baseline, noise.std, block.missing)


def flagging(block: WaveformBlock, system: SystemPulse) -> Finishing:
    """Return the steps of `flag_echoes`."""
    ref, last = system.sigma_ref, (block.samples.shape[1] - 1) * block.spacing
    law = Flagging(block.spacing, last, ref, 0.93 * ref, clip_level(block, system), CLIPPED_REACH, UNRELIABLE_BELOW)
    ringing = Faintness(RINGING_FACTOR * system.ringing, 2.0 * ref, RINGING_REACH * ref) if system.ringing > 0 else None
    return Finishing(flagging=law, ringing=ringing)


def unproven(system: SystemPulse, top: float = np.inf) -> Faintness | None:
    """Return which echoes are so faint beside a stronger one that an error of its pulse or of its tail explains them.

    Parameters
    ----------
    system : SystemPulse
        With the components of the learned pulse, what is known of it, and the misfit of its tail.
    top : float
        Height above the baseline from which echoes are clipped [DN].

    Returns
    -------
    Faintness, optional
        None where none is.
    """
    if not (system.components or system.tail_misfit):
        return None
    ref, law = system.sigma_ref, Faintness()
    if system.components:
        delays = [abs(delay) + 3 * sigma for _, delay, sigma in system.components]
        law = Faintness(system.faint_share, 0.0, max([4 * ref, *delays]), after=True, top=top, clipped=CLIPPED_TAIL)
    if system.tail_misfit:
        # It was measured in steps of the pulse's width: a line between two lags at most two steps apart, as a step on a
        # flank may not be told from neighbours; elsewhere nothing is left.
        law = law._replace(
            tail=system.tail_misfit, close=0.6 * ref, apart=2.5 * ref, beside=BESIDE * ref, factor=TAIL_FACTOR,
            far_factor=FAR_TAIL_FACTOR, known=KNOWN, after=True,
        )  # fmt: skip
    return law


def unexplained(system: SystemPulse, spacing: float) -> Unexplained:
    """Return what fits leave unexplained, of the echo itself and of those beside it, for errors that cover it.

    What is left beside a strong one, and of its core, counts as noise that moves an amplitude as far; errors of a fit
    that is `find_unexplained` grow with the root of chi2.

    Parameters
    ----------
    system : SystemPulse
        With the misfit of its pulse.
    spacing : float
        Time between two samples [ns].

    Returns
    -------
    Unexplained

    References
    ----------
    docs/algorithms.md R3.
    """
    ref, std, samples = system.sigma_ref, system.noise.std, SPAN * system.sigma_ref / spacing
    return Unexplained(
        core=CORE * ref, misfit=CORE_STD * system.misfit, clear=CLEAR * std, beside=BESIDE * ref,
        energy=SQRT_PI * ref / spacing / std**2, left=system.beside, unit=SQRT_PI, spacing=spacing, variance=std**2,
        misfit2=fit_misfit(system, spacing) ** 2, samples=samples,
        limit=1 + BEYOND_CHANCE * float(np.sqrt(2 / samples)),
    )  # fmt: skip


def leave_beside(system: SystemPulse) -> bool:
    """Whether echoes leave anything beside them that errors of others must cover."""
    return bool(system.misfit or system.beside)


def misfit_factor(table: EchoTable, system: SystemPulse, spacing: float) -> np.ndarray:
    """Return by how much errors of fitted echoes are larger than those of noise alone (m,); else as `unexplained`."""
    missed, variance = weigh_fits(table.columns(), unexplained(system, spacing), others=leave_beside(system))
    return np.sqrt(missed * (1 + variance))


def use_noise_errors(table: EchoTable, system: SystemPulse, spacing: float) -> EchoTable:
    """Take back the errors of what a fit misses: while a pulse is looked for, that says nothing about an echo.

    Parameters
    ----------
    table : EchoTable
        Fitted echoes.
    system, spacing
        As for `unexplained`, by which their errors grew.

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
    table : EchoTable
        Fitted echoes.
    system, spacing
        As for `unexplained`.

    Returns
    -------
    float64 array, shape (m,)
        chi2 per sample of the echo's fit, over what is expected; 1 where chance explains it.
    """
    return weigh_fits(table.columns(), unexplained(system, spacing), others=False)[0]


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
