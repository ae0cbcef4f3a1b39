"""Order of the rows of a table: that of a sort by waveform, then time."""

import numpy as np
import pytest

from wavebatch.core.order import find_order, group_medians


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
        median, std = group_medians(values, group)
        assert len(median) == len(std) == group.max() + 1 and median.dtype == values.dtype
        assert median[7] == std[7] == 0
        for row in np.unique(group):
            part = values[group == row]
            assert median[row] == np.median(part)
            assert std[row] == pytest.approx(1.4826 * np.median(np.abs(part - np.median(part))), rel=1e-4, abs=1e-12)
    assert len(group_medians(np.empty(0), np.empty(0, np.int64))[0]) == 0
