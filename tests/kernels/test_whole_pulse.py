"""Fits become whole echoes in C: the same bits as one echo after the other (tests/naive_fit.py)."""

import naive_fit
import numpy as np
import pytest

from wavebatch.kernels.fit.decompose import Clusters, Solution, WholePulse, describe_whole, keep_echoes
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape
from wavebatch.stages.pulse_tables import ShapeLimits, whole_pulse

LIMITS = ShapeLimits(2.0, 1.0, 30.0)
SHAPES = {
    "gaussian": GAUSSIAN,
    "skewed": PulseShape(kappa=0.3),
    "learned": PulseShape(components=((0.2, 3.0, 1.5), (-0.1, -2.0, 0.4))),
}


def draw(rng, m, most=6.0):
    """Fits of m echoes, some of them wide, faint, outside of the waveform or without errors."""
    fitted = np.stack([rng.normal(20, 15, m), rng.uniform(-6, 86, m), rng.uniform(1.0, most, m), np.zeros(m)], axis=1)
    errors = rng.uniform(0.01, 3.0, (m, 4))
    errors[rng.random(m) < 0.05, 0] = np.inf
    errors[rng.random(m) < 0.05, 2] = np.nan
    shared = rng.normal(0, 1.0, (m, 2))
    shared[rng.random(m) < 0.1] = np.nan
    return fitted, errors, shared


@pytest.mark.parametrize("level", [None, 0.3])
@pytest.mark.parametrize("most", [6.0, 60.0])
@pytest.mark.parametrize("name", SHAPES)
def test_the_library_keeps_and_describes_echoes_as_the_loop(name, most, level, rng):
    number = rng.choice([0, 1, 1, 1, 2, 5], 300)
    c, m = len(number), int(number.sum())
    fitted, errors, shared = draw(rng, m, most)
    solution = Solution(number, rng.random(c) < 0.9, np.zeros(c), rng.uniform(0.5, 3, m), fitted, errors, shared,
                        rng.random(m) < 0.1)  # fmt: skip
    windows = np.zeros((4, c), np.int64)
    windows[1] = rng.integers(20, 80, c)
    clusters = Clusters(np.sort(rng.integers(0, 200, c)), *windows)
    whole = whole_pulse(SHAPES[name], LIMITS, fitted[:, 2])
    assert bool(len(whole.wide)) == (name == "learned" and most > 8)
    factors, std = rng.uniform(0.5, 1.5, (m, 4)), rng.uniform(0.5, 2, 200).astype(np.float32)
    problem = clusters, solution, whole, factors, std, 0.5, 80, 4.5, None if level is None else level * std
    with np.errstate(all="ignore"):
        columns, row = keep_echoes(*problem)
        expected = naive_fit.keep(*problem)
    assert 0.25 * m < len(row) == len(expected) < m
    for found, wanted in zip((*columns.values(), row), zip(*expected, strict=True), strict=True):
        np.testing.assert_array_equal(found, np.array(wanted).astype(found.dtype))
    values, spreads = describe_whole(whole, fitted[:, :3], errors[:, :3], shared)
    with np.errstate(all="ignore"):
        fits = zip(fitted[:, :3], errors[:, :3], shared, strict=True)
        twins = [naive_fit.describe_whole(whole, *fit) for fit in fits]
    np.testing.assert_array_equal(values, [value for value, _ in twins])
    np.testing.assert_array_equal(spreads, [error for _, error in twins])


def test_a_call_changes_no_fit_and_no_fits_give_no_echoes(rng):
    """Errors were once multiplied in place, so that echoes of asked clusters got their factors twice."""
    fitted, errors, shared = draw(rng, 3)
    errors[:] = 0.1
    one, kept = np.ones(1, np.int64), errors.copy()
    solution = Solution(3 * one, one > 0, one * 1.0, np.ones(3), fitted, errors, shared, np.zeros(3, bool))
    clusters = Clusters(*[0 * one] * 5)
    keep_echoes(clusters, solution, WholePulse(), np.full((3, 4), 2.0), np.ones(1, np.float32), 1.0, 80, 1.0)
    np.testing.assert_array_equal(errors, kept)
    none = Solution(*(column[:0] for column in solution))
    columns, row = keep_echoes(Clusters(*(column[:0] for column in clusters)), none, WholePulse(), np.ones((0, 4)),
                               np.ones(1, np.float32), 1.0, 80, 1.0)  # fmt: skip
    assert len(row) == len(columns["time"]) == 0


def test_arrays_that_do_not_fit_are_refused(rng):
    fitted, errors, shared = draw(rng, 2)
    one = np.ones(1, np.int64)
    solution = Solution(2 * one, one > 0, one * 1.0, np.ones(2), fitted, errors, shared, np.zeros(2, bool))
    clusters, std = Clusters(*[0 * one] * 5), np.ones(1, np.float32)
    with pytest.raises(ValueError, match="differ in length"):
        keep_echoes(clusters, solution, WholePulse(), np.ones((1, 4)), std, 1.0, 80, 1.0)
    with pytest.raises(ValueError, match="differ in length"):
        keep_echoes(clusters, solution._replace(number=3 * one), WholePulse(), np.ones((2, 4)), std, 1.0, 80, 1.0)
    with pytest.raises(ValueError, match="lies in no waveform"):
        keep_echoes(clusters._replace(waveform=one), solution, WholePulse(), np.ones((2, 4)), std, 1.0, 80, 1.0)
    with pytest.raises(ValueError, match="no table for these widths"):
        describe_whole(whole_pulse(SHAPES["learned"], LIMITS, np.ones(1)), *np.full((2, 1, 3), 50.0), np.zeros((1, 2)))
    with pytest.raises(ValueError, match="as many errors"):
        describe_whole(WholePulse(), np.ones((2, 3)), np.ones((1, 3)), np.ones((2, 2)))


@pytest.mark.parametrize(
    ("limits", "ends"),
    [
        ((2.0, 1.0, 30.0), (1.0, 8.0)),  # four widths of the pulse; wider ones have a coarser table
        ((2.0, 1.6, 30.0), (1.4, 8.0)),  # the same table for all fits that allow no less than .7 widths
        ((2.0, 1.4, 5.0), (1.4, 5.0)),
        ((2.0, 9.0, 30.0), (1.4, 9.09)),
    ],
)
def test_the_table_of_usual_widths_is_no_wider_than_fits_allow(limits, ends):
    near = whole_pulse(SHAPES["learned"], ShapeLimits(*limits), np.ones(1)).near
    assert near[[0, -1], 0] == pytest.approx(ends)
