"""Decomposers that fit a pulse model to clusters of candidates, and the steps that all fitting decomposers share.

Path of a block: candidates in ns, clusters in samples (`find_clusters`), fits (kernels), flagged table in ns
(`describe_solutions`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.units import SQRT_PI
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.closed_form import fit_closed_form
from wavebatch.kernels.fit.cluster import Clusters
from wavebatch.kernels.fit.grow import Settings, Solution, decompose_clusters
from wavebatch.kernels.fit.least_squares import WidthPrior
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape
from wavebatch.kernels.signal.runs import gap_distance
from wavebatch.stages.chain import Range, stage
from wavebatch.stages.decompose.group import MOST_JOINED, find_clusters
from wavebatch.stages.decompose.merge import drop_twins, merge_unresolved
from wavebatch.stages.flags import clear_lone, drop_unproven, flag_echoes
from wavebatch.stages.pulse_tables import (
    ShapeLimits,
    clip_level,
    describe_echoes,
    error_factors,
    pulse_shape,
    shape_limits,
)

CLOSED_VALUES = 1 << 21
"""Samples around peaks that the closed form takes at a time: noise has a peak at every fourth sample."""


@stage("decompose")
def none(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Echoes of the detector as they are, without a fit and without errors."""
    return flag_echoes(block, noise, system, echoes)


@stage("decompose")
def closed_form(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    fraction: Annotated[float, Range(0.0, 1.0)] = 0.2,
    steps: Annotated[int, Range(0, 100)] = 2,
    significance: Annotated[float, Range(0.0, 1e6)] = 5.0,
) -> EchoTable:  # fmt: skip
    """One Gaussian for every candidate alone: a closed form and a few Gauss-Newton steps.

    Errors are at the Cramer-Rao bound for isolated echoes. Overlapping echoes are cut apart midway between them and are
    therefore biased.

    Parameters
    ----------
    fraction : float
        Samples of at least this share of the peak enter the closed form.
    steps : int
        Gauss-Newton steps after it.
    significance : float
        Least energy of an echo [standard deviations of the noise's energy].

    References
    ----------
    Guo (2011); docs/algorithms.md 4.1.
    """
    start = _start_closed_form(block, noise, system, echoes, fraction)
    settings = make_settings(block, system, GAUSSIAN, tolerance=0.1, max_iterations=steps + 1, grow=False)
    return fit_candidates(block, noise, system, start, settings, significance=significance, most=1)


@stage("decompose")
def gaussian(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    max_iterations: Annotated[int, Range(1, 1000)] = 40,
    tolerance: Annotated[float, Range(0.0, 1e6)] = 0.5,
    significance: Annotated[float, Range(0.0, 1e6)] = 5.0,
) -> EchoTable:  # fmt: skip
    """Sum of Gaussians fitted to every cluster of overlapping candidates, with errors from the covariance.

    Batched Levenberg-Marquardt. Widths stay within 0.7 and 4 system widths, times within the window. No echo is added.

    Parameters
    ----------
    max_iterations : int
        An echo that has not converged after so many is flagged.
    tolerance : float
        A fit ends with the step that promises a smaller fall of chi2; with 0.5 it is then within a few hundredths of a
        standard deviation of the minimum.
    significance : float
        Least energy of an echo [standard deviations of the noise's energy].

    References
    ----------
    Wagner et al. (2007) eq. 3; docs/algorithms.md 2.3.
    """
    settings = make_settings(block, system, GAUSSIAN, tolerance=tolerance, max_iterations=max_iterations, grow=False)
    return fit_candidates(block, noise, system, echoes, settings, significance=significance)


