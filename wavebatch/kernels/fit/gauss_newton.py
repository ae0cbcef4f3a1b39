"""Undamped Gauss-Newton steps: as fast as Levenberg-Marquardt from good starts, lost from bad ones.

Used by the stage decompose.gauss_newton, which follows Jutzi and Stilla (docs/algorithms.md 1.3).
"""

from __future__ import annotations

import numpy as np

from wavebatch.kernels.fit.least_squares import Windows, evaluate_model
from wavebatch.kernels.fit.normal_equations import add_ridge, gram_matrix, parameter_units, solve_symmetric
from wavebatch.kernels.fit.pulse_shape import PulseShape

LEAST_WIDTH = 0.1
"""Width [samples] below which a fit counts as lost: so narrow an echo lies on one sample."""


def step_undamped(
    windows: Windows, start: np.ndarray, shape: PulseShape, *, tolerance: float, max_iterations: int
) -> tuple[np.ndarray, np.ndarray]:
    """Full Gauss-Newton steps without damping or limits.

    Parameters
    ----------
    windows : Windows
        m problems of one length.
    start : float64 (m, 3, k)
        Amplitude [count], time and width [samples].
    shape : PulseShape
        Model of the pulse.
    tolerance : float
        A problem has converged when its last step promised a fall of chi2 below this.
    max_iterations : int
        Largest number of steps.

    Returns
    -------
    parameters : float64 (m, 3, k)
        The start itself for problems that are lost: a step led out of the window, or to an impossible amplitude or
        width.
    converged : bool (m,)
    """
    parameters, converged = start.copy(), np.zeros(len(start), bool)
    index = np.arange(len(start))
    length = windows.y.shape[1]
    for _ in range(max_iterations):
        rows = evaluate_model(windows, parameters[index], shape)
        gram = gram_matrix(rows)
        gradient = gram[:, :-1, -1]
        step = solve_symmetric(add_ridge(gram[:, :-1, :-1].copy()), gradient)
        promise = np.einsum("mp,mp->m", step, gradient) / windows.std**2
        step = step.reshape(len(index), *start.shape[1:]) * parameter_units(parameters[index], windows.std)
        reached = parameters[index] + step
        amplitude, time, width = reached.transpose(1, 0, 2)
        sane = (amplitude > 0) & (width > LEAST_WIDTH) & (width < length) & (time > -length) & (time < 2 * length)
        lost = ~(sane.all(axis=1) & np.isfinite(reached).all(axis=(1, 2)))
        parameters[index] = np.where(lost[:, None, None], start[index], reached)
        done = ~lost & (promise < tolerance)
        converged[index[done]] = True
        going = np.flatnonzero(~(done | lost))
        if not len(going):
            break
        index, windows = index[going], windows.take(going)
    return parameters, converged
