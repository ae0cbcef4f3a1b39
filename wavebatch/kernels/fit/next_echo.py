"""Where one more echo would explain most: a score test at every sample of the window, and the trials that follow.

Called by `grow` after each fit. A trial is only a start: `grow` keeps it if its fit lowers chi2 enough.
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.units import SQRT_PI
from wavebatch.kernels.fit.least_squares import Fit, Limits, Windows
from wavebatch.kernels.fit.normal_equations import add_ridge, factor_symmetric, parameter_units, substitute_back
from wavebatch.kernels.fit.problem import Problem, Settings
from wavebatch.kernels.fit.residual_test import find_misfits, hermite_moments
from wavebatch.kernels.signal.filters import gaussian_taps

LEAST_NEW = 0.03
"""Smallest share of a new echo's energy that the present echoes must leave unexplained; other places are not tried."""


def _correlate(rows: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Rows (..., L) correlated along L with symmetric taps (centre first), zero outside."""
    reach, length = len(taps) - 1, rows.shape[-1]
    padded = np.zeros((*rows.shape[:-1], length + 2 * reach), np.float32)
    padded[..., reach : reach + length] = rows
    total = np.float32(taps[0]) * rows
    for i in range(1, reach + 1):
        pair = padded[..., reach - i : reach - i + length] + padded[..., reach + i : reach + i + length]
        pair *= np.float32(taps[i])
        total += pair
    return total


def propose_echo(
    windows: Windows, parameters: np.ndarray, rows: np.ndarray, gram: np.ndarray, limits: Limits, width: float
) -> tuple[np.ndarray, np.ndarray]:
    """The best new echo of a given width for each fit.

    Parameters
    ----------
    windows : Windows
        m problems of length L.
    parameters : float64 (m, 3, k)
        Of the fit, at or near its minimum.
    rows : float32 (m, 3 k + 1, L)
        Rows of the fit.
    gram : float64 (m, 3 k + 1, 3 k + 1)
        Their products.
    limits : Limits
        Box of the parameters.
    width : float, samples
        Width of the new echo.

    Returns
    -------
    start : float64 (m, 3, k + 1)
        Start parameters with the new echo last.
    promise : float64 (m,)
        Fall of chi2 that it promises.

    Notes
    -----
    At every sample the new pulse is projected out of the span of the present echoes' derivatives. The rest, correlated
    with the residual, gives the linearised fall of chi2, the new amplitude and the correction of the present
    parameters: one Gauss-Newton step in which the new amplitude starts at zero (docs/algorithms.md 2.3).
    """
    m, _, k = parameters.shape
    taps = gaussian_taps(width)
    inside = (windows.x >= 0).astype(np.float32)
    spread = _correlate(rows, taps)
    energy = _correlate(inside, taps**2)
    lower, pivot, right = factor_symmetric(add_ridge(gram[:, :-1, :-1].copy()), gram[:, :-1, -1])
    # What the new pulse has in common with the present ones is taken off, row by row of the factorised equations.
    onto, left = spread[:, -1], energy.copy()
    for i in range(3 * k):
        for j in range(i):
            spread[:, i] -= lower[:, i, j].astype(np.float32)[:, None] * spread[:, j]
        share = spread[:, i] * (1 / pivot[:, i]).astype(np.float32)[:, None]
        left -= share * spread[:, i]
        onto -= share * right[:, i].astype(np.float32)[:, None]
    usable = (left > np.float32(LEAST_NEW) * energy.max(axis=1, keepdims=True)) & (inside > 0)
    amplitude = np.where(usable, np.maximum(onto, 0) / np.where(usable, left, np.float32(1)), np.float32(0))
    score = amplitude**2 * left
    place = np.argmax(score, axis=1)
    problem = np.arange(m)
    new = amplitude[problem, place].astype(np.float64)
    explained = substitute_back(lower, spread[problem, :-1, place] / pivot)
    change = -(explained * new[:, None]).reshape(m, 3, k) * parameter_units(parameters, windows.std)
    start = np.empty((m, 3, k + 1))
    start[:, 0, :k] = np.maximum(parameters[:, 0] + change[:, 0], 0.2 * parameters[:, 0])
    start[:, 1, :k] = parameters[:, 1] + np.clip(change[:, 1], -width, width)
    start[:, 2, :k] = parameters[:, 2] + np.clip(change[:, 2], -0.4 * parameters[:, 2], 0.3 * parameters[:, 2])
    start[:, :, k] = np.stack([new, place.astype(np.float64), np.full(m, width)], axis=1)
    promise = score[problem, place] / windows.std**2
    _split_flat(start, promise, windows, parameters, rows, width)
    return np.clip(start, limits.low, limits.high), promise


def _split_flat(
    start: np.ndarray, promise: np.ndarray, windows: Windows, parameters: np.ndarray, rows: np.ndarray, width: float
) -> None:
    """Replaces one echo by two where its residual shows that its top is too flat, in place (docs/algorithms.md 2.3).

    No single new echo can flatten a top: the score test does not see two close echoes of similar strength. They leave
    h4 < 0, and h3^2 + h4^2 is the fall of chi2 that the split promises; it is taken where it promises more.
    """
    h3, h4 = hermite_moments(windows, parameters, rows)
    gain = np.where(h4 < 0, h3 * h3 + h4 * h4, 0.0)
    echo = np.argmax(gain, axis=1)
    at = np.flatnonzero(gain[np.arange(len(gain)), echo] > promise)
    if not len(at):
        return
    echo = echo[at]
    amplitude, time, broad = parameters[at, :, echo].T
    narrow = np.minimum(broad, 1.1 * width)
    apart = np.maximum(np.sqrt(broad**2 - narrow**2), 0.5 * broad)
    half = 0.5 * amplitude * broad / narrow
    start[at, :, :-1] = parameters[at]
    start[at, :, echo] = np.stack([half, time - apart, narrow], axis=1)
    start[at, :, -1] = np.stack([half, time + apart, narrow], axis=1)
    promise[at] = gain[at, echo]


def propose_trials(
    settings: Settings, windows: Windows, fit: Fit, accepted: np.ndarray, begin: np.ndarray, limits: Limits
) -> Problem | None:
    """Trials with one echo more for the fits that leave something unexplained.

    Parameters
    ----------
    settings : Settings
        Limits of growth.
    windows, fit : Windows, Fit
        m problems and their fit.
    accepted : bool (m,)
        Fits that may grow; those that have not converged may not.
    begin : int (m,)
        Sample at which each window begins.
    limits : Limits
        Arrays (m, 3, 1).

    Returns
    -------
    Problem or None
        Times in samples of the waveform; `cluster` holds rows of the fit. None without trials.
    """
    if not settings.grow or fit.parameters.shape[2] >= settings.max_echoes or not accepted.any():
        return None
    misfit = find_misfits(windows, fit.parameters, fit.rows, settings.gate_residual, settings.gate_hermite)
    at = np.flatnonzero(misfit & accepted)
    if not len(at):
        return None
    box = Limits(limits.low[at], limits.high[at])
    start, gain = propose_echo(
        windows.take(at), fit.parameters[at], fit.rows[at], fit.gram[at], box, settings.width_ref
    )
    least = _least_fall(settings, windows.std[at], fit.parameters[at])
    hopeful = gain > 0.5 * least
    at, start, least = at[hopeful], start[hopeful], least[hopeful]
    if not len(at):
        return None
    start[:, 1] += begin[at][:, None]
    return Problem(at, start, fit.cost[at] - least)


def _least_fall(settings: Settings, std: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Fall of chi2 (m,) that one more echo needs: the acceptance, plus what a misfit of the pulse model may explain."""
    amplitude, _, width = parameters.transpose(1, 0, 2)
    energy = SQRT_PI * (amplitude * amplitude * width).sum(axis=1) / (std * std)
    return settings.acceptance + settings.misfit**2 * energy
