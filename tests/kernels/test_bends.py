"""Bends of points near a line: found at ridges, not on lines, hills, waves and steps."""

import numpy as np
import pytest

from wavebatch.kernels.geometry.slice_lines import LEAST_POINTS, find_bend


def naive_gains(x, y):
    """What a bend at each x takes off the sum of squares, by least squares of each."""

    def left(*columns):
        terms = np.stack([np.ones(len(x)), x, *columns], axis=1)
        return np.sum((y - terms @ np.linalg.lstsq(terms, y, rcond=None)[0]) ** 2)

    return np.array([left() - left(np.maximum(x - at, 0)) for at in x[2:-2]])


@pytest.mark.parametrize("count", [8, 20, 300])
@pytest.mark.parametrize("degrees", [2, 10])
def test_a_ridge_is_found_where_it_is(count, degrees):
    rng = np.random.default_rng(count)
    x = np.linspace(-20, 20, count) + rng.uniform(-12, 12, count) / count
    ridge = x[count // 3]
    y = 3 + 0.02 * x - np.tan(np.radians(degrees)) * np.abs(x - ridge) + 0.01 * rng.standard_normal(count)
    found = find_bend(x[::-1], y[::-1])
    assert found == pytest.approx(x[2 + np.argmax(naive_gains(x, y))])
    assert abs(found - ridge) < 0.5


@pytest.mark.parametrize(
    "shape",
    [
        lambda x: 0.2 * x,
        lambda x: -(x**2) / 400,
        lambda x: 0.1 * np.sin(x / 3),
        lambda x: 0.15 * (x > 0),
        lambda x: -0.01 * np.abs(x),
    ],
    ids=["line", "hill", "waves", "step", "half a degree"],
)
def test_other_shapes_are_no_ridge(shape):
    for seed in range(30):
        rng = np.random.default_rng(seed)
        x = np.sort(rng.uniform(-20, 20, 80))
        assert find_bend(x, shape(x) + 0.02 * rng.standard_normal(80)) is None


def test_few_points_or_points_in_one_place_have_no_bend():
    x = np.linspace(-1, 1, LEAST_POINTS - 1)
    assert find_bend(x, np.abs(x)) is None
    assert find_bend(np.zeros(20), np.arange(20.0)) is None
    assert find_bend(np.zeros(0), np.zeros(0)) is None
    assert find_bend(np.arange(20.0), np.zeros(20)) is None
