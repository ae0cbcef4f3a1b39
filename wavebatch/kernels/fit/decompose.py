"""Decomposition of waveforms into echoes by the compiled library: one cluster after the other (kernels/c/decompose.h).

Called by stages/decompose and the survey.
"""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import numpy as np

from wavebatch.kernels import library
from wavebatch.kernels.fit.cluster import Candidates, Clusters
from wavebatch.kernels.fit.problem import Settings, Solution
from wavebatch.kernels.fit.pulse_shape import NO_SKEW, PulseShape
from wavebatch.kernels.library import place


class Samples(NamedTuple):
    """n waveforms of s samples, with their noise."""

    counts: np.ndarray
    """uint8, uint16, uint32 or float32 (n, s) [count]."""
    baseline: np.ndarray
    """Level of each waveform, float32 (n,), or of each sample (n, s) [count]."""
    std: np.ndarray
    """Noise of each waveform, float32 (n,) [count]."""
    missing: np.ndarray | None = None
    """Samples that were not recorded, bool (n, s); None where there is none."""


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
    call = _Call(samples, candidates, clusters, settings)
    c = len(clusters.number)
    number, converged = np.zeros(c, np.int64), np.zeros(c, bool)
    misfit, cost = np.zeros(c), np.zeros(c)
    room, done, parts = int(clusters.number.sum()) + c // 4 + 64, 0, []
    while done < c:
        echoes = np.empty((room, 4)), np.empty((room, 4)), np.empty((room, 2)), np.empty(room, bool)
        columns = (number, converged, misfit, cost, *echoes)
        out = library.Echoes(room, *(column.ctypes.data for column in columns))
        found = ctypes.c_int64()
        reached = call.run("decompose_clusters", ctypes.c_int64(done), ctypes.byref(out), ctypes.byref(found))
        parts.append([column[: found.value] for column in echoes])
        room, done = 2 * room, reached
    joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)] if parts else _no_echoes()
    return Solution(number, converged, misfit, cost, *joined)


def promise_echoes(samples: Samples, echoes: Candidates, clusters: Clusters, settings: Settings) -> np.ndarray:
    """Fall of chi2 that one more echo promises beside the echoes of each cluster, float64 (c,).

    As `decompose_clusters`, with echoes that are the fit itself (docs/algorithms.md 2.3).
    """
    promise = np.zeros(len(clusters.number))
    _Call(samples, echoes, clusters, settings).run("promise_echoes", ctypes.c_void_p(promise.ctypes.data))
    return promise


def _no_echoes() -> tuple[np.ndarray, ...]:
    return np.empty((0, 4)), np.empty((0, 4)), np.empty((0, 2)), np.empty(0, bool)


class _Call:
    """The structures of one call, and the arrays to which they point."""

    def __init__(self, samples: Samples, candidates: Candidates, clusters: Clusters, settings: Settings):
        self.keep = _check(samples, candidates, clusters)
        samples, candidates, clusters = self.keep
        counts, baseline, std, missing = samples
        kind = 0 if counts.dtype == np.float32 else counts.dtype.itemsize
        self.block = library.Block(
            counts.ctypes.data, counts.shape[1], kind, place(baseline, np.float32), baseline.ndim - 1,
            place(std, np.float32), None if missing is None else place(missing, np.bool_),
        )  # fmt: skip
        starts = candidates.amplitude, candidates.time, candidates.width
        self.clusters = library.Clusters(
            len(clusters.number), *(place(field, np.int64) for field in clusters),
            *(place(field, np.float64) for field in starts),
        )  # fmt: skip
        self.settings, self.shape = _as_structure(settings)

    def run(self, name: str, *arguments: object) -> int:
        """Calls a function of the library."""
        function = getattr(library.load(), name)
        structures = (ctypes.byref(part) for part in (self.block, self.clusters, self.settings))
        result = function(*structures, *arguments)
        if result < 0:
            raise MemoryError("no memory for a window of so many samples and echoes")
        return result


def _check(samples: Samples, candidates: Candidates, clusters: Clusters) -> tuple[Samples, Candidates, Clusters]:
    """The arrays as the library reads them; raises ValueError where it would read outside of them."""
    counts, baseline, std, missing = samples
    n, s = counts.shape
    if counts.dtype not in (np.uint8, np.uint16, np.uint32, np.float32):
        raise ValueError(f"samples of type {counts.dtype} cannot be decomposed")
    if baseline.shape not in ((n,), (n, s)) or std.shape != (n,) or (missing is not None and missing.shape != (n, s)):
        raise ValueError(f"level, noise or gaps do not have the shape of {n} waveforms of {s} samples")
    waveform, low, high, first, number = clusters
    m = len(candidates.time)
    inside = (waveform >= 0) & (waveform < n) & (low >= 0) & (low < high) & (high <= s)
    if not (inside & (number > 0) & (first >= 0) & (first + number <= m)).all():
        raise ValueError("a window lies outside of its waveform, or its candidates outside of their table")
    finite = all(np.isfinite(column).all() for column in (baseline, std, *candidates[1:]))
    if not (finite and (std > 0).all()):
        raise ValueError("levels, noise and candidates must be finite, and the noise above 0")
    flat = [np.ascontiguousarray(field) for field in (counts, baseline, std)]
    return (
        Samples(flat[0], flat[1].astype(np.float32, copy=False), flat[2].astype(np.float32, copy=False),
                None if missing is None else np.ascontiguousarray(missing)),
        Candidates(*(np.ascontiguousarray(field, np.float64) for field in candidates)),
        Clusters(*(np.ascontiguousarray(field, np.int64) for field in clusters)),
    )  # fmt: skip


def _as_structure(settings: Settings) -> tuple[library.Settings, tuple[np.ndarray, ...]]:
    """The settings for the library, and the arrays that they point to."""
    shape = settings.shape
    components = np.array(shape.components, np.float64).reshape(-1, 3)
    rows = (np.zeros(2, np.float32),) * 2 if shape.table is None else (shape.table.value, shape.table.slope)
    first, step = (0.0, 1.0) if shape.table is None else shape.table[:2]
    pulse = library.Pulse(
        _kind(shape), shape.kappa, shape.power, len(components), place(components, np.float64),
        len(rows[0]), first, step, *(place(row, np.float32) for row in rows), shape.origin == "waveform",
    )  # fmt: skip
    values = settings._asdict() | {"pulse": pulse, "clip": np.inf if settings.clip is None else settings.clip}
    del values["shape"]
    return library.Settings(**values), (components, *rows)


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
