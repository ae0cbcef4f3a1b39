"""Factors and products of many small symmetric systems against NumPy's own."""

import numpy as np
import pytest

from wavebatch.kernels.fit.least_squares import Windows, evaluate_model
from wavebatch.kernels.fit.normal_equations import (
    add_ridge,
    factor_symmetric,
    fit_errors,
    gram_matrix,
    substitute_back,
)
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN
from wavebatch.stages.decompose.solve import relative_energy_errors


@pytest.mark.parametrize("k", [1, 2, 4])
def test_factors_solve_the_equations(rng, k):
    rows = rng.normal(size=(50, 3 * k + 1, 40)).astype(np.float32)
    gram = gram_matrix(rows)
    matrix, right = add_ridge(gram[:, :-1, :-1].copy()), gram[:, :-1, -1]
    lower, pivot, reduced = factor_symmetric(matrix, right)
    expected = np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
    np.testing.assert_allclose(substitute_back(lower, reduced / pivot), expected, rtol=1e-9)


def test_an_unknown_that_the_data_do_not_determine_stays_and_changes_no_other(rng):
    rows = rng.normal(size=(20, 4, 40)).astype(np.float32)
    rows /= np.float32(6)
    rows[:, 2] = rows[:, 1]
    gram = gram_matrix(rows)
    lower, pivot, reduced = factor_symmetric(add_ridge(gram[:, :-1, :-1].copy()), gram[:, :-1, -1])
    solution = substitute_back(lower, reduced / pivot)
    expected = np.linalg.solve(gram[:, :2, :2], gram[:, :2, -1, None])[:, :, 0]
    np.testing.assert_allclose(solution[:, :2], expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(solution[:, 2], 0, atol=1e-9)


def test_products_do_not_depend_on_the_batch(rng):
    rows = rng.normal(size=(30, 7, 28)).astype(np.float32)
    whole = gram_matrix(rows)
    np.testing.assert_array_equal(whole, whole.transpose(0, 2, 1))
    np.testing.assert_allclose(whole, rows.astype(float) @ rows.astype(float).transpose(0, 2, 1), rtol=1e-4, atol=1e-4)
    for part in (slice(0, 1), slice(3, 10)):
        np.testing.assert_array_equal(gram_matrix(rows[part]), whole[part])


def test_a_lone_echo_of_which_two_samples_are_seen_has_errors(rng):
    """Rounding of float32 products made the variance of its time less than nothing, and the error 0."""
    parameters = np.stack([np.full(500, 30.0), rng.uniform(0.0, 4.0, 500), rng.uniform(1.0, 3.0, 500)], axis=1)
    x = np.tile(np.arange(2, dtype=np.float32), (500, 1))
    windows = Windows(np.zeros_like(x), x, np.ones(500))
    rows = evaluate_model(windows, parameters[:, :, None], GAUSSIAN)
    errors, shared = fit_errors(parameters[:, :, None], windows.std, rows, gram_matrix(rows))
    assert np.isfinite(errors).all() and (errors > 0).all()
    assert (relative_energy_errors(parameters, errors[:, :, 0], shared[:, :, 0]) > 0).all()
