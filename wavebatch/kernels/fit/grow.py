"""Decomposition of waveforms into echoes: clusters fitted in batches, grown where the residual asks for it.

Called by stages/decompose. A round fits all clusters with k echoes: those given by candidates, trials with one echo
more than a fit of an earlier round, and fits in which an echo came to nothing and was left out. What a cluster gets
(window length, attempts) depends on the cluster alone, never on its batch.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from wavebatch.kernels.fit.cluster import Candidates, Clusters, cut_windows
from wavebatch.kernels.fit.least_squares import Fit, Limits, Windows, batch_size, fit_windows
from wavebatch.kernels.fit.next_echo import propose_trials
from wavebatch.kernels.fit.normal_equations import fit_errors
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
    fewer: Problem
    """Fits that are right but for an echo of no amplitude, without that echo."""
    fewer_rows: np.ndarray
    """Their rows in the problem."""
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
    waiting: dict[int, list[_Entry]] = {}
    for k in np.unique(clusters.number):
        given = np.flatnonzero(clusters.number == k)
        rows = clusters.first[given][:, None] + np.arange(k)
        start = np.stack([candidates.amplitude[rows], candidates.time[rows], candidates.width[rows]], axis=1)
        _wait(waiting, Problem(given, start, np.full(len(given), np.inf)), None)
    while waiting:
        yield from _solve_round(work, waiting.pop(min(waiting)), waiting)


class _Entry(NamedTuple):
    """Problems that wait for a round."""

    problem: Problem
    parents: Solution | None
    """What is right if they fail, a solution per problem; None where nothing came before."""


def _wait(waiting: dict[int, list[_Entry]], problem: Problem, parents: Solution | None) -> None:
    """Puts problems into the round of their number of echoes."""
    if len(problem.cluster):
        waiting.setdefault(problem.start.shape[2], []).append(_Entry(problem, parents))


def _solve_round(work: _Work, entries: list[_Entry], waiting: dict[int, list[_Entry]]) -> Iterator[Solution]:
    """Solves all problems with one number of echoes; yields what is final, and lets what follows from them wait."""
    groups = _group_entries(entries)
    problem = _join([entry.problem for entry in groups])
    ends = np.cumsum([len(entry.problem.cluster) for entry in groups])
    for step in _solve(work, problem):
        for number, (entry, end) in enumerate(zip(groups, ends, strict=True)):
            begin = end - len(entry.problem.cluster)
            if entry.parents is not None:
                refused = step.refused[(step.refused >= begin) & (step.refused < end)]
                if len(refused):
                    yield entry.parents.take(refused - begin)
            if len(step.fewer_rows):
                at = np.flatnonzero(np.searchsorted(ends, step.fewer_rows, side="right") == number)
                parents = None if entry.parents is None else entry.parents.take(step.fewer_rows[at] - begin)
                _wait(waiting, step.fewer.take(at), parents)
        final = np.ones(len(step.solution.cluster), bool)
        if step.proposal is not None:
            _wait(waiting, step.proposal, step.solution.take(step.parents))
            final[step.parents] = False
        if final.any():
            yield step.solution.take(np.flatnonzero(final))


def _group_entries(entries: list[_Entry]) -> list[_Entry]:
    """The entries joined to one per number of echoes of their parents, those without parents first."""
    kinds: dict[int, list[_Entry]] = {}
    for entry in entries:
        kinds.setdefault(0 if entry.parents is None else entry.parents.parameters.shape[2], []).append(entry)
    return [
        _Entry(_join([part.problem for part in kinds[k]]), _join([part.parents for part in kinds[k]]) if k else None)
        for k in sorted(kinds)
    ]


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


FAINT = 1.0
"""Height in the window, in noise, up to which a fit has found that there is no echo: of any width, it is never
significant.
"""

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
    good = finished & ~fit.hopeless & (~new | (solution.cost < problem.target))
    height = _heights(solution, low, high)
    faint = good & (height.min(axis=1) <= FAINT * windows.std) & (height.shape[1] > 1)
    accepted = good & ~faint
    if new.any():
        accepted &= ~new | _is_resolved(solution)
    fewer = np.flatnonzero(faint)
    lesser = _leave_out(solution, problem.target, height, fewer)
    # A fit that has not converged may still explain what its residual shows.
    proposal = propose_trials(settings, windows, fit, accepted & fit.converged, begin, limits)
    parents = np.empty(0, np.int64)
    if proposal is not None:
        parents = np.cumsum(accepted)[proposal.cluster] - 1
        proposal = proposal._replace(cluster=cluster[proposal.cluster])
    left = np.flatnonzero(~finished)
    unfinished = Problem(cluster[left], solution.parameters[left], problem.target[left])
    refused = rows[finished & ~accepted & ~faint]
    return _Step(
        solution.take(np.flatnonzero(accepted)), refused, proposal, parents,
        lesser, rows[fewer], unfinished, rows[left],
    )  # fmt: skip


def _heights(solution: Solution, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Height of each echo (m, k) in its window [low, high): less than its amplitude where it lies outside."""
    amplitude, time, width = solution.parameters.transpose(1, 0, 2)
    outside = np.maximum(low[:, None] - time, time - (high - 1)[:, None])
    return amplitude * np.exp(-0.5 * (np.maximum(outside, 0) / width) ** 2)


def _leave_out(solution: Solution, target: np.ndarray, height: np.ndarray, rows: np.ndarray) -> Problem:
    """The fits at `rows` as problems without their lowest echo. It would block growth: no trial with it is resolved."""
    parameters = solution.parameters[rows]
    kept = np.ones((len(rows), parameters.shape[2]), bool)
    kept[np.arange(len(rows)), np.argmin(height[rows], axis=1)] = False
    start = parameters.transpose(0, 2, 1)[kept].reshape(len(rows), parameters.shape[2] - 1, 3).transpose(0, 2, 1)
    return Problem(solution.cluster[rows], start, target[rows])


def _solution(cluster: np.ndarray, windows: Windows, fit: Fit, begin: np.ndarray) -> Solution:
    """What the fits of a batch found, in samples of the waveform."""
    errors, shared = fit_errors(fit.parameters, windows.std, fit.rows, fit.gram)
    parameters = fit.parameters.copy()
    parameters[:, 1] += begin[:, None]
    used = np.maximum(np.count_nonzero(windows.x >= 0, axis=1), 1)
    residual = fit.rows[:, -1]
    misfit = np.sqrt(np.einsum("ml,ml->m", residual, residual) / used) / windows.std
    return Solution(cluster, parameters, errors, shared, misfit, fit.cost, fit.converged, fit.at_bound)


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
    time, error = solution.parameters[:, 1], solution.errors[:, 1]
    if (time[:, 1:] < time[:, :-1]).any():
        order = np.argsort(time, axis=1)
        time, error = np.take_along_axis(time, order, axis=1), np.take_along_axis(error, order, axis=1)
    apart = np.diff(time, axis=1) > UNRESOLVED * np.hypot(error[:, 1:], error[:, :-1])
    return apart.all(axis=1) & (solution.parameters[:, 0] > 0).all(axis=1)
