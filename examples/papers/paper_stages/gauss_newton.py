"""Undamped Gauss-Newton steps, as Jutzi and Stilla (2005) fit: exact from good starts, lost from bad ones.

The stages of wavebatch damp their steps (Levenberg-Marquardt) and converge from three times as far away
(docs/algorithms.md 1.3).
"""

from __future__ import annotations

from typing import Annotated

from wavebatch import EchoTable, Noise, SystemPulse, WaveformBlock, stage
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN
from wavebatch.stages.chain import Range
from wavebatch.stages.decompose.rebuild import MODELS
from wavebatch.stages.decompose.solve import LeastWidth, MostWidth, fit_candidates, fit_gaussian, make_settings
from wavebatch.stages.pulse_tables import LEAST_WIDTH, MOST_WIDTH


@stage("decompose", fits=fit_gaussian)
def gauss_newton(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    max_iterations: Annotated[int, Range(1, 1000)] = 20,
    tolerance: Annotated[float, Range(0.0, 1e6)] = 0.01,
    significance: Annotated[float, Range(0.0, 1e6)] = 5.0,
    least_width: LeastWidth = LEAST_WIDTH,
    most_width: MostWidth = MOST_WIDTH,
) -> EchoTable:  # fmt: skip
    """Sum of Gaussians by undamped Gauss-Newton steps, for comparison: starts more than one sigma off are lost.

    A fit that is lost returns its start, flagged as not converged.

    Parameters
    ----------
    max_iterations : int
        An echo that has not converged after so many is flagged.
    tolerance : float
        A fit ends with the step that promises a smaller fall of chi2.
    significance : float
        Least energy of an echo [standard deviations of the noise's energy].
    least_width : float
        Smallest width of an echo [widths of the system pulse].
    most_width : float
        Largest width of an echo [widths of the system pulse].

    References
    ----------
    Jutzi and Stilla (2005); docs/algorithms.md 1.3.
    """
    settings = make_settings(
        block, system, GAUSSIAN, widths=(least_width, most_width), tolerance=tolerance,
        max_iterations=max_iterations, grow=False, undamped=True,
    )._replace(noise_gain=0.0)  # fmt: skip
    return fit_candidates(block, noise, system, echoes, settings, significance=significance)


MODELS["decompose.gauss_newton"] = lambda *_: GAUSSIAN