@stage("decompose")
def adaptive(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    acceptance: Annotated[float, Range(0.0, 1e6)] = 0.0,
    max_echoes: Annotated[int, Range(1, 1000)] = 6,
    gate_residual: Annotated[float, Range(0.0, 1e6)] = 4.2,
    gate_hermite: Annotated[float, Range(0.0, 1e6)] = 8.5,
    width_prior: Annotated[float, Range(0.0, 100.0)] = 0.1,
    max_iterations: Annotated[int, Range(1, 1000)] = 40,
    tolerance: Annotated[float, Range(0.0, 1e6)] = 0.5,
    significance: Annotated[float, Range(0.0, 1e6)] = 4.5,
) -> EchoTable:  # fmt: skip
    """As many echoes as the waveform needs: a fit grows only where a test of its residual asks for it.

    Each cluster of candidates is fitted with the strip's pulse. Where the smoothed residual or its Gauss-Hermite
    moments exceed what noise explains, a score test places one more echo. The larger fit is kept if chi2 falls enough
    and the echoes are resolved.

    Parameters
    ----------
    acceptance : float
        Least fall of chi2 for which an echo is added; 0 takes the value of the survey.
    max_echoes : int
        Most echoes per cluster to which a fit grows.
    gate_residual : float
        Largest smoothed residual of a complete fit [standard deviations].
    gate_hermite : float
        Largest h3^2 + h4^2 of a complete fit.
    width_prior : float
        How far overlapping echoes may be narrower than the system pulse [one standard deviation, in system widths]; 0
        for no prior.
    max_iterations : int
        An echo that has not converged after so many is flagged.
    tolerance : float
        A fit ends with the step that promises a smaller fall of chi2; with 0.5 it is then within a few hundredths of a
        standard deviation of the minimum.
    significance : float
        Least energy of an echo [standard deviations of the noise's energy].

    References
    ----------
    docs/algorithms.md 2.3, 4.2, H1, H3.
    """
    shape = pulse_shape(system, block.spacing)
    ref = shape_limits(system, block.spacing).ref
    settings = make_settings(
        block,
        system,
        shape,
        tolerance=tolerance,
        max_iterations=max_iterations,
        grow=True,
        acceptance=acceptance or system.acceptance,
        misfit=system.misfit,
        max_echoes=max_echoes,
        prior=WidthPrior(ref, width_prior * ref) if width_prior > 0 else None,
        gate_residual=gate_residual,
        gate_hermite=gate_hermite,
    )
    return fit_candidates(block, noise, system, echoes, settings, significance=significance)


def make_settings(block: WaveformBlock, system: SystemPulse, shape: PulseShape, **options: Any) -> Settings:
    """Collect what a decomposition with this pulse may do: the strip's widths, digitizer and noise.

    Parameters
    ----------
    block, system
        As for a stage.
    shape : PulseShape
        The pulse to fit.
    **options
        Further fields of Settings.

    Returns
    -------
    Settings
        For `fit_candidates`.
    """
    limits = shape_limits(system if shape.components else replace(system, components=()), block.spacing)
    return Settings(*limits, shape=shape, clip=clip_level(block, system), noise_gain=system.noise_gain, **options)


def fit_candidates(
    block: WaveformBlock,
    noise: Noise,
    system: SystemPulse,
    echoes: EchoTable,
    settings: Settings,
    *,
    significance: float,
    most: int = MOST_JOINED,
) -> EchoTable:
    """Run a decomposer: candidates in ns, clusters, fits, flagged table in ns.

    Parameters
    ----------
    block, noise, system, echoes
        As for a stage.
    settings : Settings
        Pulse, limits and options of the fit.
    significance : float
        Least energy of an echo [standard deviations].
    most : int
        Most candidates that are fitted together.

    Returns
    -------
    EchoTable
        Fitted echoes with errors and flags.
    """
    candidates, clusters = find_clusters(block, noise, system, echoes, settings, most)
    solutions = decompose_clusters(
        block.samples, noise.for_fits, noise.std, candidates, clusters, settings, block.missing
    )
    return describe_solutions(block, noise, system, clusters, list(solutions), settings, significance)


