"""The sample that was interpolated between two recordings, from plain counts."""

import numpy as np

from wavebatch.kernels.signal.defects import find_seam


def packets(n, seed=1):
    rng = np.random.default_rng(seed)
    time = rng.uniform(20, 60, (n, 1))
    return np.rint(10 + 100 * np.exp(-0.5 * ((np.arange(80) - time) / 1.7) ** 2) + rng.normal(0, 0.7, (n, 80)))


def interpolate(counts, at):
    counts[:, at] = np.rint(0.5 * (counts[:, at - 1] + counts[:, at + 1]))
    return counts.clip(0, 255).astype(np.uint8)


def test_a_seam_is_one_interpolated_sample():
    assert find_seam(interpolate(packets(600), 40)) == 40
    assert find_seam(packets(600).clip(0, 255).astype(np.uint8)) == 0


def test_what_proves_no_seam():
    assert find_seam(interpolate(packets(19), 40)) == 0, "too few waveforms"
    assert find_seam(interpolate(packets(600), 5)) == 0, "no recording is so short"
    assert find_seam(np.full((600, 80), 7, np.uint8)) == 0, "no signal"
    assert find_seam(interpolate(packets(600)[:, 30:50], 10)) == 0, "short packets"
    ramp = (np.arange(80) * 3 + np.zeros((600, 1))).astype(np.uint8)
    assert find_seam(ramp) == 0, "every sample is the mean of its neighbours"
