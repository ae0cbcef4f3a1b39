"""Decomposers for comparison: other pulse models, and Gauss-Newton steps without damping."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.cluster import Candidates, Clusters, cut_windows
from wavebatch.kernels.fit.gauss_newton import step_undamped
from wavebatch.kernels.fit.grow import Settings, Solution, decompose_clusters
from wavebatch.kernels.fit.least_squares import batch_size, evaluate_model
from wavebatch.kernels.fit.normal_equations import fit_errors, gram_matrix
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape, evaluate_pulse, tabulate_pulse
from wavebatch.stages.chain import Range, stage
from wavebatch.stages.decompose.fit import describe_solutions, fit_candidates, make_settings
from wavebatch.stages.decompose.group import find_clusters
from wavebatch.stages.pulse_tables import pulse_shape, shape_limits
from wavebatch.stages.reference_pulse import reference_pulse

POWERS = (1.4, 1.7, 2.0, 2.4, 3.0, 4.0)
"""Exponents of the generalized Gaussian that are tried for every cluster."""


@stage("decompose")
def skewed(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    kappa: Annotated[float, Range(-1.0, 1.0)] = 0.0,
    max_iterations: Annotated[int, Range(1, 1000)] = 40,
    tolerance: Annotated[float, Range(0.0, 1e6)] = 0.5,
    significance: Annotated[float, Range(0.0, 1e6)] = 5.0,
) -> EchoTable:  # fmt: skip
    """Sum of skewed pulses: the log-normal of Wang et al. with one skew for the sensor, in its stable form.

    The time is that of the peak.

    Parameters
    ----------
    kappa : float
        Skew; 0 takes the value of the survey.
    max_iterations : int
        An echo that has not converged after so many is flagged.
    tolerance : float
        A fit ends with the step that promises a smaller fall of chi2.
    significance : float
        Least energy of an echo [standard deviations of the noise's energy].

    References
    ----------
    Wang, Wang and Tseng eq. 2; docs/algorithms.md 0, 1.2.
    """
    shape = skewed_shape(system, kappa)
    settings = make_settings(block, system, shape, tolerance=tolerance, max_iterations=max_iterations, grow=False)
    return fit_candidates(block, noise, system, echoes, settings, significance=significance)


def skewed_shape(system: SystemPulse, kappa: float) -> PulseShape:
    """Return the pulse that `skewed` fits.

    Parameters
    ----------
    system : SystemPulse
        Result of the survey.
    kappa : float
        Skew; 0 takes the value of the survey.

    Returns
    -------
    PulseShape
        Skewed, or Gaussian where the skew is negligible.
    """
    return pulse_shape(replace(system, components=(), kappa=kappa or system.kappa), 1.0)


@stage("decompose")
def reference(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    model: Literal["broadened", "stretched", "given"] = "broadened",
    pulse: str = "",
    max_iterations: Annotated[int, Range(1, 1000)] = 40,
    tolerance: Annotated[float, Range(0.0, 1e6)] = 0.5,
    significance: Annotated[float, Range(0.0, 1e6)] = 5.0,
) -> EchoTable:  # fmt: skip
    """Sum of system pulses, broadened by a Gaussian target or stretched in time; no echo is added.

    Time and amplitude are those of the pulse's peak, the width is its full width at half maximum over 2.354820.

    Parameters
    ----------
    model : {"broadened", "stretched", "given"}
        `broadened` for the survey's pulse convolved with a Gaussian, `stretched` for it as a table stretched in time,
        `given` for the pulse below, stretched.
    pulse : str
        Samples of the given pulse, separated by spaces, with the spacing of the waveform.
    max_iterations : int
        An echo that has not converged after so many is flagged.
    tolerance : float
        A fit ends with the step that promises a smaller fall of chi2.
    significance : float
        Least energy of an echo [standard deviations of the noise's energy].

    References
    ----------
    docs/algorithms.md R1; Mallet and Bretar (2009).
    """
    shape = reference_shape(system, block.spacing, model, pulse)
    settings = make_settings(block, system, shape, tolerance=tolerance, max_iterations=max_iterations, grow=False)
    if model != "broadened":
        system = replace(system, components=())
    return fit_candidates(block, noise, system, echoes, settings, significance=significance)


def reference_shape(system: SystemPulse, spacing: float, model: str, pulse: str) -> PulseShape:
    """Return the pulse that `reference` fits.

    Parameters
    ----------
    system : SystemPulse
        Result of the survey.
    spacing : float
        Time between two samples [ns].
    model, pulse : str
        As for `reference`.

    Returns
    -------
    PulseShape
        Pulse for the kernels.
    """
    shape = pulse_shape(system, spacing)
    if model == "stretched":
        return _tabulate_system(system, shape, spacing)
    if model == "given":
        taps, _ = reference_pulse(system, spacing, "given", pulse=pulse)
        return PulseShape(table=tabulate_pulse(np.arange(len(taps), dtype=np.float64), taps))
    return shape


def _tabulate_system(system: SystemPulse, shape: PulseShape, spacing: float) -> PulseShape:
    """Tabulate the survey's pulse."""
    ref = shape_limits(system, spacing).ref
    ends = [-6 * ref, 6 * ref]
    for _, delay, extra in shape.components:
        wide = 5 * np.sqrt(ref * ref + extra)
        ends = [min(ends[0], delay - wide), max(ends[1], delay + wide)]
    x = np.arange(ends[0], ends[1], ref / 16)
    value = evaluate_pulse(shape, x[:, None].copy(), np.zeros(1), np.full(1, ref))[0][:, 0]
    return PulseShape(table=tabulate_pulse(x, value))


@stage("decompose")
def generalized_gaussian(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    max_iterations: Annotated[int, Range(1, 1000)] = 40,
    tolerance: Annotated[float, Range(0.0, 1e6)] = 0.5,
    significance: Annotated[float, Range(0.0, 1e6)] = 5.0,
) -> EchoTable:  # fmt: skip
    """Sum of generalized Gaussians exp(-|z|^p / 2); the exponent is chosen for each cluster of echoes.

    Exponents from 1.4 (peaked) over 2 (Gaussian) to 4 (flat) are tried, the least chi2 wins. The width is the full
    width at half maximum over 2.354820.

    Parameters
    ----------
    max_iterations : int
        An echo that has not converged after so many is flagged.
    tolerance : float
        A fit ends with the step that promises a smaller fall of chi2.
    significance : float
        Least energy of an echo [standard deviations of the noise's energy].

    References
    ----------
    Chauve et al. (2007), eq. 4.
    """
    plain = make_settings(block, system, GAUSSIAN, tolerance=tolerance, max_iterations=max_iterations, grow=False)
    candidates, clusters = find_clusters(block, noise, system, echoes, plain)
    best = np.full(len(clusters.number), np.inf)
    chosen = np.zeros(len(best), np.int64)
    found: list[list[Solution]] = []
    for number, power in enumerate(POWERS):
        factor = half_width_factor(power)
        widths = {name: getattr(plain, name) / factor for name in ("width_ref", "width_low", "width_high")}
        settings = plain._replace(shape=PulseShape(power=power), **widths)
        solutions = decompose_clusters(
            block.samples, noise.for_fits, noise.std, candidates, clusters, settings, block.missing
        )
        found.append([_as_half_width(solution, factor) for solution in solutions])
        for solution in found[-1]:
            better = solution.cost < best[solution.cluster]
            best[solution.cluster[better]] = solution.cost[better]
            chosen[solution.cluster[better]] = number
    kept = [
        solution.take(np.flatnonzero(chosen[solution.cluster] == number))
        for number, solutions in enumerate(found)
        for solution in solutions
    ]
    return describe_solutions(block, noise, system, clusters, kept, plain, significance)


def half_width_factor(power: float) -> float:
    """Return the full width at half maximum of exp(-|z|^p / 2) over 2.354820.

    Parameters
    ----------
    power : float
        Exponent p.

    Returns
    -------
    float
        1 for a Gaussian.
    """
    return float(2 * (2 * np.log(2)) ** (1 / power) / FWHM_PER_SIGMA)


@stage("decompose")
def gauss_newton(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    max_iterations: Annotated[int, Range(1, 1000)] = 20,
    tolerance: Annotated[float, Range(0.0, 1e6)] = 0.01,
    significance: Annotated[float, Range(0.0, 1e6)] = 5.0,
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

    References
    ----------
    Jutzi and Stilla (2005); docs/algorithms.md 1.3.
    """
    settings = make_settings(block, system, GAUSSIAN, tolerance=tolerance, max_iterations=max_iterations, grow=False)
    candidates, clusters = find_clusters(block, noise, system, echoes, settings)
    found = [_solve_undamped(block, noise, candidates, clusters, rows, settings) for rows in _alike(clusters, block)]
    return describe_solutions(block, noise, system, clusters, found, settings, significance)


def _alike(clusters: Clusters, block: WaveformBlock) -> Iterator[np.ndarray]:
    """Batches of clusters with the same number of echoes and windows of about the same length."""
    length = np.minimum(-(-(clusters.high - clusters.low) // 8) * 8, block.samples.shape[1])
    kind = clusters.number * (1 << 32) + length
    order = np.argsort(kind, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(kind[order])) + 1) if len(order) else []:
        size = batch_size(int(clusters.number[group[0]]), int(length[group[0]]))
        yield from (group[begin : begin + size] for begin in range(0, len(group), size))


def _solve_undamped(
    block: WaveformBlock, noise: Noise, candidates: Candidates, clusters: Clusters, rows: np.ndarray, settings: Settings
) -> Solution:
    low, high = clusters.low[rows], clusters.high[rows]
    length = min(-(-int((high - low).max()) // 8) * 8, block.samples.shape[1])
    windows, begin = cut_windows(
        block.samples, noise.for_fits, noise.std, clusters.waveform[rows], low, high, length, settings.clip,
        missing=block.missing,
    )
    member = clusters.first[rows][:, None] + np.arange(clusters.number[rows[0]])
    start = np.stack([candidates.amplitude[member], candidates.time[member], candidates.width[member]], axis=1)
    start[:, 1] -= begin[:, None]
    parameters, converged = step_undamped(
        windows, start, settings.shape, tolerance=settings.tolerance, max_iterations=settings.max_iterations
    )
    bound = (parameters[:, 2] < settings.width_low) | (parameters[:, 2] > settings.width_high)
    parameters[:, 2] = np.clip(parameters[:, 2], settings.width_low, settings.width_high)
    model = evaluate_model(windows, parameters, settings.shape)
    gram = gram_matrix(model)
    errors, energy = fit_errors(parameters, windows.std, model, gram)
    parameters[:, 1] += begin[:, None]
    cost = gram[:, -1, -1] / windows.std**2
    used = np.maximum(np.count_nonzero(windows.x >= 0, axis=1), 1)
    return Solution(rows, parameters, errors, energy, np.sqrt(cost / used), cost, converged, bound)


def _as_half_width(solution: Solution, factor: float) -> Solution:
    """Multiply the widths of a solution by the factor."""
    scale = np.array([1.0, 1.0, factor])[:, None]
    return solution._replace(parameters=solution.parameters * scale, errors=solution.errors * scale)