def describe_solutions(
    block: WaveformBlock,
    noise: Noise,
    system: SystemPulse,
    clusters: Clusters,
    solutions: list[Solution],
    settings: Settings,
    significance: float,
) -> EchoTable:
    """Turn fits in samples into a flagged table in ns.

    Echoes that noise explains or that lie outside the waveform are dropped, unresolved ones are merged.

    Parameters
    ----------
    block, noise, system
        As for a stage.
    clusters : Clusters
        The fitted clusters.
    solutions : list of Solution
        Their fits.
    settings : Settings
        Pulse and limits of the fit.
    significance : float
        Least energy of an echo [standard deviations].

    Returns
    -------
    EchoTable
        Fitted echoes with errors and flags.
    """
    if not solutions:
        return EchoTable.empty()
    flat = [_flatten(clusters, solution) for solution in solutions]
    waveform, parameters, errors, misfit, flags = (np.concatenate(part) for part in zip(*flat, strict=True))
    limits = ShapeLimits(settings.width_ref, settings.width_low, settings.width_high)
    parameters, errors = describe_echoes(settings.shape, limits, parameters, errors)
    errors *= error_factors(system, block.spacing)
    amplitude, time, width = parameters.T
    energy = amplitude * amplitude * width * SQRT_PI
    last = block.samples.shape[1] - 1
    keep = (energy >= (significance * noise.std[waveform]) ** 2) & (time >= -0.5 * width) & (time <= last + 0.5 * width)
    keep &= np.isfinite(errors).all(axis=1)
    if block.missing is not None:
        keep &= gap_distance(block.missing, waveform, time) >= -0.5 * width
    amplitude, time, width = parameters[keep].T
    amplitude_err, time_err, width_err = errors[keep].T
    spacing = block.spacing
    table = EchoTable.build(
        waveform[keep], time * spacing, amplitude, width * spacing, time_err=time_err * spacing,
        amplitude_err=amplitude_err, sigma_err=width_err * spacing, residual=misfit[keep], flags=flags[keep],
    )  # fmt: skip
    table = merge_unresolved(drop_twins(table))
    if settings.shape.components:
        table = drop_unproven(table, system, clip_level(block, system) - system.baseline)
    return flag_echoes(block, noise, system, clear_lone(table))


def _flatten(clusters: Clusters, solution: Solution) -> tuple[np.ndarray, ...]:
    """One row per echo: waveform, parameters (m, 3), errors (m, 3), misfit, flags."""
    k = solution.parameters.shape[2]
    flags = np.where(solution.at_bound, EchoFlag.AT_BOUND, 0)
    flags |= np.where(solution.converged, 0, EchoFlag.NOT_CONVERGED)[:, None]
    if k > 1:
        flags |= int(EchoFlag.OVERLAPPED)
    return (
        np.repeat(clusters.waveform[solution.cluster], k),
        solution.parameters.transpose(0, 2, 1).reshape(-1, 3),
        solution.errors.transpose(0, 2, 1).reshape(-1, 3),
        np.repeat(solution.misfit, k),
        flags.reshape(-1),
    )


def _start_closed_form(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, fraction: float
) -> EchoTable:
    """Candidates with amplitude, time and width of the closed form, where it is valid."""
    ref = system.sigma_ref / block.spacing
    waveform = echoes.waveform.astype(np.int64)
    s = block.samples.shape[1]
    peak = np.clip(np.rint(echoes.time / block.spacing), 0, s - 1).astype(np.int64)
    reach = min(int(np.ceil(2.5 * ref)), s)
    step = max(CLOSED_VALUES // (2 * reach + 1), 2)
    parts = [slice(begin, begin + step) for begin in range(0, len(waveform), step)] or [slice(0)]
    found = [fit_closed_form(_cut_peaks(block, noise, waveform[part], peak[part], reach), fraction) for part in parts]
    amplitude, shift, width, holds = (np.concatenate(fields) for fields in zip(*found, strict=True))
    holds &= (width > 0.7 * ref) & (width < 4.0 * ref)
    return replace(
        echoes,
        amplitude=np.where(holds, amplitude, echoes.amplitude).astype(np.float32),
        time=np.where(holds, (peak + shift) * block.spacing, echoes.time),
        sigma=np.where(holds, width * block.spacing, echoes.sigma).astype(np.float32),
    )


def _cut_peaks(block: WaveformBlock, noise: Noise, waveform: np.ndarray, peak: np.ndarray, reach: int) -> np.ndarray:
    """Signal above the baseline around peaks (m, 2 reach + 1); 0 where no sample was recorded."""
    s = block.samples.shape[1]
    at = peak[:, None] + np.arange(-reach, reach + 1)
    inside = (at >= 0) & (at < s)
    row, at = waveform[:, None], np.clip(at, 0, s - 1)
    y = block.samples[row, at] - (noise.baseline[row] if noise.of_sample is None else noise.of_sample[row, at])
    if block.missing is not None:
        inside &= ~block.missing[row, at]
    return np.where(inside, y, 0.0)
