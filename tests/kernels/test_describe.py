"""The judge's kernels: descriptions, shared volumes, changes of shape, and the pulse of all echoes together."""

import naive_describe as naive
import numpy as np
import pytest
from commands import refuses

from wavebatch.kernels.fit import describe
from wavebatch.kernels.fit.pulse_shape import PulseShape, evaluate_pulse

SHAPES = [PulseShape(), PulseShape(kappa=0.15), PulseShape(components=((0.2, 4.0, 5.0), (-0.05, 1.0, -0.8)))]
NOISES = [describe.SampleNoise(1.3), describe.SampleNoise(0.9, 0.02, (0.7, 0.4, 0.1))]


def _problem(shape, rng, n=12, s=70):
    """Waveforms with 0 to 4 echoes, the third quarter of one waveform not recorded."""
    waveform = np.repeat(np.arange(n), rng.integers(0, 5, n))
    m = len(waveform)
    main = np.stack([rng.uniform(5, 90, m), rng.uniform(8, 55, m), rng.uniform(1.5, 3.0, m)], axis=1)
    model = describe.render_pulses(shape, n, s, waveform, main)
    used = np.ones((n, s), bool)
    used[3, 35:52] = False
    left = np.where(used, rng.standard_normal((n, s)), 0).astype(np.float32)
    return describe.Sums(shape, describe.count_echoes(waveform, n), main, left, model, used)


def _echoes(sums, i):
    return [tuple(row) for row in sums.main[sums.first[i] : sums.first[i + 1]]]


def _evaluate(shape):
    return lambda x, time, width: evaluate_pulse(shape, x, np.array(time), np.array(width))


@pytest.mark.parametrize("shape", SHAPES)
def test_the_sum_of_echoes_is_that_of_a_loop(shape, rng):
    sums = _problem(shape, rng)
    for i, row in enumerate(sums.model):
        np.testing.assert_allclose(row, naive.render(_evaluate(shape), len(row), _echoes(sums, i)), atol=1e-3)


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("shape", SHAPES)
def test_descriptions_are_those_of_a_loop(shape, noise, rng):
    sums, changes = _problem(shape, rng), (0.0, 0.02, 0.0)
    length, volume, *nothing = describe.describe_left(sums, noise, changes)
    assert nothing == [None, None]
    np.testing.assert_array_equal(length[0], length[2])
    for i in range(len(sums.left)):
        planes = (sums.left[i].astype(float), sums.model[i].astype(float), sums.used[i])
        for one, change in zip(length, changes, strict=True):
            expected = naive.describe(_evaluate(shape), *planes, _echoes(sums, i), *noise, change)
            np.testing.assert_allclose(one[i], expected[0], rtol=1e-5)
        # In single precision the matrices of echoes that overlap most are known to a hundredth.
        np.testing.assert_allclose(volume[i], expected[1], rtol=0.01, atol=0.02)


@pytest.mark.parametrize("noise", NOISES)
def test_changes_are_those_of_a_loop(noise, rng):
    sums = _problem(SHAPES[2], rng)
    plain, (*same, change, precision) = (
        describe.describe_left(sums, noise, [0.0], strongest=asked) for asked in (False, True)
    )
    for one, other in zip(plain, same, strict=False):
        np.testing.assert_array_equal(one, other)
    for i in range(len(sums.left)):
        if not _echoes(sums, i):
            assert not precision[i].any()
            continue
        planes = (sums.left[i].astype(float), sums.model[i].astype(float), sums.used[i])
        expected = naive.measure_change(_evaluate(SHAPES[2]), *planes, _echoes(sums, i), *noise)
        np.testing.assert_allclose(change[i], expected[0], rtol=5e-3, atol=1e-4)
        np.testing.assert_allclose(precision[i], expected[1], rtol=5e-3)


@pytest.mark.parametrize("counted", [1.0, 0.3])
def test_normal_equations_are_those_of_a_loop(counted, rng):
    sums = _problem(SHAPES[2], rng)
    delay, sigma, noise = np.arange(-4.0, 9.0), np.full(13, 1.4), describe.SampleNoise(1.1, 0.03)
    matrix, right = describe.gather_pulse(sums, noise, 0.01, delay, sigma, 2.0, 3, counted)
    expected = [
        naive.gather(_evaluate(SHAPES[2]), sums.left[i].astype(float), sums.model[i].astype(float), sums.used[i],
                     _echoes(sums, i), 1.1, 0.03, 0.01, delay, sigma, 2.0, counted)
        for i in range(len(sums.left)) if 0 < len(_echoes(sums, i)) <= 3
    ]  # fmt: skip
    np.testing.assert_allclose(matrix, sum(one for one, _ in expected), rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose(right, sum(one for _, one in expected), rtol=1e-3, atol=1e-1)


def test_many_echoes_of_a_long_waveform_take_time_in_proportion(rng):
    """Two thousand echoes in 65,535 samples: groups of echoes are taken together, each in its own stretch."""
    m = 2000
    main = np.stack([rng.uniform(5, 90, m), np.sort(rng.uniform(0, 65_535, m)), np.full(m, 2.0)], axis=1)
    model = describe.render_pulses(PulseShape(), 1, 65_535, np.zeros(m, int), main)
    sums = describe.Sums(PulseShape(), np.array([0, m]), main, np.zeros_like(model), model, np.ones(model.shape, bool))
    length, volume, *_ = describe.describe_left(sums, describe.SampleNoise(1.0), [0.01])
    assert np.isfinite(length).all() and np.isfinite(volume).all()


@pytest.mark.parametrize("scatter", [0.005, 0.05])
def test_widths_cost_what_the_loop_says(scatter, rng):
    """Widths of level ground, of slopes, and wild ones, with errors of any size."""
    error = np.exp(rng.uniform(np.log(1e-3), np.log(0.5), 300))
    ratio = 1 + np.r_[np.zeros(150), rng.uniform(0, 0.8, 145), np.full(5, 4.0)]
    ratio += rng.normal(0, np.hypot(error, scatter))
    known = error < 0.15
    widths = ratio, error, known, (0.01, 0.02, 0.04, 0.06), 1 + 0.02 * 2.0 ** np.arange(9), 0.01
    np.testing.assert_allclose(describe.describe_widths(*widths), naive.describe_widths(*widths), atol=1e-4)
    for wrong in ({1: 0 * error}, {0: ratio * np.nan}, {2: known[1:]}, {3: ()}, {4: np.array([1.0])}):
        with pytest.raises(ValueError):
            describe.describe_widths(*(wrong.get(place, value) for place, value in enumerate(widths)))


def test_echoes_that_are_not_sorted_are_refused():
    with pytest.raises(ValueError, match="not sorted"):
        describe.render_pulses(PulseShape(), 2, 9, np.array([1, 0]), np.array([[1.0, 4.0, 1.0], [2.0, 4.0, 1.0]]))


def test_arrays_that_the_library_would_read_beyond_are_refused(rng):
    sums = _problem(PulseShape(), rng)
    for wrong in (
        {"first": sums.first[:-1]}, {"first": sums.first + 1}, {"left": sums.left[:, 1:]}, {"used": sums.used[1:]},
        {"main": sums.main * [1, 1, 0]}, {"main": sums.main * np.nan},
    ):  # fmt: skip
        refuses(ValueError, "", describe.describe_left, sums._replace(**wrong), NOISES[0], [0.0])
    refuses(ValueError, "", describe.describe_left, sums, describe.SampleNoise(0.0), [0.0])
