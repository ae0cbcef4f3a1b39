"""Factors and products of many small symmetric systems against NumPy's own."""

import numpy as np
import pytest

from wavebatch.kernels.fit.normal_equations import add_ridge, factor_symmetric, gram_matrix, substitute_back


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
