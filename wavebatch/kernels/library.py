"""The compiled library of the kernels: its structures, and arrays checked before they are handed over.

Used by kernels/fit and kernels/signal. The source is kernels/c; `pip install` builds it, and in a checkout it is built
again when its source has changed (build_kernels.py).
"""

from __future__ import annotations

import ctypes
from functools import cache

import numpy as np

from wavebatch.kernels.build_kernels import LIBRARY, compile_library, is_outdated

_POINTER = ctypes.c_void_p


def _fields(kind: type, names: str) -> list[tuple[str, type]]:
    return [(name, kind) for name in names.split()]


class Pulse(ctypes.Structure):
    """`Pulse` of kernels/c/types.h."""

    _fields_ = [
        *_fields(ctypes.c_int64, "kind"),
        *_fields(ctypes.c_double, "skew power"),
        *_fields(ctypes.c_int64, "n_components"),
        *_fields(_POINTER, "components"),
        *_fields(ctypes.c_int64, "n_rows"),
        *_fields(ctypes.c_double, "first step"),
        *_fields(_POINTER, "value slope"),
        *_fields(ctypes.c_int64, "from_waveform"),
    ]
    SUM_OF_GAUSSIANS, SKEWED, POWER, TABLE, LOG_NORMAL = range(5)


class Settings(ctypes.Structure):
    """`Settings` of kernels/c/types.h."""

    _fields_ = [
        ("pulse", Pulse),
        *_fields(
            ctypes.c_double,
            "width_ref width_low width_high clip noise_gain tolerance acceptance misfit prior_spread gate_residual "
            "gate_hermite skew_mean skew_spread",
        ),
        *_fields(ctypes.c_int64, "max_iterations max_echoes grow undamped"),
    ]


class Block(ctypes.Structure):
    """`Block` of kernels/c/types.h."""

    _fields_ = [
        *_fields(_POINTER, "samples"),
        *_fields(ctypes.c_int64, "length bytes"),
        *_fields(_POINTER, "baseline"),
        *_fields(ctypes.c_int64, "baseline_per_sample"),
        *_fields(_POINTER, "std missing"),
    ]


class Clusters(ctypes.Structure):
    """`Clusters` of kernels/c/types.h."""

    _fields_ = [
        *_fields(ctypes.c_int64, "n"),
        *_fields(_POINTER, "waveform low high first number amplitude time width"),
    ]


class Echoes(ctypes.Structure):
    """`Echoes` of kernels/c/types.h."""

    _fields_ = [
        *_fields(ctypes.c_int64, "room"),
        *_fields(_POINTER, "number converged misfit cost parameters errors shared at_bound"),
    ]


@cache
def load() -> ctypes.CDLL:
    """The library.

    Raises
    ------
    ImportError
        It was not built, or for another machine.
    """
    try:
        if is_outdated():
            compile_library()
        library = ctypes.CDLL(str(LIBRARY))
    except (OSError, RuntimeError) as error:
        reason = f"cannot be loaded ({error})" if LIBRARY.exists() else f"were not built ({error})"
        raise ImportError(
            f"{LIBRARY}: the compiled kernels {reason}; install wavebatch again on this machine: "
            "python -m pip install --force-reinstall --no-cache-dir wavebatch"
        ) from None
    for function in (library.decompose_clusters, library.promise_echoes):
        function.restype = ctypes.c_int64
    return library


def place(array: np.ndarray, dtype: type) -> int:
    """Address of a contiguous array of this type, for a structure whose owner keeps the array."""
    if array.dtype != dtype or not array.flags.c_contiguous:
        raise ValueError(f"expected a contiguous array of {np.dtype(dtype)}, got {array.dtype}")
    return array.ctypes.data
