"""X"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.kernels.fit.least_squares import WidthPrior
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape


class Settings(NamedTuple):
    """What a decomposition may do; widths in samples."""

    width_ref: float
    width_low: float
    width_high: float
    shape: PulseShape = GAUSSIAN
    clip: float | None = None
    noise_gain: float = 0.0
    tolerance: float = 1e-2
    max_iterations: int = 40
    grow: bool = True
    acceptance: float = 15.0
    misfit: float = 0.0
    max_echoes: int = 6
    prior: WidthPrior | None = None
    gate_residual: float = 4.2
    gate_hermite: float = 8.5


class Solution(NamedTuple):
    """Echoes of c clusters with k echoes each; times in samples of the waveform."""

    cluster: np.ndarray
    """(c,)."""
    parameters: np.ndarray
    """Amplitude, time, width (c, 3, k)."""
    errors: np.ndarray
    """(c, 3, k)."""
    misfit: np.ndarray
    """Root mean square residual in noise standard deviations (c,)."""
    cost: np.ndarray
    """chi2 and prior (c,)."""
    converged: np.ndarray
    """(c,)."""
    at_bound: np.ndarray
    """(c, k)."""

    def take(self, rows: np.ndarray) -> Solution:
        """The clusters at `rows`."""
        return Solution(*(field[rows] for field in self))


class Problem(NamedTuple):
    """Clusters to fit with k echoes: from candidates, or as trials that must beat the solution they came from."""

    cluster: np.ndarray
    """(c,)."""
    start: np.ndarray
    """(c, 3, k), times in samples of the waveform."""
    target: np.ndarray
    """chi2 that the fit must fall below; inf for clusters without an earlier solution (c,)."""

    def take(self, rows: np.ndarray) -> Problem:
        """The clusters at `rows`."""
        return Problem(*(field[rows] for field in self))
