"""Decomposition of waveforms into echoes by the compiled library: one cluster after the other (kernels/c/decompose.h).

Called by stages/decompose and the survey.
"""

from __future__ import annotations

import ctypes

import numpy as np

from wavebatch.kernels import library
from wavebatch.kernels.fit.cluster import Candidates, Clusters, Settings, Solution
from wavebatch.kernels.fit.pulse_shape import NO_SKEW, PulseShape
from wavebatch.kernels.library import Samples, call, place


def decompose_clusters(samples: Samples, candidates: Candidates, clusters: Clusters, settings: Settings) -> Solution:
    """Fits and grows all clusters.

    Parameters
    ----------
    samples : Samples
        Waveforms.
    candidates : Candidates
        Start values.
    clusters : Clusters
        Windows, and which candidates belong to each.
    settings : Settings
        Options.

    Returns
    -------
    Solution
        In the order of the clusters.

    References
    ----------
    docs/algorithms.md 2.3 and 4.2.
    """
    problem = _as_problem(samples, candidates, clusters, settings)
    c = len(clusters.number)
    number, converged = np.zeros(c, np.int64), np.zeros(c, bool)
    misfit, cost = np.zeros(c), np.zeros(c)
    room, done, parts = int(clusters.number.sum()) + c // 4 + 64, 0, []
    while done < c:
        echoes = np.empty((room, 4)), np.empty((room, 4)), np.empty((room, 2)), np.empty(room, bool)
        columns = (number, converged, misfit, cost, *echoes)
        out = library.Echoes(room, *map(library.address, columns))
        found = ctypes.c_int64()
        reached = call("decompose_clusters", *problem, ctypes.c_int64(done), out, ctypes.byref(found))
        parts.append([column[: found.value] for column in echoes])
        room, done = 2 * room, reached
    joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)] if parts else _no_echoes()
    return Solution(number, converged, misfit, cost, *joined)


def promise_echoes(samples: Samples, echoes: Candidates, clusters: Clusters, settings: Settings) -> np.ndarray:
    """Fall of chi2 that one more echo promises beside the echoes of each cluster, float64 (c,).

    As `decompose_clusters`, with echoes that are the fit itself (docs/algorithms.md 2.3).
    """
    promise = np.zeros(len(clusters.number))
    call("promise_echoes", *_as_problem(samples, echoes, clusters, settings), promise)
    return promise


def _no_echoes() -> tuple[np.ndarray, ...]:
    return np.empty((0, 4)), np.empty((0, 4)), np.empty((0, 2)), np.empty(0, bool)


def _as_problem(
    samples: Samples, candidates: Candidates, clusters: Clusters, settings: Settings
) -> tuple[library.Block, library.CClusters, library.CSettings]:
    """The structures of one call; each holds the arrays to which it points."""
    samples = samples.checked()
    candidates, clusters = _check(samples, candidates, clusters)
    windows = library.CClusters(
        len(clusters.number), *(place(field, np.int64) for field in clusters),
        *(place(field, np.float64) for field in (candidates.amplitude, candidates.time, candidates.width)),
    )  # fmt: skip
    windows.arrays = candidates, clusters
    return samples.as_block(), windows, _as_structure(settings)


def _check(samples: Samples, candidates: Candidates, clusters: Clusters) -> tuple[Candidates, Clusters]:
    """The same as the library reads them; raises ValueError where it would read outside of them."""
    n, s = samples.counts.shape
    waveform, low, high, first, number = clusters
    m = len(candidates.time)
    if {len(column) for column in clusters} != {len(number)} or {len(column) for column in candidates[1:]} != {m}:
        raise ValueError("the columns of clusters or candidates differ in length")
    inside = (waveform >= 0) & (waveform < n) & (low >= 0) & (low < high) & (high <= s)
    if not (inside & (number > 0) & (first >= 0) & (first + number <= m)).all():
        raise ValueError("a window lies outside of its waveform, or its candidates outside of their table")
    if not all(np.isfinite(column).all() for column in candidates[1:]):
        raise ValueError("candidates must be finite")
    return (
        Candidates(*(np.ascontiguousarray(field, np.float64) for field in candidates)),
        Clusters(*(np.ascontiguousarray(field, np.int64) for field in clusters)),
    )


def _as_structure(settings: Settings) -> library.CSettings:
    """The settings for the library."""
    if not 0 < settings.width_ref < np.inf:
        raise ValueError("the width of the pulse must be above 0")
    pulse = as_pulse(settings.shape)
    values = settings._asdict() | {"pulse": pulse, "clip": np.inf if settings.clip is None else settings.clip}
    del values["shape"]
    table = np.zeros((3, 3)) if settings.whitening is None else np.asarray(settings.whitening, np.float64)
    if table.shape != (3, 3) or not np.isfinite(table).all():
        raise ValueError("a whitening filter has three finite rows of three")
    values |= {"whitened": settings.whitening is not None, "whitening": (ctypes.c_double * 9)(*table.ravel())}
    structure = library.CSettings(**values)
    structure.arrays = pulse.arrays
    return structure


def as_pulse(shape: PulseShape) -> library.Pulse:
    """The pulse for the library; the structure holds the arrays to which it points."""
    components = np.array(shape.components, np.float64).reshape(-1, 3)
    rows = (np.zeros(2, np.float32),) * 2 if shape.table is None else (shape.table.value, shape.table.slope)
    if not 2 <= len(rows[0]) == len(rows[1]):
        raise ValueError("the table of a pulse must have a slope for each of its rows")
    first, step = (0.0, 1.0) if shape.table is None else shape.table[:2]
    pulse = library.Pulse(
        _kind(shape), shape.kappa, shape.power, len(components), place(components, np.float64),
        len(rows[0]), first, step, *(place(row, np.float32) for row in rows), shape.origin == "waveform",
    )  # fmt: skip
    pulse.arrays = components, *rows
    return pulse


def _kind(shape: PulseShape) -> int:
    """Number of the model in the library."""
    if shape.origin:
        return library.Pulse.LOG_NORMAL
    if shape.components:
        return library.Pulse.SUM_OF_GAUSSIANS
    if shape.table is not None:
        return library.Pulse.TABLE
    if shape.power != 2.0:
        return library.Pulse.POWER
    return library.Pulse.SKEWED if abs(shape.kappa) >= NO_SKEW else library.Pulse.SUM_OF_GAUSSIANS
