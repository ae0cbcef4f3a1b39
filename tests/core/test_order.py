"""Sorting, medians and even samples."""

import numpy as np
import pytest

from wavebatch.core.order import (
    EvenSample,
    distinct,
    draw,
    find_order,
    group_medians,
    known_median,
    median,
    quantile,
    quantiles,
)


def test_drawn_numbers_look_like_chance_and_are_always_the_same():
    drawn = np.stack([draw(seed, 2, 1000) for seed in range(20)])
    assert drawn[0, 0, :2] == pytest.approx([0.84442185, 0.38524531], abs=1e-8)
    np.testing.assert_array_equal(draw(7, 2000), drawn[7].ravel())
    assert drawn.min() > 0 and drawn.max() < 1
    number = np.bincount((10 * drawn.ravel()).astype(int))
    assert np.abs(number - 4000).max() < 5 * 60  # standard deviations of a tenth of 40,000
    together = np.corrcoef(drawn.reshape(40, 1000)) - np.eye(40)
    assert np.abs(together).max() < 5 / np.sqrt(1000)


def test_any_rows_get_the_order_of_a_full_sort(rng):
    for _ in range(300):
        m = int(rng.integers(1, 60))
        waveform = rng.integers(0, rng.integers(1, 40), m).astype(np.int32)
        # Whole numbers: rows of the same waveform and time keep their order.
        time = rng.integers(-5, 5, m).astype(float)
        expected = np.lexsort((time, waveform))
        order = find_order(waveform, time)
        np.testing.assert_array_equal(np.arange(m) if order is None else order, expected)


def test_rows_in_order_are_left_alone():
    assert find_order(np.array([0, 0, 3, 3, 3]), np.array([1.0, 2.0, -1.0, -1.0, 5.0])) is None
    assert find_order(np.empty(0, np.int64), np.empty(0)) is None


def test_medians_of_groups_are_those_of_each_group_alone():
    random = np.random.default_rng(3)
    group = random.integers(0, 40, 300)
    group[group == 7] = 8
    for values in (random.normal(0, 5, 300), random.normal(0, 5, 300).astype(np.float32)):
        medians, std = group_medians(values, group)
        assert len(medians) == len(std) == group.max() + 1 and medians.dtype == values.dtype
        assert medians[7] == std[7] == 0
        for row in np.unique(group):
            part = values[group == row]
            assert medians[row] == np.median(part)
            assert std[row] == pytest.approx(1.4826 * np.median(np.abs(part - np.median(part))), rel=1e-4, abs=1e-12)
    assert len(group_medians(np.empty(0), np.empty(0, np.int64))[0]) == 0


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int64, np.uint8])
@pytest.mark.parametrize("n", [1, 2, 3, 10, 11, 1000, 70_001])
def test_distinct_median_and_quantile_give_the_bits_of_numpy(dtype, n, rng):
    values = (rng.normal(0, 40, n) + 100).astype(dtype)
    table = (rng.normal(0, 40, (n, 6)) + 100).astype(dtype)
    np.testing.assert_array_equal(distinct(values), np.unique(values), strict=True)
    for given, axis in ((values, None), (table, None), (table, 0), (table, 1)):
        expected, found = np.median(given, axis=axis), median(given, axis)
        assert np.asarray(found).dtype == np.asarray(expected).dtype
        np.testing.assert_array_equal(found, expected)
    if np.issubdtype(dtype, np.floating):
        for share in (0.0, 0.1, 0.25, 0.5, 0.84, 0.99, 1.0):
            assert quantile(values, share) == float(np.quantile(values, share))
        for given in (values, table):
            found, shares = quantiles(given, (0.0, 0.02, 0.5, 0.8413, 1.0)), (0.0, 0.02, 0.5, 0.8413, 1.0)
            np.testing.assert_array_equal(found, np.quantile(given, shares, axis=-1), strict=True)


def test_the_median_of_nan_or_of_nothing_is_nan():
    assert np.isnan(median(np.array([1.0, np.nan, 2.0])))
    assert np.isnan(median(np.empty(0)))
    np.testing.assert_array_equal(median(np.array([[1.0, np.nan], [3.0, 4.0]]), 0), [2.0, np.nan])


@pytest.mark.filterwarnings("ignore:All-NaN slice")
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(1, 3), (2, 9), (11, 40), (700, 5)])
def test_the_median_of_known_values_has_the_bits_of_numpy(dtype, shape, rng):
    for share in (0.0, 0.1, 0.6, 1.0):
        values = (rng.normal(0, 40, shape) + 100).astype(dtype)
        values[rng.random(shape) < share] = np.nan
        for axis in (0, 1):
            np.testing.assert_array_equal(known_median(values, axis), np.nanmedian(values, axis=axis), strict=True)


def test_an_even_sample_is_every_nth_row_however_they_come(rng):
    columns = {"value": rng.normal(size=5000), "place": rng.normal(size=(5000, 2))}
    for pieces in (1, 77, 5000):
        sample = EvenSample(300)
        for rows in np.array_split(np.arange(5000), pieces):
            sample.add({name: values[rows] for name, values in columns.items()})
        assert sample.seen == 5000 and sample.step == 32
        for name, values in columns.items():
            assert np.array_equal(sample.read()[name], values[:: sample.step])
