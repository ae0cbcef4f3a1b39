"""Normal equations of many small least-squares problems: products, solutions and parameter errors.

Used by every fit here. Equations are in units in which each basis function has the same scale, so that the condition
number is that of the overlap alone: float32 products are then exact enough, float64 solves are needed
(docs/algorithms.md H2). Each reduction stays within one problem, so that results do not depend on the batch.
"""

from __future__ import annotations

import numpy as np

RIDGE = 1e-9
"""Added to the diagonal of the scaled equations: an echo outside its window must not make them singular."""

LEAST_PIVOT = 1e-7
"""Pivots below are what rounding of float32 products leaves: the data do not determine such an unknown."""

_UNDETERMINED = 1e30

STEEP = 1e3
"""Variance inflation by overlap from which products are taken in float64 (docs/algorithms.md H2)."""


def gram_matrix(rows: np.ndarray) -> np.ndarray:
    """Inner products of the rows of each problem.

    Parameters
    ----------
    rows : float32 (m, p, L)
        Rows of `evaluate_model`.

    Returns
    -------
    float64 (m, p, p)
        Products summed in float32.
    """
    gram = np.empty((len(rows), rows.shape[1], rows.shape[1]))
    # Not all rows by all rows: NumPy takes a slower way for the product of an array with itself.
    gram[:, :-1] = rows[:, :-1] @ rows.transpose(0, 2, 1)
    gram[:, -1, :-1] = gram[:, :-1, -1]
    gram[:, -1, -1] = np.einsum("ml,ml->m", rows[:, -1], rows[:, -1])
    return gram


def parameter_units(parameters: np.ndarray, std: np.ndarray) -> np.ndarray:
    """What one unit of each row's coefficient means: 1 for amplitude, width / amplitude for time and width.

    Parameters
    ----------
    parameters : float64 (m, 3, k)
        Amplitude, time, width.
    std : float64 (m,), count
        Noise; amplitudes below half of it count as that.

    Returns
    -------
    float64 (m, 3, k)
    """
    units = np.ones(parameters.shape)
    units[:, 1] = units[:, 2] = parameters[:, 2] / np.maximum(parameters[:, 0], 0.5 * std[:, None])
    return units


def parameter_errors(parameters: np.ndarray, std: np.ndarray, rows: np.ndarray, gram: np.ndarray) -> np.ndarray:
    """One standard deviation of each parameter, from the normal equations.

    Where echoes overlap so much that float32 products are not exact enough, they are taken again in float64.

    Parameters
    ----------
    parameters : float64 (m, 3, k)
        Amplitude [count], time and width [samples].
    std : float64 (m,), count
        Noise of one sample.
    rows : float32 (m, 3 k + 1, L)
        Rows of `evaluate_model` at the parameters.
    gram : float64 (m, 3 k + 1, 3 k + 1)
        Their products.

    Returns
    -------
    float64 (m, 3, k)
        In the units of the parameters.
    """
    return fit_errors(parameters, std, rows, gram)[0]


