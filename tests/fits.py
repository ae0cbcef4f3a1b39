"""The compiled fit for tests: problems as rows of numbers in, parameters by problem out."""

from typing import NamedTuple

import numpy as np

from wavebatch.kernels.fit.decompose import Candidates, Clusters, Samples, Settings, decompose_clusters

TIGHT = {"tolerance": 1e-8, "max_iterations": 60}


class Found(NamedTuple):
    """Fits of m problems with k echoes each."""

    parameters: np.ndarray
    errors: np.ndarray
    shared: np.ndarray
    cost: np.ndarray
    converged: np.ndarray
    at_bound: np.ndarray


def settings(**options):
    """Settings of a fit without growth, for pulses 2 samples wide."""
    return Settings(**{"width_ref": 2.0, "width_low": 1.4, "width_high": 8.0, "grow": False} | options)


def decompose(y, start, std=1.0, missing=None, level_err=None, **options):
    """The Solution of rows y (m, L), counts above a level of 0, from starts (m, 3, k); level_err: a number, or (m,)."""
    m, _, k = start.shape
    y = np.ascontiguousarray(y) if y.dtype in (np.uint8, np.uint16, np.uint32) else y.astype(np.float32)
    levels = None if level_err is None else np.full(m, level_err).astype(np.float32)
    samples = Samples(y, np.zeros(m, np.float32), np.full(m, std, np.float32), missing, levels)
    rows = np.arange(m)
    amplitude, time, width = (start[:, i].ravel().astype(float) for i in range(3))
    clusters = Clusters(rows, 0 * rows, 0 * rows + y.shape[1], rows * k, 0 * rows + k)
    return decompose_clusters(samples, Candidates(np.repeat(rows, k), time, amplitude, width), clusters,
                              settings(free_levels=level_err is not None, **options))  # fmt: skip


def fit(y, start, **options):
    """Fits that must keep all k echoes, as arrays (m, 4, k)."""
    found = decompose(y, start, **options)
    m, _, k = start.shape
    assert (found.number == k).all()
    parameters, errors, shared = (
        field.reshape(m, k, -1).transpose(0, 2, 1) for field in (found.parameters, found.errors, found.shared)
    )
    return Found(parameters, errors, shared, found.cost, found.converged, found.at_bound.reshape(m, k))
