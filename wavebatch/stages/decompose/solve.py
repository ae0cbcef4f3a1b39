"""The steps that all fitting decomposers share: settings, fits of all clusters, the flagged table in ns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Annotated, Any

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.units import SQRT_PI
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.cluster import Clusters, cut_windows
from wavebatch.kernels.fit.grow import Settings, Solution, decompose_clusters
from wavebatch.kernels.fit.least_squares import Limits, Windows, batch_size, fit_windows
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape, evaluate_pulse, measure_pulse
from wavebatch.kernels.signal.runs import gap_distance
from wavebatch.stages.chain import Range
from wavebatch.stages.decompose.group import MOST_JOINED, find_clusters
from wavebatch.stages.decompose.merge import drop_twins, merge_unresolved
from wavebatch.stages.flags import clear_lone, drop_unproven, flag_echoes
from wavebatch.stages.pulse_tables import (
    BROADEST,
    LEAST_WIDTH,
    MOST_WIDTH,
    ShapeLimits,
    clip_level,
    describe_echoes,
    error_factors,
    pulse_shape,
    shape_limits,
)

PER_WIDTH = 16
"""Samples per width of a pulse to which a Gaussian is fitted: more change its width by less than 1e-4."""

LeastWidth = Annotated[float, Range(0.05, 1.0)]
MostWidth = Annotated[float, Range(1.0, BROADEST)]
"""Limits of fitted widths, the box of Wang et al. eq. 4 [widths of the system pulse]."""


def fit_gaussian(system: SystemPulse, parameters: Mapping[str, Any]) -> SystemPulse:
    """Return the system as decomposers see it that fit Gaussians.

    Parameters
    ----------
    system : SystemPulse
        Result of the survey.
    parameters : mapping
        Of the stage.

    Returns
    -------
    SystemPulse
        With a Gaussian pulse, as wide as the Gaussian that is fitted to the survey's pulse.
    """
    shape = pulse_shape(system, 1.0)
    if shape == GAUSSIAN:
        return system
    ref = _gaussian_width(shape, shape_limits(system, 1.0).ref)
    return replace(system, components=(), kappa=0.0, sigma_ref=ref)


@lru_cache(maxsize=16)
def _gaussian_width(shape: PulseShape, width: float) -> float:
    """Width of the Gaussian that is fitted to a pulse of this width, within three widths of its peak [its unit]."""
    unit = width / PER_WIDTH
    measures = measure_pulse(shape, width, 1.001 * width)
    x = np.arange(-3 * PER_WIDTH, 3 * PER_WIDTH + 1, dtype=np.float64)
    whole = evaluate_pulse(shape, x[:, None] * unit + measures.delay[0], np.zeros(1), np.full(1, width))[0][:, 0]
    windows = Windows(whole[None].astype(np.float32), x[None].astype(np.float32), np.full(1, 1e-3))
    limits = Limits(*(np.array(edge)[None, :, None] for edge in ((0, -20, 0.3 * PER_WIDTH), (9, 20, 5 * PER_WIDTH))))
    start = np.array([[[measures.peak[0]], [0.0], [PER_WIDTH]]])
    # Samples before the middle would count as outside of the window.
    shifted, start[:, 1] = windows._replace(x=windows.x + x[-1].astype(np.float32)), x[-1]
    limits = Limits(limits.low + np.array([0, x[-1], 0])[:, None], limits.high + np.array([0, x[-1], 0])[:, None])
    fit = fit_windows(shifted, start, limits, GAUSSIAN, tolerance=1e-6)
    return float(fit.parameters[0, 2, 0] * unit)


def make_settings(
    block: WaveformBlock,
    system: SystemPulse,
    shape: PulseShape,
    *,
    widths: tuple[float, float] = (LEAST_WIDTH, MOST_WIDTH),
    **options: Any,
) -> Settings:
    """Collect what a decomposition with this pulse may do: the strip's widths, digitizer and noise.

    Parameters
    ----------
    block, system
        As for a stage.
    shape : PulseShape
        The pulse to fit.
    widths : tuple of float
        Smallest and largest width of an echo [widths of the system pulse].
    **options
        Further fields of Settings.

    Returns
    -------
    Settings
        For `fit_candidates`.
    """
    limits = shape_limits(system if shape.components else replace(system, components=()), block.spacing, *widths)
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


def alike_clusters(clusters: Clusters, rows: np.ndarray, block: WaveformBlock) -> Iterator[np.ndarray]:
    """Group clusters that have the same number of echoes and windows of about the same length.

    Parameters
    ----------
    clusters : Clusters
        All clusters.
    rows : int array, shape (c,)
        Those to group.
    block : WaveformBlock
        Their waveforms.

    Yields
    ------
    int array
        Positions in `rows` of a group that is small enough for one batch.
    """
    length = window_length(clusters, rows, block)
    kind = clusters.number[rows] * (1 << 32) + length
    order = np.argsort(kind, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(kind[order])) + 1) if len(order) else []:
        size = batch_size(int(clusters.number[rows[group[0]]]), int(length[group[0]]))
        yield from (group[begin : begin + size] for begin in range(0, len(group), size))


def window_length(clusters: Clusters, rows: np.ndarray, block: WaveformBlock) -> np.ndarray:
    """Length of the windows of clusters, in steps of 8 samples, int64 (c,)."""
    needed = clusters.high[rows] - clusters.low[rows]
    return np.minimum(-(-needed // 8) * 8, block.samples.shape[1])


def cut_alike(
    block: WaveformBlock, noise: Noise, clusters: Clusters, rows: np.ndarray, settings: Settings
) -> tuple[Windows, np.ndarray]:
    """Cut the windows of a group of `alike_clusters`.

    Parameters
    ----------
    block, noise
        As for a stage.
    clusters : Clusters
        All clusters.
    rows : int array, shape (c,)
        Clusters of one group.
    settings : Settings
        Level at which samples are clipped, growth of the noise.

    Returns
    -------
    windows : Windows
        Samples above the baseline.
    begin : int64 array, shape (c,)
        Sample at which each window begins.
    """
    length = int(window_length(clusters, rows, block).max())
    return cut_windows(
        block.samples, noise.for_fits, noise.std, clusters.waveform[rows], clusters.low[rows], clusters.high[rows],
        length, settings.clip, settings.noise_gain, block.missing,
    )  # fmt: skip


def describe_solutions(
    block: WaveformBlock,
    noise: Noise,
    system: SystemPulse,
    clusters: Clusters,
    solutions: list[Solution],
    settings: Settings,
    significance: float,
    attributes: Mapping[str, np.ndarray] | None = None,
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
    attributes : mapping, optional
        Further columns, arrays with one value per echo in the order of the solutions.

    Returns
    -------
    EchoTable
        Fitted echoes with errors and flags.
    """
    given = attributes or {}
    if not solutions:
        return EchoTable.empty().with_attributes(**given)
    flat = [_flatten(clusters, solution) for solution in solutions]
    waveform, parameters, errors, shared, misfit, flags = map(np.concatenate, zip(*flat, strict=True))
    limits = ShapeLimits(settings.width_ref, settings.width_low, settings.width_high)
    fitted = system if settings.shape.components else replace(system, components=(), kappa=settings.shape.kappa)
    factors = error_factors(fitted, block.spacing, parameters[:, 2])
    energy_err = relative_energy_errors(parameters, errors, shared) * factors[:, 3]
    parameters, errors = describe_echoes(settings.shape, limits, parameters, errors, shared)
    errors *= factors[:, :3]
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
        amplitude_err=amplitude_err, sigma_err=width_err * spacing, relative_energy_err=energy_err[keep],
        residual=misfit[keep], flags=flags[keep],
        attributes={name: values[keep] for name, values in given.items()},
    )  # fmt: skip
    table = merge_unresolved(drop_twins(table))
    if settings.shape.components:
        table = drop_unproven(table, system, clip_level(block, system) - system.baseline)
    return flag_echoes(block, noise, system, clear_lone(table))


