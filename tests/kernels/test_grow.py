"""Clusters grow to what their samples hold, whatever their candidates were."""

import numpy as np

from wavebatch.kernels.fit.cluster import Candidates, Clusters
from wavebatch.kernels.fit.grow import Settings, decompose_clusters

SETTINGS = Settings(2.0, 1.4, 8.0)
LENGTH = 48


def bell(time, amplitude, width=2.0):
    return amplitude * np.exp(-0.5 * ((np.arange(LENGTH) - time) / width) ** 2)


def decompose(signal, times, amplitudes, seed=0):
    """Solutions of waveforms that hold the same signal, each with the same candidates."""
    n, k = 200, len(times)
    noise = np.random.default_rng(seed).standard_normal((n, LENGTH))
    samples = np.rint(20 + signal + noise).astype(np.uint16)
    rows = np.arange(n)
    candidates = Candidates(np.repeat(rows, k), np.tile(times, n), np.tile(amplitudes, n), np.full(n * k, 2.0))
    clusters = Clusters(rows, np.zeros(n, int), np.full(n, LENGTH), rows * k, np.full(n, k))
    levels = np.full(n, 20, np.float32), np.full(n, 1.04, np.float32)
    solutions = list(decompose_clusters(samples, *levels, candidates, clusters, SETTINGS))
    found = np.concatenate([solution.cluster for solution in solutions])
    assert np.array_equal(np.sort(found), rows)
    return solutions


def count(solutions):
    """Waveforms by number of echoes."""
    numbers = np.concatenate([np.full(len(part.cluster), part.parameters.shape[2]) for part in solutions])
    return np.bincount(numbers, minlength=6)


def test_candidates_where_nothing_is_do_not_keep_others_out():
    """Two echoes that share a maximum, and a candidate in a dip: it is fitted to nothing, and then the second grows."""
    signal = bell(16, 150) + bell(20, 80) - bell(30, 12, 3.0)
    solutions = decompose(signal, [17.0, 30.0], [150.0, 5.0])
    both = 0
    for part in solutions:
        apart = np.abs(part.parameters[:, 1, :, None] - [16, 20]).min(axis=1)
        both += np.count_nonzero((apart < 0.7).all(axis=1))
    assert both > 170


def test_candidates_of_nothing_are_left_out():
    solutions = decompose(bell(20, 100) - bell(30, 8, 3.0), [20.0, 30.0], [100.0, 4.0])
    assert count(solutions)[1] > 160
    assert all((part.parameters[:, 0] > 0).all() for part in solutions)
