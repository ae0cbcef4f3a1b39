"""Echoes too close to be resolved: which fits are merged (docs/algorithms.md H1); hidden ones enlarge the errors.

Used after every fit; kernels/c/finish.h merges.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import LEAST_PULSE_WIDTH
from wavebatch.core.waveforms import SystemPulse
from wavebatch.kernels.elementary import interpolate

UNRESOLVED = 0.25
"""Distance, in its errors, below which two echoes of one fit are one, as in kernels/c/decompose.h.

One pair after the other, until no such pair is left. A separate fit on another echo's flank is no evidence about that
echo. The merged echo has the area, mean time and variance of the pair, the errors of the better one, as together they
are as well determined as one echo, and the flag MERGED.
"""

OVERLAP = 2.0
"""Only echoes closer than this many widths of the narrower one are merged: a weak echo further away has a poor time,
but is another echo."""

TWINS = 0.1
"""Two echoes of separate fits that are closer than this many widths are the same echo: the weaker one is left out."""


OFF = 1.4
"""Error of an amplitude, or of a time in widths, over that of a width, where a pulse is too narrow for its samples."""


def cover_hidden(table: EchoTable, system: SystemPulse, n: int) -> EchoTable:
    """Enlarge the errors of times, amplitudes, energies and widths by the effect of neighbours that were not found.

    Parameters
    ----------
    table : EchoTable
        Fitted echoes of n waveforms.
    system : SystemPulse
        With what the survey knows of such neighbours.
    n : int

    Returns
    -------
    EchoTable
        The same echoes.

    Notes
    -----
    An echo that hides another is wider than the pulse. Among echoes of one width the root mean square of their errors
    is right; where no neighbour is hidden the error is too large (docs/algorithms.md 2.2). Amplitudes, energies and
    widths get what 68 % of the echoes of a width stay within: few have a third of their light from another target, and
    the root mean square would be the error of hardly any. Column 1 of the tables is of lone echoes, column 2 of others.
    """
    if not system.hidden:
        return table
    wider = excess_variance(table, system)
    at = np.flatnonzero(wider > 0)  # others hide nothing
    wider, part, alone = wider[at], table.take(at), table.alone(n)[at]
    known = (system.hidden, system.hidden_light, system.hidden_width)
    tables = (np.array(rows or ((0.0, 0.0, 0.0),)) for rows in known)
    late, share, width = (np.where(alone, *interpolate(wider, rows[:, 0], rows[:, 1:]).T) for rows in tables)
    light = share * np.sqrt(wider)  # of amplitude and energy alike
    covered = {
        "time_err": np.sqrt(part.time_err**2 + late * wider * system.sigma_ref**2),
        "amplitude_err": np.hypot(part.amplitude_err, light * part.amplitude),
        "relative_energy_err": np.hypot(part.relative_energy_err, light),
        "sigma_err": np.hypot(part.sigma_err, width * np.sqrt(wider) * part.sigma),
    }
    for name, error in covered.items():
        column = getattr(table, name).copy()
        column[at] = error
        covered[name] = column
    return replace(table, **covered)


def cover_phases(table: EchoTable, system: SystemPulse, spacing: float) -> EchoTable:
    """Enlarge the errors of times, amplitudes and energies where the pulse is too narrow for its samples.

    Parameters
    ----------
    table : EchoTable
        Fitted echoes.
    system : SystemPulse
        With the scatter of the widths of its echoes.
    spacing : float
        Of the samples [ns].

    Returns
    -------
    EchoTable
        The same echoes.

    Notes
    -----
    A pulse below LEAST_PULSE_WIDTH samples is known at no phase: a fit of it has as many free values as samples, and
    what it misses is in these, with the phase. Widths show it, as level targets have one: times and amplitudes are off
    by 1.0 to 1.6 times as much (docs/algorithms.md R3).
    """
    if system.sigma_ref >= LEAST_PULSE_WIDTH * spacing or not system.widths.scatter:
        return table
    share = np.float32(OFF * system.widths.scatter / system.sigma_ref)
    return replace(
        table,
        time_err=np.hypot(table.time_err, share * np.float32(system.sigma_ref)),
        amplitude_err=np.hypot(table.amplitude_err, share * table.amplitude),
        relative_energy_err=np.hypot(table.relative_energy_err, share),
    )


def excess_variance(table: EchoTable, system: SystemPulse) -> np.ndarray:
    """Compute by how much the width of each echo exceeds the system's beyond its error.

    Parameters
    ----------
    table : EchoTable
        m fitted echoes.
    system : SystemPulse

    Returns
    -------
    float64 array, shape (m,)
        Variance over that of the system pulse, less 1 and less its standard deviation.
    """
    sigma, error = table.sigma.astype(np.float64), np.nan_to_num(table.sigma_err.astype(np.float64))
    return (sigma * sigma - 2.0 * sigma * error) / system.sigma_ref**2 - 1.0


def join_tables(*tables: EchoTable) -> EchoTable:
    """Join echoes of the same block into one table, sorted by waveform, then time.

    Parameters
    ----------
    *tables : EchoTable
        With the same columns.

    Returns
    -------
    EchoTable
        All echoes.
    """
    joined = EchoTable.concatenate((table, 0) for table in tables)
    return joined.take(np.lexsort((joined.time, joined.waveform)))