def relative_energy_errors(parameters: np.ndarray, errors: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """Compute the relative errors of amplitude times width.

    Parameters
    ----------
    parameters, errors : float64 array, shape (m, 3)
        Amplitude, time and width, and their standard deviations.
    shared : float64 array, shape (m, 2)
        Covariance of amplitude and width, and of time and width.

    Returns
    -------
    float64 array, shape (m,)
        Standard deviations; NaN where the covariance is.

    References
    ----------
    docs/algorithms.md 5.
    """
    amplitude, _, width = parameters.T
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = (errors[:, 0] / amplitude) ** 2 + (errors[:, 2] / width) ** 2
        variance += 2 * shared[:, 0] / (amplitude * width)
    return np.sqrt(np.maximum(variance, 0))


def _flatten(clusters: Clusters, solution: Solution) -> tuple[np.ndarray, ...]:
    """One row per echo: waveform, parameters (m, 3), errors (m, 3), shared (m, 2), misfit, flags."""
    k = solution.parameters.shape[2]
    flags = np.where(solution.at_bound, EchoFlag.AT_BOUND, 0)
    flags |= np.where(solution.converged, 0, EchoFlag.NOT_CONVERGED)[:, None]
    if k > 1:
        flags |= int(EchoFlag.OVERLAPPED)
    return (
        np.repeat(clusters.waveform[solution.cluster], k),
        solution.parameters.transpose(0, 2, 1).reshape(-1, 3),
        solution.errors.transpose(0, 2, 1).reshape(-1, 3),
        solution.shared.transpose(0, 2, 1).reshape(-1, 2),
        np.repeat(solution.misfit, k),
        flags.reshape(-1),
    )
