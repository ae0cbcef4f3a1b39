"""The discrete returns that a vendor's software would have put beside the waveforms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.tools.simulate.render import Recording

WEAKEST = 3.0
"""Echoes below this many standard deviations of the noise give no return."""

DISTINCT = 1.0
"""Echoes closer than this many full widths at half maximum give one return, that of the strongest."""


@dataclass(frozen=True, slots=True, eq=False)
class Returns:
    """Discrete returns sorted by pulse, then time."""

    pulse: np.ndarray
    """Row of the pulse, i8 (k,)."""
    time: np.ndarray
    """True time after sample 0 [ns], f8 (k,)."""
    amplitude: np.ndarray
    """[count], f4 (k,); 0 for the stand-in of a pulse without any."""
    number: np.ndarray
    """Return number from 1, i8 (k,)."""
    total: np.ndarray
    """Number of returns of the pulse, i8 (k,)."""


def list_returns(truth: EchoTable, n: int, recording: Recording, most: int, *, keep_empty: bool) -> Returns:
    """Returns of n pulses: one per distinguishable echo inside the window, at its true time, at most `most` per pulse.

    keep_empty: a pulse without any gets one stand-in return in the middle of its window, else it gets none.
    """
    inside = (truth.time >= 0) & (truth.time <= recording.duration)
    inside &= truth.amplitude >= WEAKEST * recording.recorded_noise
    echoes = truth.take(np.flatnonzero(inside))
    strongest = _pick_strongest(echoes)
    pulse, time = echoes.waveform[strongest].astype(np.int64), echoes.time[strongest]
    amplitude = echoes.amplitude[strongest]
    number = _count_within(pulse)
    keep = number < most
    pulse, time, amplitude = pulse[keep], time[keep], amplitude[keep]
    if keep_empty:
        empty = np.flatnonzero(np.bincount(pulse, minlength=n) == 0)
        pulse = np.concatenate([pulse, empty])
        time = np.concatenate([time, np.full(len(empty), recording.duration / 2)])
        amplitude = np.concatenate([amplitude, np.zeros(len(empty), np.float32)])
        order = np.argsort(pulse, kind="stable")
        pulse, time, amplitude = pulse[order], time[order], amplitude[order]
    total = np.bincount(pulse, minlength=n)[pulse]
    return Returns(pulse, time, amplitude, _count_within(pulse) + 1, total)


def _pick_strongest(echoes: EchoTable) -> np.ndarray:
    """Row of the strongest echo of every run of echoes that a discrete receiver cannot tell apart."""
    if not len(echoes):
        return np.empty(0, np.int64)
    width = FWHM_PER_SIGMA * echoes.sigma
    apart = np.diff(echoes.time) >= DISTINCT * 0.5 * (width[1:] + width[:-1])
    starts = np.concatenate([[True], apart | (np.diff(echoes.waveform) != 0)])
    run = np.cumsum(starts) - 1
    order = np.lexsort((-echoes.amplitude, run))
    return order[np.flatnonzero(starts)]


def _count_within(group: np.ndarray) -> np.ndarray:
    """Position of every row within its run of equal values, from 0."""
    starts = np.flatnonzero(np.concatenate([[True], np.diff(group) != 0])) if len(group) else np.empty(0, np.int64)
    return np.arange(len(group)) - np.repeat(starts, np.diff(np.append(starts, len(group))))