def fit_errors(
    parameters: np.ndarray, std: np.ndarray, rows: np.ndarray, gram: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One standard deviation of each parameter, and what the width has in common with the others, in each echo.

    Parameters
    ----------
    parameters, std, rows, gram
        As for `parameter_errors`.

    Returns
    -------
    errors : float64 (m, 3, k)
        In the units of the parameters.
    shared : float64 (m, 2, k)
        Covariance of amplitude and width, and of time and width, in the units of the parameters. It is not the same
        share of the errors for lone and for overlapping echoes, so that what depends on both, such as the energy,
        cannot have its error from `errors` alone (docs/algorithms.md 5).
    """
    functions = gram[:, :-1, :-1]
    variance, shared = invert_parts(add_ridge(functions.copy()))
    # Also of lone echoes: those at an edge of their window, of which a few samples are seen, had errors of 0.
    inflation = (variance * np.einsum("mpp->mp", functions)).max(axis=1)
    steep = np.flatnonzero(~((inflation < STEEP) & (variance.min(axis=1) > 0)))
    if len(steep):
        exact = rows[steep, :-1].astype(np.float64)
        variance[steep], shared[steep] = invert_parts(add_ridge(exact @ exact.transpose(0, 2, 1)))
    units = parameter_units(parameters, std) * std[:, None, None]
    errors = np.sqrt(np.maximum(variance, 0).reshape(parameters.shape)) * units
    shared *= units[:, :2]
    shared *= units[:, 2:]
    return errors, shared


def solve_symmetric(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solutions of symmetric systems; by cofactors for p = 3, where problems are many and well conditioned.

    Parameters
    ----------
    matrix : float64 (m, p, p)
        Symmetric matrices.
    right : float64 (m, p)
        Right-hand sides.

    Returns
    -------
    float64 (m, p)

    Raises
    ------
    numpy.linalg.LinAlgError
        A matrix is singular (p other than 3); see `add_ridge`.
    """
    if matrix.shape[1] != 3:
        return np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
    cofactors, determinant = _cofactors(matrix)
    xx, xy, xz, yy, yz, zz = cofactors
    a, b, c = right.T
    solution = np.empty_like(right)
    solution[:, 0] = xx * a + xy * b + xz * c
    solution[:, 1] = xy * a + yy * b + yz * c
    solution[:, 2] = xz * a + yz * b + zz * c
    solution /= determinant[:, None]
    return solution


def factor_symmetric(matrix: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Factors of positive definite matrices, lower D lower', and right-hand sides without their lower triangle.

    Parameters
    ----------
    matrix : float64 (m, p, p)
        See `add_ridge`.
    right : float64 (m, p)

    Returns
    -------
    lower : float64 (m, p, p)
        Below the diagonal; the diagonal, not given, is 1.
    pivot : float64 (m, p)
        D; so large where it is below LEAST_PIVOT that the unknown stays 0 and changes no other.
    right : float64 (m, p)
        Solution of lower times it = right.
    """
    p = matrix.shape[1]
    lower, pivot, right = matrix.copy(), np.empty(right.shape), right.copy()
    for j in range(p):
        pivot[:, j] = np.where(lower[:, j, j] > LEAST_PIVOT, lower[:, j, j], _UNDETERMINED)
        column = lower[:, j + 1 :, j] / pivot[:, j, None]
        lower[:, j + 1 :, j + 1 :] -= column[:, :, None] * lower[:, j + 1 :, j, None].transpose(0, 2, 1)
        right[:, j + 1 :] -= column * right[:, j, None]
        lower[:, j + 1 :, j] = column
    return lower, pivot, right


def substitute_back(lower: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solutions x, float64 (m, p), of lower' x = right, with the lower triangle of `factor_symmetric`."""
    solution = right.astype(np.float64)
    for j in reversed(range(solution.shape[1] - 1)):
        solution[:, j] -= np.einsum("mp,mp->m", lower[:, j + 1 :, j], solution[:, j + 1 :])
    return solution


def invert_parts(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parts of the inverses of symmetric matrices (m, 3 k, 3 k), float64.

    Returns
    -------
    diagonal : float64 (m, 3 k)
    shared : float64 (m, 2, k)
        The elements of amplitude and width, and of time and width, of the same echo.
    """
    k = matrix.shape[1] // 3
    if k != 1:
        inverse = np.linalg.inv(matrix)
        first = np.arange(k)
        shared = np.stack([inverse[:, first, 2 * k + first], inverse[:, k + first, 2 * k + first]], axis=1)
        return np.diagonal(inverse, axis1=1, axis2=2).copy(), shared
    (xx, _, xz, yy, yz, zz), determinant = _cofactors(matrix)
    inverse = np.stack([xx, yy, zz, xz, yz], axis=1) / determinant[:, None]
    return inverse[:, :3], inverse[:, 3:, None]


def _cofactors(matrix: np.ndarray) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Cofactors xx, xy, xz, yy, yz, zz and determinants of symmetric matrices (m, 3, 3)."""
    xx, xy, xz, yy, yz, zz = np.ascontiguousarray(matrix.reshape(-1, 9).T[[0, 1, 2, 4, 5, 8]])
    cofactors = (
        yy * zz - yz * yz,
        xz * yz - xy * zz,
        xy * yz - xz * yy,
        xx * zz - xz * xz,
        xy * xz - xx * yz,
        xx * yy - xy * xy,
    )
    determinant = xx * cofactors[0] + xy * cofactors[1] + xz * cofactors[2]
    return cofactors, np.where(np.abs(determinant) > 1e-300, determinant, 1e-300)


def add_ridge(gram: np.ndarray) -> np.ndarray:
    """The matrices (m, p, p) with a ridge on the diagonal, so that no overlap makes them singular; changed in place."""
    diagonal = np.einsum("mpp->mp", gram)
    diagonal *= 1 + RIDGE
    diagonal += RIDGE
    return gram
