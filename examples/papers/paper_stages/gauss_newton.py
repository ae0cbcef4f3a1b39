"""Undamped Gauss-Newton steps, as Jutzi and Stilla (2005) fit: exact from good starts, lost from bad ones.

The stages of wavebatch damp their steps (Levenberg-Marquardt) and converge from three times as far away
(docs/algorithms.md 1.3).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np

from wavebatch import EchoFlag, EchoTable, Noise, SystemPulse, WaveformBlock, stage
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN
from wavebatch.stages.chain import Range
from wavebatch.stages.decompose.rebuild import MODELS
from wavebatch.stages.decompose.solve import fit_gaussian
from wavebatch.stages.flags import flag_echoes
from wavebatch.stages.pulse_tables import LEAST_WIDTH, MOST_WIDTH

THINNEST = 0.1
"""Width [samples] below which a fit counts as lost: so narrow an echo lies on one sample."""

RIDGE = 1e-12
"""Added to the scaled normal equations, so that echoes in one place can be solved."""

AT_A_TIME = 1 << 21
"""Samples of all derivatives that are held at a time."""


@stage("decompose", fits=fit_gaussian)
def gauss_newton(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    max_iterations: Annotated[int, Range(1, 1000)] = 20,
    tolerance: Annotated[float, Range(0.0, 1e6)] = 0.01,
    significance: Annotated[float, Range(0.0, 1e6)] = 5.0,
) -> EchoTable:  # fmt: skip
    """Sum of Gaussians by undamped Gauss-Newton steps: starts more than one sigma off are lost.

    All echoes of a waveform are fitted together, to all of its samples. A fit that is lost returns its start, flagged
    as not converged. Widths outside of the box of the other decomposers are set to its edge, and flagged.

    Parameters
    ----------
    max_iterations : int
        A fit that has not converged after so many is flagged.
    tolerance : float
        A fit ends with the step that promises a smaller fall of chi2.
    significance : float
        Least energy of an echo [standard deviations of the noise's energy].

    References
    ----------
    Jutzi and Stilla (2005); docs/algorithms.md 1.3.
    """
    count = echoes.count(len(block))
    first = np.cumsum(count) - count
    tables = [(EchoTable.empty(), 0)]
    for k in np.unique(count[count > 0]):
        rows = np.flatnonzero(count == k)
        step = max(AT_A_TIME // int(3 * k * block.samples.shape[1]), 1)
        for begin in range(0, len(rows), step):
            part = rows[begin : begin + step]
            tables.append((_fit(block, noise, echoes, part, first[part][:, None] + np.arange(k), max_iterations,
                                tolerance), 0))  # fmt: skip
    found = EchoTable.concatenate(tables)
    found = found.take(np.lexsort((found.time, found.waveform)))
    energy = found.amplitude.astype(np.float64) ** 2 * found.sigma * np.sqrt(np.pi) / block.spacing
    strong = energy >= (significance * noise.std[found.waveform]) ** 2
    last = (block.samples.shape[1] - 1) * block.spacing
    inside = (found.time >= -0.5 * found.sigma) & (found.time <= last + 0.5 * found.sigma)
    known = np.isfinite(found.time_err) & np.isfinite(found.amplitude_err) & np.isfinite(found.sigma_err)
    found = found.take(np.flatnonzero(strong & inside & known))
    low, high = (np.float32(edge * system.sigma_ref) for edge in (LEAST_WIDTH, MOST_WIDTH))
    found = found.with_flags(EchoFlag.AT_BOUND, (found.sigma < low) | (found.sigma > high))
    found = replace(found, sigma=np.clip(found.sigma, low, high))
    close = (np.diff(found.waveform) == 0) & (np.diff(found.time) < 4 * system.sigma_ref)
    overlapped = np.append(close, False) | np.append(False, close) if len(found) else np.zeros(0, bool)
    return flag_echoes(block, noise, system, found.with_flags(EchoFlag.OVERLAPPED, overlapped))


MODELS["decompose.gauss_newton"] = lambda *_: GAUSSIAN


def _fit(
    block: WaveformBlock,
    noise: Noise,
    echoes: EchoTable,
    rows: np.ndarray,
    member: np.ndarray,
    max_iterations: int,
    tolerance: float,
) -> EchoTable:
    """Echoes of waveforms (m,) with as many echoes each; member: rows of their starts in the table (m, k)."""
    spacing, std = block.spacing, noise.std[rows].astype(np.float64)
    y = (block.samples[rows] - noise.level[rows]).astype(np.float64)
    used = np.ones(y.shape, bool) if block.missing is None else ~block.missing[rows]
    start = np.stack(
        [echoes.amplitude[member], echoes.time[member] / spacing, echoes.sigma[member] / spacing], axis=1
    ).astype(np.float64)
    found, converged = step_undamped(y, start, std, used=used, tolerance=tolerance, max_iterations=max_iterations)
    jacobian, residual = differentiate(y, found, used)
    scale = np.sqrt(np.einsum("mps,mps->mp", jacobian, jacobian))
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = jacobian / scale[:, :, None]
        inverse = np.linalg.pinv(np.nan_to_num(unit @ unit.transpose(0, 2, 1)))
        errors = std[:, None] * np.sqrt(np.maximum(np.einsum("mpp->mp", inverse), 0)) / scale
    misfit = np.sqrt(np.sum(residual**2, axis=1) / np.maximum(used.sum(axis=1), 1)) / std
    amplitude, time, width = found.transpose(1, 0, 2).reshape(3, -1)
    amplitude_err, time_err, width_err = errors.reshape(found.shape).transpose(1, 0, 2).reshape(3, -1)
    k = member.shape[1]
    return EchoTable.build(
        np.repeat(rows, k), time * spacing, amplitude, width * spacing, time_err=time_err * spacing,
        amplitude_err=amplitude_err, sigma_err=width_err * spacing, residual=np.repeat(misfit, k),
        flags=np.repeat(np.where(converged, 0, EchoFlag.NOT_CONVERGED), k),
    )  # fmt: skip


def differentiate(y: np.ndarray, parameters: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of sums of Gaussians, (m, 3 k, s), and what they leave of waveforms, (m, s).

    y : waveforms (m, s) above their baselines [count]; parameters: amplitude [count], time and width [samples], (m, 3,
    k); used: samples that were recorded, bool (m, s).
    """
    amplitude, time, width = parameters.transpose(1, 0, 2)[..., None]
    z = (np.arange(y.shape[1]) - time) / width
    pulse = np.exp(-0.5 * z * z) * used[:, None, :]
    slope = amplitude / width * pulse * z
    residual = (y - np.sum(amplitude * pulse, axis=1)) * used
    return np.concatenate([pulse, slope, slope * z], axis=1), residual


def step_undamped(
    y: np.ndarray,
    start: np.ndarray,
    std: np.ndarray,
    *,
    used: np.ndarray | None = None,
    tolerance: float,
    max_iterations: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Full Gauss-Newton steps without damping or limits.

    Parameters
    ----------
    y : float64 array, shape (m, s)
        Waveforms above their baselines [count].
    start : float64 array, shape (m, 3, k)
        Amplitude [count], time and width [samples].
    std : float array, shape (m,)
        Noise [count].
    used : bool array, shape (m, s), optional
        Samples that were recorded; all by default.
    tolerance : float
        A waveform has converged when its last step promised a fall of chi2 below this.
    max_iterations : int
        Largest number of steps.

    Returns
    -------
    parameters : float64 array, shape (m, 3, k)
        The start itself for fits that are lost: a step led out of the window, or to an impossible amplitude or width.
    converged : bool array, shape (m,)
    """
    used = np.ones(y.shape, bool) if used is None else used
    parameters, converged, index = start.copy(), np.zeros(len(start), bool), np.arange(len(start))
    length = y.shape[1]
    for _ in range(max_iterations):
        jacobian, residual = differentiate(y[index], parameters[index], used[index])
        scale = np.maximum(np.sqrt(np.einsum("mps,mps->mp", jacobian, jacobian)), 1e-300)
        jacobian /= scale[:, :, None]
        gradient = np.einsum("mps,ms->mp", jacobian, residual)
        normal = jacobian @ jacobian.transpose(0, 2, 1) + RIDGE * np.eye(scale.shape[1])
        step = np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
        promise = np.einsum("mp,mp->m", step, gradient) / std[index] ** 2
        reached = parameters[index] + (step / scale).reshape(len(index), *start.shape[1:])
        amplitude, time, width = reached.transpose(1, 0, 2)
        sane = (amplitude > 0) & (width > THINNEST) & (width < length) & (time > -length) & (time < 2 * length)
        lost = ~(sane.all(axis=1) & np.isfinite(reached).all(axis=(1, 2)))
        parameters[index] = np.where(lost[:, None, None], start[index], reached)
        done = ~lost & (promise < tolerance)
        converged[index[done]] = True
        index = index[~(done | lost)]
        if not len(index):
            break
    return parameters, converged
