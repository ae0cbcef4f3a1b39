"""Undamped Gauss-Newton steps, as Jutzi and Stilla (2005) fit: exact from good starts, lost from bad ones.

The stages of wavebatch damp their steps (Levenberg-Marquardt) and converge from three times as far away
(docs/algorithms.md 1.3).
"""

from __future__ import annotations

from dataclasses import replace

from wavebatch import EchoTable, Noise, SystemPulse, WaveformBlock, stage
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN
from wavebatch.stages.decompose.solve import FitOptions, fit_candidates, fit_gaussian, make_settings

_FIT = FitOptions(max_iterations=20, tolerance=0.01)


@stage("decompose", fits=fit_gaussian, shares=_FIT)
def gauss_newton(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, **options: float
) -> EchoTable:
    """Sum of Gaussians by undamped Gauss-Newton steps, for comparison: starts more than one sigma off are lost.

    A fit that is lost returns its start, flagged as not converged.

    References
    ----------
    Jutzi and Stilla (2005); docs/algorithms.md 1.3.
    """
    fit = replace(_FIT, **options)
    settings = make_settings(block, system, GAUSSIAN, fit, grow=False, undamped=True)._replace(noise_gain=0.0)
    return fit_candidates(block, noise, system, echoes, settings, significance=fit.significance)
