"""X"""

from __future__ import annotations

import numpy as np

RIDGE = 1e-9
"""Added to the diagonal of the scaled normal equations: an echo outside its window must not make them singular."""

STEEP = 1e3
"""Variance inflation by overlap from which normal equations are taken in float64."""


def gram_matrix(rows: np.ndarray) -> np.ndarray:
    """Inner products of the rows of each problem, float64 (m, p, p)."""
    return (rows @ rows.transpose(0, 2, 1)).astype(np.float64)


def parameter_units(parameters: np.ndarray, std: np.ndarray) -> np.ndarray:
    """What one unit of each row's coefficient is worth: 1 for amplitude, s/A for time and width (m, 3, k)."""
    units = np.ones(parameters.shape)
    units[:, 1] = units[:, 2] = parameters[:, 2] / np.maximum(parameters[:, 0], 0.5 * std[:, None])
    return units


def parameter_errors(parameters: np.ndarray, std: np.ndarray, rows: np.ndarray, gram: np.ndarray) -> np.ndarray:
    """One standard deviation of each parameter from the normal equations (m, 3, k).

    Where echoes overlap so much that float32 products would not do, the products are taken in float64 (H2).
    """
    functions = gram[:, :-1, :-1]
    variance = invert_diagonal(add_ridge(functions.copy()))
    if parameters.shape[2] > 1:
        inflation = (variance * np.einsum("mpp->mp", functions)).max(axis=1)
        steep = np.flatnonzero(~((inflation < STEEP) & (variance.min(axis=1) > 0)))
        if len(steep):
            exact = rows[steep, :-1].astype(np.float64)
            variance[steep] = invert_diagonal(add_ridge(exact @ exact.transpose(0, 2, 1)))
    error = np.sqrt(np.maximum(variance, 0)).reshape(parameters.shape)
    return error * parameter_units(parameters, std) * std[:, None, None]


def solve_symmetric(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solutions (m, p) of symmetric systems (m, p, p); by cofactors for p = 3, where problems are many and tame."""
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


def invert_diagonal(matrix: np.ndarray) -> np.ndarray:
    """Diagonals (m, p) of the inverses of symmetric matrices (m, p, p)."""
    if matrix.shape[1] != 3:
        return np.diagonal(np.linalg.inv(matrix), axis1=1, axis2=2).copy()
    (xx, _, _, yy, _, zz), determinant = _cofactors(matrix)
    return np.stack([xx, yy, zz], axis=1) / determinant[:, None]


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
    """The matrices (m, p, p) with a diagonal that no overlap can make singular; changed in place."""
    diagonal = np.einsum("mpp->mp", gram)
    diagonal *= 1 + RIDGE
    diagonal += RIDGE
    return gram
