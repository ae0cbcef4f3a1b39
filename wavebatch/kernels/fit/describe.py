"""How long waveforms are to describe with their echoes, and the pulse that all echoes together ask for.

The survey's judge and its learning call it; the loops are C (kernels/c/describe.h).
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np

from wavebatch.core.frozen import NamedTuple
from wavebatch.kernels import library
from wavebatch.kernels.fit.decompose import as_pulse
from wavebatch.kernels.fit.pulse_shape import PulseShape
from wavebatch.kernels.library import call, place

LEAST_LEFT = 0.02
"""Least share of the noise's variance that the two samples before leave open: an estimated correlation may be none."""


class Sums(NamedTuple):
    """n waveforms of s samples, and sums of pulses in them."""

    shape: PulseShape
    first: np.ndarray
    """First echo of each waveform and the number of echoes, int64 (n + 1,)."""
    main: np.ndarray
    """Amplitude, time and width of the pulse's main component [DN, samples], float64 (m, 3)."""
    left: np.ndarray
    """Samples less level and echoes, float32 (n, s) [DN]."""
    model: np.ndarray
    """The echoes, float32 (n, s) [DN]."""
    used: np.ndarray
    """Samples that count, bool (n, s)."""


class SampleNoise(NamedTuple):
    """Noise of a sample."""

    std: float
    """[DN]."""
    gain: float = 0.0
    """Growth of the variance per count of signal [DN]."""
    correlation: tuple[float, ...] = ()
    """Of two samples 1, 2, ... apart; the first two count."""


def render_pulses(shape: PulseShape, n: int, s: int, waveform: np.ndarray, main: np.ndarray) -> np.ndarray:
    """Return the sum of the pulses of each waveform, float32 (n, s) [DN].

    Parameters
    ----------
    shape : PulseShape
    n, s : int
        Waveforms, and samples of each.
    waveform : int (m,)
        Row of each echo, ascending.
    main : float64 (m, 3)
        Amplitude, time and width of the pulse's main component [DN, samples].
    """
    if (waveform[1:] < waveform[:-1]).any():
        raise ValueError("echoes are not sorted by their waveform")
    out = np.empty((n, s), np.float32)
    sums = Sums(shape, count_echoes(waveform, n), main, out, out, np.empty((n, s), bool))  # what is not read
    call("render_pulses", _as_structure(sums, SampleNoise(1.0), 0.0), out)
    return out


def count_echoes(waveform: np.ndarray, n: int) -> np.ndarray:
    """Return the first echo of each of n waveforms, and the number of echoes, int64 (n + 1,)."""
    return np.concatenate(([0], np.cumsum(np.bincount(waveform, minlength=n)))).astype(np.int64, copy=False)


class Left(NamedTuple):
    """What echoes leave of n waveforms, and how the shape of the strongest one of each differs from the pulse."""

    length: np.ndarray
    """For each of k changes of the pulse, float64 (k, n): negative logarithm of the likelihood [nats], by Student's law
    with four degrees of freedom of what the two samples before do not predict; with the cost of the changes."""
    volume: np.ndarray
    """Half the negative logarithm of the determinant of all parameters' correlation matrix [nats], float64 (n,)."""
    change: np.ndarray
    """In two directions, as a share of the echo's energy, by least squares, float64 (n, 2); None where not asked."""
    precision: np.ndarray
    """One over the variance of each; 0 for a waveform without an echo."""


def describe_left(sums: Sums, noise: SampleNoise, changes: Sequence[float], *, strongest: bool = False) -> Left:
    """Return how long the description of what echoes leave is, and how much less their errors say together than alone.

    Parameters
    ----------
    sums : Sums
    noise : SampleNoise
    changes : sequence of float, k of them
        How much the pulse's shape changes from shot to shot, as a share of its amplitude: the three strongest echoes of
        a waveform may leave so much in the two directions (Gauss-Hermite h3 and h4) that follow those of the fit.
    strongest : bool
        Whether the shapes of the strongest echoes are asked for.

    Returns
    -------
    Left

    References
    ----------
    docs/algorithms.md R2.
    """
    tried, n = np.array(changes, np.float64), len(sums.left)
    shapes: Any = np.zeros((2, n, 2)) if strongest else (None, None)
    left = Left(np.zeros((len(tried), n)), np.zeros(n), *shapes)
    call("describe_waveforms", _as_structure(sums, noise, 0.0), ctypes.c_int64(len(tried)), tried, *left)
    return left


