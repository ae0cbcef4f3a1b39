"""The steps that all fitting decomposers share: `fit` and `models` call them.

Candidates of a detector become clusters in samples, without false ones, grouped where they overlap; settings and fits
of all clusters follow, and at the end the flagged table in ns.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Annotated, Any

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.frozen import frozen
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit import decompose
from wavebatch.kernels.fit.neighbours import finish_echoes
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape, matched_gaussian, pulse_tail
from wavebatch.kernels.library import Samples
from wavebatch.kernels.signal.noise import whitening_filter
from wavebatch.stages.chain import Range
from wavebatch.stages.decompose.merge import OVERLAP, TWINS, UNRESOLVED, cover_hidden, cover_phases
from wavebatch.stages.detect.direct import choose_smoothing, samples_of
from wavebatch.stages.flags import flagging, leave_beside, levels_of, scale_errors, unexplained, unproven
from wavebatch.stages.pulse_tables import (
    BROADEST,
    LEAST_WIDTH,
    MOST_WIDTH,
    ShapeLimits,
    clip_level,
    error_factors,
    floor_level,
    model_parameters,
    pulse_shape,
    shape_limits,
    whole_pulse,
)

MARGIN = 1.2
"""Windows extend this many system widths beyond the signal above the noise."""

REACH = 3.0
"""Windows extend at least this many system widths beyond the outer candidates."""

LEAST_PLATEAU = 2
"""Two candidates stand on one flat top if at least so many clipped samples lie between them ..."""

PLATEAU_SLACK = 2
"""... and at most so many that are not clipped (docs/algorithms.md H6)."""

MOST_JOINED = 6
"""A run of signal with more candidates is fitted in parts."""

def find_clusters(
    block: WaveformBlock,
    noise: Noise,
    system: SystemPulse,
    echoes: EchoTable,
    settings: decompose.Settings,
    most: int = MOST_JOINED,
) -> tuple[decompose.Candidates, decompose.Clusters]:
    """Turn candidates into parameters of the pulse in samples, and group those that must be fitted together.

    Parameters
    ----------
    block, noise, system, echoes
        As for a stage.
    settings : Settings
        Pulse and limits of the fit.
    most : int
        Most candidates of a cluster.

    Returns
    -------
    candidates : Candidates
        Without those that a flat top or an after-pulse explains.
    clusters : Clusters
        Disjoint windows with their candidates.
    """
    ref = system.sigma_ref / block.spacing
    limits = ShapeLimits(settings.width_ref, settings.width_low, settings.width_high)
    columns = np.maximum(echoes.amplitude, 0), echoes.time / block.spacing, echoes.sigma / block.spacing
    start = np.stack(columns, axis=1).astype(np.float64)
    amplitude, time, width = model_parameters(settings.shape, limits, start).T
    width = np.clip(width, limits.low, limits.high)
    candidates = decompose.Candidates(echoes.waveform.astype(np.int64), time, amplitude, width)
    candidates = _join_plateaus(block, candidates, clip_level(block, system))
    candidates, tail = _explain_tails(candidates, noise, settings, ref)
    clusters = decompose.cluster_candidates(
        samples_of(block, noise),
        candidates,
        margin=int(np.ceil(MARGIN * ref)),
        reach=int(np.ceil(REACH * ref)),
        most=most,
        tail=tail,
    )
    return candidates, clusters


def _join_plateaus(block: WaveformBlock, candidates: decompose.Candidates, clip: float) -> decompose.Candidates:
    """Candidates, one for each flat top: clipped samples between two candidates are no sign of two echoes."""
    waveform, time, amplitude, _ = candidates
    # Places of clipped samples, not a table of pairs by samples: one waveform of 65,536 samples may have 10,000 pairs.
    clipped = np.flatnonzero(block.samples >= clip if len(waveform) > 1 else ())
    if not len(clipped):
        return candidates
    pair, s = np.flatnonzero(waveform[1:] == waveform[:-1]), block.samples.shape[1]
    begin, end = np.rint(time[pair]).astype(np.int64), np.rint(time[pair + 1]).astype(np.int64)
    first, stop = (waveform[pair] * s + np.clip(place, 0, s - 1) for place in (begin + 1, end))
    between = np.searchsorted(clipped, stop) - np.searchsorted(clipped, first)
    flat = (between >= LEAST_PLATEAU) & (end - begin - 1 - between <= PLATEAU_SLACK)
    if not flat.any():
        return candidates
    joined = np.zeros(len(waveform), bool)
    joined[pair[flat] + 1] = True
    first = np.flatnonzero(~joined)
    number = np.diff(np.r_[first, len(waveform)])
    middle = np.add.reduceat(time, first) / number
    kept = decompose.Candidates(*(field[first] for field in candidates))
    return kept._replace(time=np.where(number > 1, middle, kept.time), amplitude=np.maximum.reduceat(amplitude, first))


def _explain_tails(
    candidates: decompose.Candidates, noise: Noise, settings: decompose.Settings, ref: float
) -> tuple[decompose.Candidates, np.ndarray | None]:
    """Candidates that after-pulses of stronger echoes do not explain, and how far tails reach (docs/algorithms.md H7).

    Growth finds a dropped candidate again if the fit of the stronger echo leaves a residual there. `ref` is the width
    of the system pulse [samples].
    """
    if not settings.shape.components:
        return candidates, None
    tail = pulse_tail(settings.shape, settings.width_ref)
    # A tail below the noise of what found a candidate does not explain it, however broad the pulse is.
    quiet = choose_smoothing(ref)[2]
    keep, reach = decompose.explain_tails(candidates, noise.std, tail, MOST_JOINED - 1, quiet)
    return decompose.Candidates(*(field[keep] for field in candidates)), reach[keep]


@frozen
class EchoLimits:
    """What decomposers accept as an echo: options that they share.

    Parameters
    ----------
    significance : float
        Least energy of an echo [standard deviations of the noise's energy].
    least_width : float
        Smallest width of an echo, of the box of Wang et al. eq. 4 [widths of the system pulse].
    most_width : float
        Largest width of an echo [widths of the system pulse]; steep slopes need more than 4, which decompose.adaptive
        gives one echo where several would explain no more.
    """

    significance: Annotated[float, Range(0.0, 1e6)] = 5.0
    least_width: Annotated[float, Range(0.05, 1.0)] = LEAST_WIDTH
    most_width: Annotated[float, Range(1.0, BROADEST)] = MOST_WIDTH


@frozen
class FitOptions(EchoLimits):
    """Options that decomposers with an iterative fit share.

    Parameters
    ----------
    max_iterations : int
        An echo that has not converged after so many is flagged.
    tolerance : float
        A fit ends with the step that promises a smaller fall of chi2; with 0.5 it is then within a few hundredths of a
        standard deviation of the minimum.
    """

    max_iterations: Annotated[int, Range(1, 1000)] = 40
    tolerance: Annotated[float, Range(0.0, 1e6)] = 0.5


FIT = FitOptions()


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
    ref = matched_gaussian(shape, shape_limits(system, 1.0).ref)[1]
    return replace(system, components=(), kappa=0.0, sigma_ref=ref)


def make_settings(
    block: WaveformBlock,
    system: SystemPulse,
    shape: PulseShape,
    fit: FitOptions,
    **options: Any,
) -> decompose.Settings:
    """Collect what a decomposition with this pulse may do: the strip's widths, digitizer and noise.

    Parameters
    ----------
    block, system
        As for a stage.
    shape : PulseShape
        The pulse to fit.
    fit : FitOptions
    **options
        Further fields of Settings.

    Returns
    -------
    Settings
        For `fit_candidates`.
    """
    pulse = system if shape.components else replace(system, components=())
    limits = shape_limits(pulse, block.spacing, fit.least_width, fit.most_width)
    floor = floor_level(system) if shape.components else None  # no other pulse goes below its level
    noise = system.noise
    # It makes the noise white, with `noise.std`.
    whitening = whitening_filter(noise.whitening, noise.std / noise.quiet) if noise.whitening else None
    return decompose.Settings(
        *limits, shape=shape, clip=clip_level(block, system), floor=floor, noise_gain=noise.gain,
        tolerance=fit.tolerance, max_iterations=fit.max_iterations, whitening=whitening, **options,
    )  # fmt: skip


def fit_candidates(
    block: WaveformBlock,
    noise: Noise,
    system: SystemPulse,
    echoes: EchoTable,
    settings: decompose.Settings,
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
    samples = samples_of(block, noise)
    solution = decompose.decompose_clusters(samples, candidates, clusters, settings)

    def describe(clusters: decompose.Clusters, solution: decompose.Solution) -> EchoTable:
        columns = {CLUSTER: solution.cluster} if settings.known else {}
        return describe_solution(block, noise, system, clusters, solution, settings, significance, columns)

    table = describe(clusters, solution)
    if settings.known:
        table = _leave_out_unknown(table, samples, clusters, solution, settings, describe)
        proven = (table.flags & np.uint16(EchoFlag.OVERLAPPED)) != 0
        share = np.where(proven, table.amplitude / (PROVEN * table.amplitude_err), 1.0)
        table = scale_errors(table, np.minimum(share, 1.0))
    # Last: neighbours that were not found say nothing about whether an echo is there.
    return cover_phases(cover_hidden(table, system, len(block)), system, block.spacing) if settings.grow else table


PROVEN = 2.0
"""Errors of the amplitude of an echo beside others that chi2 proves, as in kernels/c/decompose.h."""

CLUSTER, FACTOR = "cluster", "factor"
"""Columns of a table while its decomposer works: cluster of each echo, and what misfits add to its errors."""


def _leave_out_unknown(
    table: EchoTable,
    samples: Samples,
    clusters: decompose.Clusters,
    solution: decompose.Solution,
    settings: decompose.Settings,
    describe: Callable[[decompose.Clusters, decompose.Solution], EchoTable],
) -> EchoTable:
    """Leave out echoes whose amplitudes are unknown by their final errors, which hold misfits of the pulse too.

    Their clusters are fitted again in noise that is so much larger: the fit leaves out what that noise explains
    (`leave_out_unknown` in kernels/c/decompose.h).
    """
    noise = np.ones(len(solution.number))
    unknown = (_find_unknown(table, settings, noise) > 0) & (solution.number > 1)
    if not unknown.any():
        return _leave_out_explained(table, solution)
    is_part = np.zeros(len(samples.counts), bool)
    is_part[clusters.waveform[unknown]] = True
    part, own = np.flatnonzero(is_part[clusters.waveform]), is_part[table.waveform]
    rest, table = _leave_out_explained(table.take(~own), solution), table.take(own)
    table = table.with_attributes(**{CLUSTER: np.searchsorted(part, table.attributes[CLUSTER])})
    clusters = decompose.Clusters(*(column[part] for column in clusters))
    solution, noise = solution.take(part), noise[part]
    again = settings._replace(grow=False, acceptance=settings.known**2)
    for _ in range(ROUNDS):
        larger = _find_unknown(table, settings, noise)
        rows = np.flatnonzero((larger > 0) & (solution.number > 1))
        if not len(rows):
            break
        noise[rows] = larger[rows]
        order = np.arange(len(solution.number))
        order[rows] = len(order) + np.arange(len(rows))
        # These clusters are fitted again from their echoes, in noise so much larger; errors are of noise alone.
        factor = noise[rows]
        old, waveform = solution.take(rows), clusters.waveform[rows]
        amplitude, time, width, _ = old.parameters.T
        place = np.arange(len(rows))
        columns: Any = (None if column is None else column[waveform] for column in samples)
        some = Samples(*columns)
        some = some._replace(std=(some.std * factor).astype(np.float32))
        first = np.cumsum(old.number) - old.number
        windows = decompose.Clusters(place, clusters.low[rows], clusters.high[rows], first, old.number)
        known = decompose.Candidates(place[old.cluster], time, amplitude, width)
        new = decompose.decompose_clusters(some, known, windows, again)
        each = factor[new.cluster]
        fitted = new._replace(
            misfit=new.misfit * each, errors=new.errors / each[:, None], shared=new.shared / each[:, None] ** 2
        )  # fmt: skip
        solution = decompose.Solution(*map(np.concatenate, zip(solution, fitted, strict=True))).take(order)
        table = describe(clusters, solution)
    both = EchoTable.concatenate((rest, _leave_out_explained(table, solution)))
    return both.take(np.argsort(both.waveform, kind="stable"))


def _leave_out_explained(table: EchoTable, solution: decompose.Solution) -> EchoTable:
    """The table without echoes alone in their cluster that are no higher than what a stronger one leaves beside it.

    Their errors say so. The columns of the decomposer go.
    """
    alone = solution.number[table.attributes[CLUSTER]] == 1
    alone &= (table.flags & np.uint16(EchoFlag.SATURATED)) == 0
    explained = alone & (table.attributes[FACTOR] > ROOM) & (table.amplitude < table.amplitude_err)
    table = replace(table, attributes={})
    return table.take(~explained) if explained.any() else table


def _find_unknown(table: EchoTable, settings: decompose.Settings, noise: np.ndarray) -> np.ndarray:
    """Noise of each cluster, over that of a fit, in which its unknown echoes must be asked; 0 without any.

    noise: float64 (c,), the noise in which they were asked already.
    """
    cluster, factor = table.attributes[CLUSTER], table.attributes[FACTOR]
    unknown = (table.amplitude < settings.known * table.amplitude_err) & (factor > ROOM * noise[cluster])
    larger = np.zeros(len(noise))
    np.maximum.at(larger, cluster[unknown], factor[unknown])
    return larger


ROUNDS = 3
"""Times that unknown echoes are looked for: with one less, errors of others may grow."""

ROOM = 1.1
"""Factor on errors by misfits up to which echoes are not asked again."""


def describe_solution(
    block: WaveformBlock,
    noise: Noise,
    system: SystemPulse,
    clusters: decompose.Clusters,
    solution: decompose.Solution,
    settings: decompose.Settings,
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
    solution : Solution
        Their fits.
    settings : Settings
        Pulse and limits of the fit.
    significance : float
        Least energy of an echo [standard deviations].
    attributes : mapping, optional
        Further columns, arrays with one value per echo in their order.

    Returns
    -------
    EchoTable
        Fitted echoes with errors and flags.
    """
    given = attributes or {}
    limits = ShapeLimits(settings.width_ref, settings.width_low, settings.width_high)
    fitted = system if settings.shape.components else replace(system, components=(), kappa=settings.shape.kappa)
    spacing, length, widths = block.spacing, block.samples.shape[1], solution.parameters[:, 2]
    # Errors of levels are in the errors of fits that left them free, else in factors.
    free, beside = (noise.baseline_err, None) if settings.free_levels else (None, noise.baseline_err)
    if beside is not None:
        beside = (beside / noise.std)[np.repeat(clusters.waveform, solution.number)]
    factors = error_factors(fitted, spacing, widths, beside)
    whole = whole_pulse(settings.shape, limits, widths)
    columns, row = decompose.keep_echoes(
        clusters, solution, whole, factors, noise.std, spacing, length, significance, free
    )
    proves = bool(settings.shape.components) or not system.components
    steps = flagging(block, system)._replace(
        sort=True, gaps=spacing, twins=TWINS, overlap=OVERLAP, unresolved=UNRESOLVED, lone=True,
        unproven=unproven(system, clip_level(block, system) - system.noise.baseline) if proves else None,
        unexplained=unexplained(system, spacing), others=leave_beside(system),
    )  # fmt: skip
    columns, row, grown = finish_echoes(columns, row, levels_of(block, noise), steps, factors)
    left = {name: values[row] for name, values in given.items()}
    # Colour that makes errors larger is left to the acceptance, which has made `noise.std` of it.
    return EchoTable(**columns, attributes=left | ({FACTOR: grown} if CLUSTER in given else {}))
