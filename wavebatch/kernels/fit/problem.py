"""The types of a decomposition: its settings, the clusters to fit, and the solutions found.

`grow` and `next_echo` pass them to each other; stages/decompose makes Settings and reads Solution. All widths and times
are in samples.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.kernels.fit.least_squares import WidthPrior
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape


class Settings(NamedTuple):
    """Options of a decomposition; widths in samples."""

    width_ref: float
    """Width of the system pulse: that of new echoes."""
    width_low: float
    """Smallest width allowed."""
    width_high: float
    """Largest width allowed."""
    shape: PulseShape = GAUSSIAN
    """Model of the pulse."""
    clip: float | None = None
    """Raw count from which samples are clipped; None where none is."""
    noise_gain: float = 0.0
    """Noise variance per count of signal (docs/algorithms.md H12) [count]."""
    tolerance: float = 1e-2
    """A fit has converged when the next step promises a fall of chi2 below this."""
    max_iterations: int = 40
    """Largest number of iterations of one fit."""
    grow: bool = True
    """Whether echoes are added where the residual shows more than noise."""
    acceptance: float = 15.0
    """Smallest fall of chi2 for which an echo is added (docs/algorithms.md 2.3)."""
    misfit: float = 0.0
    """Deviation of the pulse from its model as a share of the amplitude: raises the acceptance of strong echoes."""
    max_echoes: int = 6
    """Largest number of echoes of one cluster that growth may reach."""
    prior: WidthPrior | None = None
    """Prior on the widths of overlapping echoes; None for none."""
    gate_residual: float = 4.2
    """Limit of the smoothed residual [noise standard deviations] (docs/algorithms.md 4.2)."""
    gate_hermite: float = 8.5
    """Limit of h3^2 + h4^2 (docs/algorithms.md 4.2)."""


class Solution(NamedTuple):
    """Echoes of c clusters with k echoes each."""

    cluster: np.ndarray
    """Number of the cluster, int64 (c,)."""
    parameters: np.ndarray
    """Amplitude [count], time [samples of the waveform], width [samples], float64 (c, 3, k)."""
    errors: np.ndarray
    """One standard deviation of each parameter, float64 (c, 3, k)."""
    shared: np.ndarray
    """Covariance of amplitude and width, and of time and width, of each echo, float64 (c, 2, k)."""
    misfit: np.ndarray
    """Root mean square residual in noise standard deviations, float64 (c,)."""
    cost: np.ndarray
    """chi2 plus prior, float64 (c,)."""
    converged: np.ndarray
    """bool (c,)."""
    at_bound: np.ndarray
    """Whether a parameter of the echo lies on its bound, bool (c, k)."""

    def take(self, rows: np.ndarray) -> Solution:
        """The clusters at `rows`."""
        return Solution(*(field[rows] for field in self))


class Problem(NamedTuple):
    """Clusters to fit with k echoes: from candidates, or trials that must beat the solution they came from."""

    cluster: np.ndarray
    """Number of the cluster, int64 (c,)."""
    start: np.ndarray
    """Start parameters, float64 (c, 3, k), times in samples of the waveform."""
    target: np.ndarray
    """chi2 that the fit must fall below, float64 (c,); inf for clusters without an earlier solution."""

    def take(self, rows: np.ndarray) -> Problem:
        """The clusters at `rows`."""
        return Problem(*(field[rows] for field in self))
