"""Exponentials, logarithms and small systems of equations that give the same bits on every processor.

NumPy's own use what the processor has (AVX2, AVX-512, the BLAS that fits it), and their last bits differ. Whatever
decides results uses these, and sums of products by `np.einsum`, which is the same everywhere, in place of `@`.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from wavebatch.kernels.library import call


def exp(x: np.ndarray | np.floating | float) -> np.ndarray:
    """e^x of the shape and the type of x, error 2e-16 of the value (of float32: rounded from that)."""
    return _apply("exponentials", np.asarray(x))


def log(x: np.ndarray | float) -> np.ndarray:
    """Natural logarithm of the shape and the type of x; -inf at 0, NaN below."""
    return _apply("logarithms", x)


def log1p(x: np.ndarray | float) -> np.ndarray:
    """ln(1 + x), exact for small x too: rounding of 1 + x is made good by the factor x / ((1 + x) - 1)."""
    one = 1.0 + np.asarray(x, np.float64)
    rounded = one - 1.0
    exact = rounded == 0
    found = np.where(exact, x, log(one) * np.where(exact, 1.0, x) / np.where(exact, 1.0, rounded))
    return found.astype(_KINDS.get(getattr(x, "dtype", None), np.float64), copy=False)


def solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solution of a symmetric positive definite system.

    Parameters
    ----------
    matrix : float (p, p)
    right : float (p,) or (p, q)

    Returns
    -------
    float64
        Of the shape of `right`; an unknown that the equations do not determine is 0.
    """
    lower = np.array(matrix, np.float64, order="C")
    columns = np.array(np.asarray(right, np.float64).T, order="C")
    call("solve_equations", ctypes.c_int64(len(lower)), ctypes.c_int64(columns.size // len(lower)), lower, columns)
    return columns.T


def interpolate(x: np.ndarray, at: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Columns of a table, linear between its rows and level beyond them.

    Parameters
    ----------
    x : float (n,)
    at : float (k,)
        Abscissas of the rows, ascending; k > 0.
    table : float (k, m)

    Returns
    -------
    float64 (n, m)
        The bits of `np.interp`, which looks for the rows of each column anew; NaN where x is.
    """
    x, at, table = (np.ascontiguousarray(array, np.float64) for array in (x, at, table))
    if x.ndim != 1 or table.ndim != 2 or at.shape != table.shape[:1] or not len(at):
        raise ValueError(f"a table of shape {table.shape} has no rows at {at.shape} places")
    out = np.empty((len(x), table.shape[1]))
    n, k, m = (ctypes.c_int64(number) for number in (len(x), *table.shape))
    call("interpolate_columns", n, x, k, m, at, table, out)
    return out


_KINDS: dict[Any, type] = {np.dtype(np.float32): np.float32}
"""Type of a result by that of the argument; float64 for any other."""


def _apply(name: str, x: np.ndarray | float) -> np.ndarray:
    values = np.ascontiguousarray(x, np.float64)
    out = np.empty_like(values)
    call(name, ctypes.c_int64(values.size), values, out)
    return out.reshape(np.shape(x)).astype(_KINDS.get(getattr(x, "dtype", None), np.float64), copy=False)[()]
