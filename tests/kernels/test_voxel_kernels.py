"""Rays through voxels: against a walk in exact fractions, and the sums along them."""

from fractions import Fraction

import numpy as np
import pytest

from wavebatch.kernels.geometry import voxels
from wavebatch.kernels.signal.deconvolve import keep_signal, measure_offsets


def walk(start, step, begin, end, size):
    """Voxels of one ray with the time inside each, plane by plane in exact fractions (Amanatides and Woo 1987)."""
    p = [Fraction(float(value)) for value in start]
    v = [Fraction(float(value)) for value in step]
    size, now, end = Fraction(float(size)), Fraction(float(begin)), Fraction(float(end))
    index = [(x + d * now) // size for x, d in zip(p, v, strict=True)]
    found = []
    while now < end:
        times = []
        for x, d, i in zip(p, v, index, strict=True):
            plane = (i + 1 if d > 0 else i) * size
            times.append((plane - x) / d if d else end + 1)
        leave = min([*times, end])
        found.append((tuple(int(i) for i in index), float(now), float(leave - now)))
        for axis, time in enumerate(times):
            if time == leave:
                index[axis] += 1 if v[axis] > 0 else -1
        now = leave
    return found


def draw_rays(rng, n):
    start = rng.uniform(-20, 20, (n, 3))
    step = rng.normal(0, 0.05, (n, 3)) + [0, 0, -0.14]
    begin = rng.uniform(-3, 0, n)
    return start, step, begin, begin + rng.uniform(0, 90, n)


@pytest.mark.parametrize("size", [0.07, 0.5, 1.0, 3.3, 50.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_crossings_are_those_of_a_slow_walk(size, seed):
    rays = draw_rays(np.random.default_rng(seed), 40)
    found = voxels.cross_voxels(*rays, size)
    for row in range(40):
        expected = [one for one in walk(*(values[row] for values in rays), size) if one[2] > 2e-6]
        mine = np.flatnonzero((found.ray == row) & (found.inside > 2e-6))
        assert [tuple(index) for index in found.voxel[mine].tolist()] == [one[0] for one in expected]
        assert found.enter[mine] == pytest.approx([one[1] for one in expected], abs=1e-9)
        assert found.inside[mine] == pytest.approx([one[2] for one in expected], abs=1e-9)


def test_slices_of_rays_cover_all_and_stay_small():
    rays = draw_rays(np.random.default_rng(5), 300)
    slices = voxels.split_rays(*rays, 0.2, crossings=2000)
    assert np.concatenate([np.arange(300)[part] for part in slices]).tolist() == list(range(300))
    for part in slices:
        found = voxels.cross_voxels(*(values[part] for values in rays), 0.2)
        widest = np.bincount(found.ray).max()
        assert widest * (part.stop - part.start) <= 2000 or part.stop - part.start == 1
    assert voxels.split_rays(*(values[:0] for values in rays), 0.2) == []
    assert len(voxels.cross_voxels(*(values[:0] for values in rays), 0.2).ray) == 0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e9, 1e300])
@pytest.mark.parametrize("what", [0, 1, 2])
def test_rays_that_keys_cannot_reach_are_refused(bad, what):
    rays = [values.copy() for values in draw_rays(np.random.default_rng(6), 5)]
    rays[what].reshape(5, -1)[2, -1] = bad
    assert voxels.fits_keys(*rays, 0.5).tolist() == [True, True, False, True, True]


def slow_sum(time, spacing, value, until):
    """What of each sample, spread evenly over its spacing, lies before a time, in exact fractions."""
    total = Fraction(0)
    for t, w, v in zip(time.tolist(), spacing.tolist(), value.tolist(), strict=True):
        passed = (Fraction(float(until)) - Fraction(t)) / Fraction(w) + Fraction(1, 2)
        total += v * min(max(passed, Fraction(0)), Fraction(1))
    return total


def test_sums_over_time_spread_every_sample_over_its_step(rng):
    count = np.array([7, 0, 1, 3, 40])
    first = np.cumsum(count) - count
    spacing = rng.choice([0.5, 1.0, 2.0], count.sum())
    time = np.concatenate([np.cumsum(2 + rng.uniform(0, 3, n)) for n in count])
    value = rng.integers(0, 1 << 40, (len(time), 2))
    samples = voxels.VoxelSamples(time, spacing, value)
    ray = np.repeat(np.arange(5), 30)
    until = rng.uniform(-3, 90, 150)
    until[::7] = time[rng.integers(0, len(time), len(until[::7]))]
    found = voxels.sum_before(samples, first, count, ray, until)
    for row in range(150):
        part = slice(first[ray[row]], first[ray[row]] + count[ray[row]])
        for column in (0, 1):
            expected = slow_sum(time[part], spacing[part], value[part, column], until[row])
            assert abs(found[row, column] - expected) <= 1
    whole = voxels.sum_before(samples, first, count, np.arange(5), np.full(5, np.inf))
    assert np.array_equal(whole, [value[one : one + n].sum(axis=0) for one, n in zip(first, count, strict=True)])
    nothing = voxels.VoxelSamples(*(part[:0] for part in samples))
    none = voxels.sum_before(nothing, first[:1], count[1:2], ray[:2] * 0, until[:2])
    assert none.tolist() == [[0, 0], [0, 0]]


def test_runs_below_the_least_are_noise_and_the_sum_of_a_run_stays():
    profile = np.array([[0, 1, 6, -2, 0.2, 0, 0, 0.5, 0.5, 9], [0, 0, 0, 1, 1, 1, 0, 0, 0, 0]], np.float32)
    support = np.array([[0, 1, 1, 1, 1, 0, 0, 1, 1, 0], [0, 0, 0, 1, 1, 1, 0, 0, 0, 0]], bool)
    signal, seen = keep_signal(profile, support, np.array([2.0, 3.1]), np.array([0.3, 0.3]))
    assert signal[0] == pytest.approx(np.array([0, 1, 6, 0, 0, 0, 0, 0, 0, 0]) * 5.2 / 7)
    assert not signal[1].any() and seen.tolist() == [True, False]
    nothing, seen = keep_signal(profile, np.zeros_like(support), np.zeros(2), np.zeros(2))
    assert not nothing.any() and not seen.any()
    # Runs of two waveforms that touch are two, and a sum counts with its negative samples.
    apart = np.array([[0, 0, 5], [5, 0, 0], [4, -3, 0]], np.float32)
    assert not keep_signal(apart, apart != 0, np.array([8.0, 8.0, 2.0]), np.full(3, 0.3))[1].any()


def test_offsets_are_those_of_the_returns_of_a_packet():
    profile = np.zeros((3, 40))
    profile[0, [10, 11]], profile[0, 30] = [1.0, 1.0], 2.0
    profile[1, 20] = 5.0
    row, sample = np.array([0, 0, 1, 2]), np.array([10.1, 29.6, 35.0, 5.0])
    offset, known = measure_offsets(profile, row, sample, 3)
    assert known.tolist() == [True, False, False]
    assert offset == pytest.approx([0.4, 0.0, 0.0])
    profile[1, [37, 39]] = 1.0  # the second search, around what the first one found, sees both
    assert measure_offsets(profile, row, sample, 3)[0][1] == pytest.approx(3.0)
    profile[2, 0] = 7.0
    assert not measure_offsets(profile, np.array([2]), np.array([-30.0]), 3)[1].any()