def describe_widths(
    ratio: np.ndarray, error: np.ndarray, known: np.ndarray, scatters: Sequence[float], wider: np.ndarray,
    anywhere: float,
) -> np.ndarray:  # fmt: skip
    """Return how long the description of widths is, by a density that falls from the pulse's own width on.

    Parameters
    ----------
    ratio, error : float (m,)
        Widths over the pulse's, and their errors, above 0.
    known : bool (m,)
        Those that tell of the density.
    scatters : sequence of float
        Scatter beyond the errors; the one that serves best is taken.
    wider : float (k,)
        Upper ends of uniform laws from the pulse's own width on, ascending, above 1.
    anywhere : float
        Share of the widths that may be anything up to the last of them.

    Returns
    -------
    float64 (m,)
        Negative logarithm of the density over that of the error [nats]. Shares of the laws are those that make the
        known widths likeliest.

    References
    ----------
    docs/algorithms.md R2.
    """
    columns = [np.ascontiguousarray(column, np.float64) for column in (ratio, error, scatters, wider)]
    (ratio, error, scatter, ends), cost = columns, np.zeros(len(ratio))
    finite = all(np.isfinite(column).all() for column in columns)
    if not (len(ratio) == len(error) == len(known)) or not len(scatter) or not len(ends) or not finite:
        raise ValueError("widths, errors and marks must be as many and finite, scatters and laws at least one")
    if not (error > 0).all() or not (ends > 1).all():
        raise ValueError("the errors of widths must be above 0, and the laws end above 1")
    call(
        "describe_widths", ctypes.c_int64(len(ratio)), ratio, error, np.ascontiguousarray(known, np.bool_),
        ctypes.c_int64(len(scatter)), scatter, ctypes.c_int64(len(ends)), ends, ctypes.c_double(anywhere), cost,
    )  # fmt: skip
    return cost


def gather_pulse(
    sums: Sums, noise: SampleNoise, change: float, delay: np.ndarray, sigma: np.ndarray, reference: float, most: int,
    counted: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return normal equations of a pulse that is a sum of Gaussians, from all echoes of all waveforms.

    Parameters
    ----------
    sums : Sums
    noise : SampleNoise
    change : float
        Misfit that is expected, as a share of the model: it weighs strong echoes down.
    delay, sigma : float64 (k,)
        Of the Gaussians [samples].
    reference : float
        Width of the present pulse's main component [samples]: an echo that is wider is widened by its target.
    most : int
        Echoes of a waveform from which it says nothing of the pulse.
    counted : float
        Weight of errors of the pulse that amplitudes and times of the echoes may absorb.

    Returns
    -------
    matrix : float64 (k + 1, k + 1)
        The last unknown is an offset of all levels.
    right : float64 (k + 1,)
    """
    k = len(delay)
    matrix, right = np.zeros((k + 1, k + 1)), np.zeros(k + 1)
    delay, variance = np.ascontiguousarray(delay, np.float64), np.ascontiguousarray(np.square(sigma), np.float64)
    structure = _as_structure(sums, noise, change)
    call(
        "learn_pulse", structure, ctypes.c_int64(k), delay, variance, ctypes.c_double(reference), ctypes.c_int64(most),
        ctypes.c_double(counted), matrix, right,
    )  # fmt: skip
    return matrix, right


def _as_structure(sums: Sums, noise: SampleNoise, change: float) -> library.CDescribed:
    """The structure, which holds its arrays; raises ValueError where the library would misuse memory."""
    n, s = sums.left.shape
    first = np.ascontiguousarray(sums.first, np.int64)
    columns = np.ascontiguousarray(np.asarray(sums.main, np.float64).T.reshape(3, -1))
    planes = [np.ascontiguousarray(plane, np.float32) for plane in (sums.left, sums.model)]
    used = np.ascontiguousarray(sums.used, np.bool_)
    if {plane.shape for plane in (*planes, used)} != {(n, s)} or first.shape != (n + 1,):
        raise ValueError("residuals, models and echoes are not of the same waveforms")
    if first[0] != 0 or first[-1] != columns.shape[1] or (np.diff(first) < 0).any():
        raise ValueError("the first echoes of the waveforms do not ascend to their number")
    if not np.isfinite(columns).all() or (columns[2] <= 0).any() or not noise.std > 0:
        raise ValueError("echoes must be finite, and widths and noise above 0")
    # Factors of the last two samples that predict the next one best, and the share of the variance that they leave.
    one, two = (*noise.correlation, 0.0, 0.0)[:2]
    ahead, left_over, whole = (one, 0.0), LEAST_LEFT, 1.0 - one * one
    if whole >= LEAST_LEFT:
        ahead = one * (1.0 - two) / whole, (two - one * one) / whole
        left_over = max(1.0 - ahead[0] * one - ahead[1] * two, LEAST_LEFT)
    pulse = as_pulse(sums.shape)
    structure = library.CDescribed(
        n, s, *(place(plane, np.float32) for plane in planes), place(used, np.bool_), place(first, np.int64),
        *(place(column, np.float64) for column in columns), pulse, noise.std**2, noise.gain, change,
        (ctypes.c_double * 2)(*ahead), left_over,
    )  # fmt: skip
    structure.arrays = planes, used, first, columns, pulse
    return structure
