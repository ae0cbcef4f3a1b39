"""Decomposition of waveforms into echoes: clusters fitted in batches, grown where the residual asks for it."""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from typing import NamedTuple

import numpy as np

from wavebatch.core.units import SQRT_PI
from wavebatch.kernels.fit.cluster import Candidates, Clusters, cut_windows
from wavebatch.kernels.fit.least_squares import (
    Fit,
    Limits,
    WidthPrior,
    Windows,
    batch_size,
    fit_windows,
    parameter_errors,
)
from wavebatch.kernels.fit.next_echo import propose_echo
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape
from wavebatch.kernels.fit.residual_test import find_misfits


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


class _Work(NamedTuple):
    samples: np.ndarray
    baseline: np.ndarray
    std: np.ndarray
    clusters: Clusters
    settings: Settings
    missing: np.ndarray | None = None


class _Step(NamedTuple):
    """What came of one batch."""

    solution: Solution
    refused: np.ndarray
    """Rows of the problem whose trial was not accepted."""
    proposal: Problem | None
    """Trials with one echo more, each for a row of the solution."""
    parents: np.ndarray
    """Those rows of the solution."""
    unfinished: Problem
    """What needs more iterations, with the parameters reached."""
    unfinished_rows: np.ndarray


def decompose_clusters(
    samples: np.ndarray,
    baseline: np.ndarray,
    std: np.ndarray,
    candidates: Candidates,
    clusters: Clusters,
    settings: Settings,
    missing: np.ndarray | None = None,
) -> Iterator[Solution]:
    """Solutions of all clusters, those with the same number of echoes together.

    samples: raw counts (n, s); baseline, std: (n,). Every cluster appears in exactly one solution.
    """
    work = _Work(samples, baseline, std, clusters, settings, missing)
    trials: list[Problem] = []
    parents: list[Solution] = []
    k = 0
    while k < clusters.number.max(initial=0) or trials:
        k += 1
        given = np.flatnonzero(clusters.number == k)
        rows = clusters.first[given][:, None] + np.arange(k)
        start = np.stack([candidates.amplitude[rows], candidates.time[rows], candidates.width[rows]], axis=1)
        problem = _join([Problem(given, start, np.full(len(given), np.inf)), *trials])
        before = _join(parents) if parents else None
        trials, parents = [], []
        for step in _solve(work, problem):
            if len(step.refused):
                yield before.take(step.refused - len(given))
            final = np.ones(len(step.solution.cluster), bool)
            if step.proposal is not None:
                trials.append(step.proposal)
                parents.append(step.solution.take(step.parents))
                final[step.parents] = False
            if final.any():
                yield step.solution.take(np.flatnonzero(final))


