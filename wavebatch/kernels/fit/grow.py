"""Decomposition of waveforms into echoes: clusters fitted in batches, grown where the residual asks for it.

Called by stages/decompose. Round k fits all clusters with k echoes: those given by candidates, and trials from round
k - 1. What a cluster gets (window length, attempts) depends on the cluster alone, never on its batch.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from wavebatch.kernels.fit.cluster import Candidates, Clusters, cut_windows
from wavebatch.kernels.fit.least_squares import Fit, Limits, Windows, batch_size, fit_windows
from wavebatch.kernels.fit.next_echo import propose_trials
from wavebatch.kernels.fit.normal_equations import parameter_errors
from wavebatch.kernels.fit.problem import Problem, Settings, Solution


class _Work(NamedTuple):
    """The data of a decomposition, the same for every batch."""

    samples: np.ndarray
    baseline: np.ndarray
    std: np.ndarray
    clusters: Clusters
    settings: Settings
    missing: np.ndarray | None = None


class _Step(NamedTuple):
    """Result of one batch."""

    solution: Solution
    refused: np.ndarray
    """Rows of the problem whose trial was not accepted."""
    proposal: Problem | None
    """Trials with one echo more, each for a row of the solution."""
    parents: np.ndarray
    """These rows of the solution."""
    unfinished: Problem
    """Problems that need more iterations, with the parameters reached."""
    unfinished_rows: np.ndarray
    """Their rows in the problem."""


def decompose_clusters(
    samples: np.ndarray,
    baseline: np.ndarray,
    std: np.ndarray,
    candidates: Candidates,
    clusters: Clusters,
    settings: Settings,
    missing: np.ndarray | None = None,
) -> Iterator[Solution]:
    """Fits and grows all clusters.

    Parameters
    ----------
    samples : uint (n, s), count
        Raw counts, contiguous.
    baseline : float32 (n,) or (n, s), count
        Level of each waveform, or of each sample.
    std : float32 (n,), count
        Noise of each waveform.
    candidates : Candidates
        Start values.
    clusters : Clusters
        Windows, and which candidates belong to each.
    settings : Settings
        Options.
    missing : bool (n, s), optional
        Samples that were not recorded.

    Yields
    ------
    Solution
        Clusters with the same number of echoes; every cluster appears in exactly one solution.

    References
    ----------
    docs/algorithms.md 2.3 and 4.2.
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
    """Named tuples of arrays joined field by field."""
    return type(parts[0])(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


_LONG = (64, 80, 96, 128, 160, 192, 256, 384, 512, 768, 1024, 2048, 4096, 65536)

FINE_LENGTHS = np.array([8, 12, 16, 20, 24, 28, 32, 40, 48, *_LONG])
"""Window lengths of problems with one or two echoes: these are many, so windows are hardly longer than they must be."""

COARSE_LENGTHS = np.array([16, 32, 48, *_LONG])
"""Window lengths of problems with more echoes: these are few, so they go into as few batches as possible."""

LAST_LENGTHS = np.array([48, 96, 192, 512, 1024, 4096, 65536])
"""Window lengths of the second attempt, with still fewer problems."""

UNRESOLVED = 0.25
"""Distance, in its errors, below which two echoes are one. Larger values lose pairs that chi2 proves: at 1, a quarter
of the pairs 1.5 widths apart with an amplitude ratio of 0.5.
"""

PATIENCE = 5
"""Iterations of the first attempt: most problems converge in it, the others then go on together."""


CENSORED = 40
"""Iterations of problems with clipped samples where others have only PATIENCE: their starts are far off

Source: docs/algorithms.md H6.
"""


def _solve(work: _Work, problem: Problem) -> Iterator[_Step]:
    """Solves the problem in batches of one window length, in two attempts."""
    longest = work.samples.shape[1]
    rows = np.arange(len(problem.cluster))
    most = work.settings.max_iterations
    first = FINE_LENGTHS if problem.start.shape[2] <= 2 else COARSE_LENGTHS
    for lengths, iterations in (
        (first, min(PATIENCE, most)),
        (LAST_LENGTHS, CENSORED if most <= PATIENCE else most - PATIENCE),
    ):
        last = lengths is LAST_LENGTHS
        needed = work.clusters.high[problem.cluster] - work.clusters.low[problem.cluster]
        length = np.minimum(lengths[np.searchsorted(lengths, needed)], longest)
        order = np.argsort(length, kind="stable")
        unfinished: list[tuple[Problem, np.ndarray]] = []
        for group in np.split(order, np.flatnonzero(np.diff(length[order])) + 1):
            size = batch_size(problem.start.shape[2], int(length[group[0]])) if len(group) else 1
            for begin in range(0, len(group), size):
                part = group[begin : begin + size]
                step = _solve_batch(work, problem.take(part), rows[part], int(length[part[0]]), iterations, last)
                unfinished.append((step.unfinished, step.unfinished_rows))
                yield step
        if last or not unfinished:
            return
        problem = _join([part for part, _ in unfinished])
        rows = np.concatenate([part for _, part in unfinished])


def _solve_batch(work: _Work, problem: Problem, rows: np.ndarray, length: int, iterations: int, last: bool) -> _Step:
    """Fits problems in windows of one length. In the last attempt every problem ends, converged or not."""
    settings, cluster = work.settings, problem.cluster
    waveform, low, high = (field[cluster] for field in work.clusters[:3])
    windows, begin = cut_windows(
        work.samples, work.baseline, work.std, waveform, low, high, length, settings.clip, settings.noise_gain,
        work.missing,
    )
    start = problem.start.copy()
    start[:, 1] -= begin[:, None]
    limits = _limits(settings, low - begin, high - begin)
    new = np.isfinite(problem.target)
    fit = fit_windows(
        windows,
        start,
        limits,
        settings.shape,
        tolerance=settings.tolerance,
        max_iterations=iterations,
        hopeless_above=problem.target if new.any() else None,
        prior=settings.prior if start.shape[2] > 1 else None,
    )
    finished = fit.converged | fit.hopeless
    if last or (settings.max_iterations <= PATIENCE and windows.clipped is None):
        finished[:] = True
    elif settings.max_iterations <= PATIENCE:
        finished |= ~windows.clipped.any(axis=1)
    solution = _solution(cluster, windows, fit, begin)
    accepted = finished & ~fit.hopeless & (~new | ((solution.cost < problem.target) & _is_resolved(solution)))
    # A fit that has not converged may still explain what its residual shows.
    proposal = propose_trials(settings, windows, fit, accepted & fit.converged, begin, limits)
    parents = np.empty(0, np.int64)
    if proposal is not None:
        parents = np.cumsum(accepted)[proposal.cluster] - 1
        proposal = proposal._replace(cluster=cluster[proposal.cluster])
    left = np.flatnonzero(~finished)
    unfinished = Problem(cluster[left], solution.parameters[left], problem.target[left])
    refused = rows[finished & ~accepted]
    return _Step(solution.take(np.flatnonzero(accepted)), refused, proposal, parents, unfinished, rows[left])


def _solution(cluster: np.ndarray, windows: Windows, fit: Fit, begin: np.ndarray) -> Solution:
    """What the fits of a batch found, in samples of the waveform."""
    errors = parameter_errors(fit.parameters, windows.std, fit.rows, fit.gram)
    parameters = fit.parameters.copy()
    parameters[:, 1] += begin[:, None]
    used = np.maximum(np.count_nonzero(windows.x >= 0, axis=1), 1)
    residual = fit.rows[:, -1]
    misfit = np.sqrt(np.einsum("ml,ml->m", residual, residual) / used) / windows.std
    return Solution(cluster, parameters, errors, misfit, fit.cost, fit.converged, fit.at_bound)


def _limits(settings: Settings, first: np.ndarray, end: np.ndarray) -> Limits:
    """Amplitude from 0; time within 3 samples of the window [first, end); width as set: arrays (m, 3, 1)."""
    low = np.empty((len(first), 3, 1))
    high = np.empty_like(low)
    low[:, 0], high[:, 0] = 0.0, 1e9
    low[:, 1, 0], high[:, 1, 0] = first - 3.0, end + 2.0
    low[:, 2], high[:, 2] = settings.width_low, settings.width_high
    return Limits(low, high)


def _is_resolved(solution: Solution) -> np.ndarray:
    """True (m,) where no two neighbouring echoes are closer than their errors allow (docs/algorithms.md H1)."""
    order = np.argsort(solution.parameters[:, 1], axis=1)
    time = np.take_along_axis(solution.parameters[:, 1], order, axis=1)
    error = np.take_along_axis(solution.errors[:, 1], order, axis=1)
    apart = np.diff(time, axis=1) > UNRESOLVED * np.hypot(error[:, 1:], error[:, :-1])
    return apart.all(axis=1) & (solution.parameters[:, 0] > 0).all(axis=1)
