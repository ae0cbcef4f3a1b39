"""Kernels of geometry that nothing else compares with a slow, plain twin."""

import naive_geometry
import numpy as np

from wavebatch.kernels.geometry import normals
from wavebatch.kernels.geometry.group_returns import LONGEST_PULSE, find_rays, group_times
from wavebatch.kernels.geometry.normals import thin_out


def test_packets_of_equal_time_are_those_of_a_loop(rng):
    time = np.concatenate([rng.integers(0, 40, 120).astype(float), np.full(LONGEST_PULSE, 77.0), [np.nan] * 3])
    rng.shuffle(time)
    assert group_times(time).tolist() == naive_geometry.group_times(time)
    assert group_times(time[:0]).tolist() == []


def test_packets_of_a_pulse_lie_on_one_line(rng):
    """In any order; other directions, rays beside it, other scanners and other times are other pulses."""
    ray = rng.integers(0, 12, 150)
    group, scanner, side = ray // 6, (ray // 3) % 2, ray % 3
    step = np.array([[0.01, 0.0, -0.15], [0.01, 0.0, -0.15], [0.01, 2e-4, -0.15]])[side]
    step = step * (1 + 1e-6 * rng.standard_normal((150, 3)))
    start = np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0, 0]])[side] + step * rng.uniform(-900, 900, (150, 1))
    start += 0.01 * rng.standard_normal((150, 3))
    found = find_rays(group, scanner, start, step)
    assert found.tolist() == naive_geometry.find_rays(group, scanner, start, step)
    assert found.tolist() == [int(np.flatnonzero(ray == one)[0]) for one in ray]
    start[3], step[5] = np.nan, 0.0
    alone = find_rays(group, scanner, start, step)
    assert alone[3] == 3 and alone[5] == 5 and np.count_nonzero(alone == 3) == 1


def test_dense_points_are_thinned_as_by_a_loop(rng):
    xyz = rng.normal(0, 1.0, (3000, 3))
    row = rng.permutation(10**6)[:3000]
    kept = thin_out(xyz, row, 2.0)
    expected = naive_geometry.thin_out(xyz, row, 2.0, normals.FINENESS, normals.MOST_PER_CELL)
    np.testing.assert_array_equal(kept, expected)
    assert 0.1 < kept.mean() < 0.9