def _join(parts: list) -> tuple:
    """Named tuples of arrays one behind the other."""
    return type(parts[0])(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


_LONG = (64, 80, 96, 128, 160, 192, 256, 384, 512, 768, 1024, 2048, 4096, 65536)

FINE_LENGTHS = np.array([8, 12, 16, 20, 24, 28, 32, 40, 48, *_LONG])
"""Window lengths of problems with one or two echoes: many problems, each window hardly longer than it must be."""

COARSE_LENGTHS = np.array([16, 32, 48, *_LONG])
"""Window lengths of problems with more echoes: few problems, in as few batches as possible."""

LAST_LENGTHS = np.array([48, 96, 192, 512, 1024, 4096, 65536])
"""Window lengths of the stragglers."""

UNRESOLVED = 0.25
"""Distance, in its errors, below which two echoes are one. Larger values lose pairs that chi2 proves: at 1, a quarter
of those 1.5 widths apart with a ratio of 0.5."""

PATIENCE = 5
"""Iterations of the first attempt; what has not converged then goes on together with others of any length."""


CENSORED = 40
"""Iterations that a problem with clipped samples may have where others have only a few: its start is far off (H6)."""


class Ending(Enum):
    """Which problems an attempt ends with, converged or not."""

    CONVERGED = "none"
    UNCLIPPED = "those without clipped samples"
    ALL = "all"


def _solve(work: _Work, problem: Problem) -> Iterator[_Step]:
    """The problem in batches of one window length.

    Which attempt and which length a cluster gets depends on the cluster alone, never on its batch.
    """
    longest = work.samples.shape[1]
    rows = np.arange(len(problem.cluster))
    most = work.settings.max_iterations
    first = FINE_LENGTHS if problem.start.shape[2] <= 2 else COARSE_LENGTHS
    few = most <= PATIENCE
    for lengths, iterations in ((first, min(PATIENCE, most)), (LAST_LENGTHS, CENSORED if few else most - PATIENCE)):
        last = lengths is LAST_LENGTHS
        needed = work.clusters.high[problem.cluster] - work.clusters.low[problem.cluster]
        length = np.minimum(lengths[np.searchsorted(lengths, needed)], longest)
        order = np.argsort(length, kind="stable")
        unfinished: list[tuple[Problem, np.ndarray]] = []
        for group in np.split(order, np.flatnonzero(np.diff(length[order])) + 1):
            size = batch_size(problem.start.shape[2], int(length[group[0]])) if len(group) else 1
            for begin in range(0, len(group), size):
                part = group[begin : begin + size]
                end = Ending.ALL if last else Ending.UNCLIPPED if few else Ending.CONVERGED
                step = _solve_batch(work, problem.take(part), rows[part], int(length[part[0]]), iterations, end)
                unfinished.append((step.unfinished, step.unfinished_rows))
                yield step
        if last or not unfinished:
            return
        problem = _join([part for part, _ in unfinished])
        rows = np.concatenate([part for _, part in unfinished])


def _solve_batch(work: _Work, problem: Problem, rows: np.ndarray, length: int, iterations: int, end: Ending) -> _Step:
    settings, cluster, clusters = work.settings, problem.cluster, work.clusters
    windows, begin = cut_windows(
        work.samples,
        work.baseline,
        work.std,
        clusters.waveform[cluster],
        clusters.low[cluster],
        clusters.high[cluster],
        length,
        settings.clip,
        settings.noise_gain,
        work.missing,
    )
    start = problem.start.copy()
    start[:, 1] -= begin[:, None]
    limits = _limits(work, cluster, begin)
    prior = settings.prior if problem.start.shape[2] > 1 else None
    fit = fit_windows(
        windows,
        start,
        limits,
        settings.shape,
        tolerance=settings.tolerance,
        max_iterations=iterations,
        hopeless_above=problem.target if np.isfinite(problem.target).any() else None,
        prior=prior,
    )
    finished = fit.converged | fit.hopeless
    if end is Ending.ALL:
        finished[:] = True
    elif end is Ending.UNCLIPPED:
        finished |= True if windows.clipped is None else ~windows.clipped.any(axis=1)
    solution = _solution(cluster, windows, fit, begin)
    new = np.isfinite(problem.target)
    accepted = finished & ~fit.hopeless & (~new | ((solution.cost < problem.target) & _is_resolved(solution)))
    proposal, parents = _propose(settings, windows, fit, accepted & fit.converged, begin, limits)
    if proposal is not None:
        proposal = proposal._replace(cluster=cluster[parents])
        parents = np.cumsum(accepted)[parents] - 1
    left = np.flatnonzero(~finished)
    unfinished = Problem(cluster[left], solution.parameters[left], problem.target[left])
    refused = rows[finished & ~accepted]
    return _Step(solution.take(np.flatnonzero(accepted)), refused, proposal, parents, unfinished, rows[left])


def _solution(cluster: np.ndarray, windows: Windows, fit: Fit, begin: np.ndarray) -> Solution:
    """What all fits of a batch found, in samples of the waveform."""
    errors = parameter_errors(fit.parameters, windows.std, fit.rows, fit.gram)
    parameters = fit.parameters.copy()
    parameters[:, 1] += begin[:, None]
    used = np.maximum(np.count_nonzero(windows.x >= 0, axis=1), 1)
    residual = fit.rows[:, -1]
    misfit = np.sqrt(np.einsum("ml,ml->m", residual, residual) / used) / windows.std
    return Solution(cluster, parameters, errors, misfit, fit.cost, fit.converged, fit.at_bound)


def _limits(work: _Work, cluster: np.ndarray, begin: np.ndarray) -> Limits:
    """Amplitude from 0; time within 3 samples of the window; width within the settings: arrays (m, 3, 1)."""
    settings = work.settings
    low = np.empty((len(cluster), 3, 1))
    high = np.empty_like(low)
    low[:, 0], high[:, 0] = 0.0, 1e9
    low[:, 1, 0] = work.clusters.low[cluster] - begin - 3.0
    high[:, 1, 0] = work.clusters.high[cluster] - begin + 2.0
    low[:, 2], high[:, 2] = settings.width_low, settings.width_high
    return Limits(low, high)


def _is_resolved(solution: Solution) -> np.ndarray:
    """True (m,) where no two neighbouring echoes are so close that their distance is unknown (H1)."""
    order = np.argsort(solution.parameters[:, 1], axis=1)
    time = np.take_along_axis(solution.parameters[:, 1], order, axis=1)
    error = np.take_along_axis(solution.errors[:, 1], order, axis=1)
    gap = np.diff(time, axis=1)
    return (gap > UNRESOLVED * np.hypot(error[:, 1:], error[:, :-1])).all(axis=1) & (solution.parameters[:, 0] > 0).all(
        axis=1
    )


def _propose(
    settings: Settings, windows: Windows, fit: Fit, accepted: np.ndarray, begin: np.ndarray, limits: Limits
) -> tuple[Problem | None, np.ndarray]:
    """Trials with one echo more for the accepted fits that leave something unexplained, and the rows of those.

    accepted: of fits that have not converged nobody knows yet what they leave.
    """
    none = np.empty(0, np.int64)
    if not settings.grow or fit.parameters.shape[2] >= settings.max_echoes or not accepted.any():
        return None, none
    misfit = find_misfits(windows, fit.parameters, fit.rows, settings.gate_residual, settings.gate_hermite)
    at = np.flatnonzero(misfit & accepted)
    if not len(at):
        return None, none
    start, gain = propose_echo(
        windows.take(at),
        fit.parameters[at],
        fit.rows[at],
        fit.gram[at],
        Limits(limits.low[at], limits.high[at]),
        settings.width_ref,
    )
    least = _least_fall(settings, windows.std[at], fit.parameters[at])
    hopeful = gain > 0.5 * least
    at, start, least = at[hopeful], start[hopeful], least[hopeful]
    if not len(at):
        return None, none
    start[:, 1] += begin[at][:, None]
    return Problem(at, start, fit.cost[at] - least), at


def _least_fall(settings: Settings, std: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Fall of chi2 (m,) that one more echo needs: the acceptance, and what a misfit of the pulse itself may explain."""
    amplitude, _, width = parameters.transpose(1, 0, 2)
    energy = SQRT_PI * (amplitude * amplitude * width).sum(axis=1) / (std * std)
    return settings.acceptance + settings.misfit**2 * energy
