"""True echoes in the terms of found ones, and the Cramer-Rao bound of each: the least error with which it can be found.

`accuracy` calls both for every group. The bounds hold for the pulse, noise and clipping of the simulated receiver; the
closed forms of kernels.fit.bounds hold for isolated Gaussians in white noise only.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import FWHM_PER_SIGMA, QUANTISATION_STD
from wavebatch.kernels.signal.runs import lobe_edges
from wavebatch.kernels.signal.signal import SMOOTH_GAIN
from wavebatch.tools.simulate.pulses import PulseModel, main_lobe, spread_lobes
from wavebatch.tools.simulate.render import Recording, paint_echoes

_GRID = 49
_STEP = 0.02
"""Step of the numeric derivatives, in widths of the system pulse."""


def describe_truth(truth: EchoTable, pulse: PulseModel) -> EchoTable:
    """The truth with, as sigma, the full width at half maximum over 2.354820.

    Simulation gives the sigma of the main lobe; decomposers report that of the whole pulse. For a Gaussian they are
    equal.
    """
    return replace(truth, sigma=_measure(pulse, truth.sigma.astype(np.float64)).astype(np.float32))


def effective_noise(recording: Recording) -> float:
    """Standard deviation of one sample [count] of white noise that disturbs an echo as much as the recorded noise.

    Coloured noise: std of the [1 2 1]/4-smoothed samples over the gain for white noise (docs/algorithms.md H11).
    """
    smoothed = np.sqrt(smoothed_power(recording.color) / 16) / SMOOTH_GAIN
    return float(np.hypot(recording.noise_std * smoothed, QUANTISATION_STD))


def smoothed_power(color: np.ndarray | int) -> np.ndarray | float:
    """Variance of noise smoothed by [1 2 1], over that of its samples; color: as Recording.color."""
    first, second = color / (color + 1), color * (color - 1) / ((color + 1) * (color + 2))
    return 6 + 8 * first + 2 * second


def find_bounds(recording: Recording, truth: EchoTable, n: int) -> np.ndarray:
    """Cramer-Rao bounds of time [ns], amplitude [count] and sigma [ns] of every true echo, (m, 3).

    All echoes of a waveform are estimated together, the baseline is known; clipped samples have no weight, noise grows
    with the signal. truth: as tools.simulate gives it; the bounds are those of the terms of `describe_truth`, infinite
    where the samples do not determine them. Source: inverse Fisher matrix, derivatives of the painted pulse by central
    differences.
    """
    if not len(truth):
        return np.empty((0, 3))
    columns, painted = _differentiate(recording, truth)
    weight = _weigh(recording, truth, painted, n)
    columns *= weight[truth.waveform][:, None, :]
    bounds = np.full((len(truth), 3), np.inf)
    count = truth.count(n)
    first = np.cumsum(count) - count
    for k in np.unique(count[count > 0]):
        rows = first[count == k][:, None] + np.arange(k)
        bounds[rows] = _invert(columns[rows].reshape(len(rows), 3 * k, -1)).reshape(len(rows), k, 3)
    return bounds


def _differentiate(recording: Recording, truth: EchoTable) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of each echo alone by time, amplitude and sigma, (m, 3, s), and the echo, (m, s)."""
    rows = np.arange(len(truth))
    amplitude, sigma = truth.amplitude.astype(np.float64), truth.sigma.astype(np.float64)

    def paint(time: np.ndarray, width: np.ndarray) -> np.ndarray:
        return paint_echoes(recording, len(truth), rows, time, amplitude, width)

    step = _STEP * recording.pulse.sigma
    echo = paint(truth.time, sigma)
    by_time = (paint(truth.time + step, sigma) - paint(truth.time - step, sigma)) / (2 * step)
    wider, narrower = sigma + step, sigma - step
    grown = _measure(recording.pulse, wider) - _measure(recording.pulse, narrower)
    by_sigma = (paint(truth.time, wider) - paint(truth.time, narrower)) / np.maximum(grown, 1e-9)[:, None]
    return np.stack([by_time, echo / amplitude[:, None], by_sigma], axis=1).astype(np.float64), echo


def _weigh(recording: Recording, truth: EchoTable, painted: np.ndarray, n: int) -> np.ndarray:
    """Inverse standard deviation of every sample, 0 where it is clipped, (n, s)."""
    signal = np.zeros((n, recording.n_samples))
    np.add.at(signal, truth.waveform, painted)
    variance = effective_noise(recording) ** 2 + recording.noise_gain * np.maximum(signal, 0)
    return np.where(signal + recording.baseline < recording.clip, 1 / np.sqrt(variance), 0.0)


def _invert(columns: np.ndarray) -> np.ndarray:
    """Standard deviations (g, p) from weighted derivatives (g, p, s)."""
    scale = np.sqrt(np.square(columns).sum(axis=2))
    columns = columns / np.where(scale > 0, scale, 1.0)[:, :, None]
    values, vectors = np.linalg.eigh(columns @ columns.transpose(0, 2, 1))
    # Scaled columns: the diagonal is 1, so that eigenvalues show how well the parameters can be separated.
    values = np.where(values > 1e-11, values, np.nan)
    variance = (np.square(vectors) / values[:, None, :]).sum(axis=2)
    known = ~np.isnan(variance) & (scale > 0)
    return np.where(known, np.sqrt(np.where(known, variance, 1.0)) / np.where(scale > 0, scale, 1.0), np.inf)


def _measure(pulse: PulseModel, sigma: np.ndarray) -> np.ndarray:
    """Full width at half maximum over 2.354820 of true echoes [ns], (m,)."""
    if not pulse.lobes:
        skew = abs(pulse.kappa)
        wider = 2 * np.sinh(skew * FWHM_PER_SIGMA / 2) / (skew * FWHM_PER_SIGMA) if skew > 1e-6 else 1.0
        return sigma * wider
    if not len(sigma):
        return sigma
    grid = np.linspace(sigma.min(), max(sigma.max(), 1.001 * sigma.min()), _GRID)
    step = grid[0] / 100
    x = np.arange(-int(4 * grid[-1] / step), int(6 * grid[-1] / step))[:, None] * step
    ones = np.ones(_GRID)
    total = np.zeros((len(x), _GRID))
    for number, (start, height, width) in enumerate(spread_lobes(pulse, 0 * ones, ones, grid)):
        total += height * main_lobe((x - start) / width, pulse.kappa if number == 0 else 0.0)
    edges = np.array([lobe_edges(x[:, 0], curve, 0.5 * curve.max()) for curve in total.T])
    return np.interp(sigma, grid, np.diff(edges, axis=1)[:, 0] / FWHM_PER_SIGMA)
